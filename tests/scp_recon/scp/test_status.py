"""Every way to end has its name, words and exit status."""

from __future__ import annotations

import pytest

from scp_recon.scp.status import Status

EXIT_CODES = {"converged": 0, "infeasible": 3, "lost": 5, "interrupted": 130}
BAD_INPUT = 2


@pytest.mark.parametrize("status", Status)
def test_a_status_has_its_name_words_and_exit_code(status: Status) -> None:
    outcome = status.value
    assert Status.named(outcome.name) is status
    assert outcome.message
    solved = status is Status.CONVERGED
    assert (bool(outcome.remedy), outcome.exit_code == 0) == (not solved, solved)
    assert outcome.exit_code != BAD_INPUT
    assert outcome.exit_code == EXIT_CODES.get(outcome.name, outcome.exit_code)


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(ValueError, match="'done'"):
        Status.named("done")
