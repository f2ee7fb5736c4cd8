"""Probabilities beyond what an estimate tells are refused, before any work."""

from __future__ import annotations

from pathlib import Path

import pytest

from formulations.rows.flight_probability import PROBABILITY_MAX
from scp_recon.errors import InputError
from tests.scp_recon.support import mission_of, run_solve

WHOLE = ("risk.allocation=exact", "risk.scope=flight")


def test_more_of_whole_flights_than_directions_tell_is_refused() -> None:
    with pytest.raises(InputError) as error:
        mission_of(*WHOLE, "risk.p_chance=0.999999")
    assert error.value.entry == "risk.p_chance"
    assert error.value.given == "1 - 1e-06"
    assert "at most 1 - 1e-05" in error.value.allowed


def test_what_the_estimates_tell_may_be_asked() -> None:
    assert mission_of(*WHOLE, f"risk.p_chance={PROBABILITY_MAX}").scenario.risk.scope == "flight"
    mission_of("risk.allocation=exact", "risk.p_chance=0.999999999")


def test_the_command_says_so_in_one_message(tmp_path: Path) -> None:
    words = [word for entry in (*WHOLE, "risk.p_chance=0.99999999") for word in ("--set", entry)]
    run = run_solve(tmp_path / "out", *words, "--certify", "no")
    assert (run.exit_code, run.output) == (2, "")
    assert run.errors.count("error: ") == 1
    assert "risk.p_chance" in run.errors
    assert not (tmp_path / "out").exists()
