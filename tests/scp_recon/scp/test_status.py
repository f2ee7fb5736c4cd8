"""Every way to end has its name, words and exit status."""

from __future__ import annotations

import pytest

from scp_recon.scp.status import Status

EXIT_CODES = {"converged": 0, "infeasible": 3, "interrupted": 130}
BAD_INPUT = 2


@pytest.mark.parametrize("status", Status)
def test_a_status_says_what_happened_and_what_to_try(status: Status) -> None:
    outcome = status.value
    assert outcome.message
    assert bool(outcome.remedy) == (status is not Status.CONVERGED)
    assert Status.named(outcome.name) is status


@pytest.mark.parametrize("status", Status)
def test_only_a_solution_ends_with_zero(status: Status) -> None:
    outcome = status.value
    assert (outcome.exit_code == 0) == (status is Status.CONVERGED)
    assert outcome.exit_code != BAD_INPUT
    assert outcome.exit_code == EXIT_CODES.get(outcome.name, outcome.exit_code)


def test_names_and_messages_are_all_different() -> None:
    assert len({status.value.name for status in Status}) == len(Status)
    assert len({status.value.message for status in Status}) == len(Status)


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(ValueError, match="'done'"):
        Status.named("done")
