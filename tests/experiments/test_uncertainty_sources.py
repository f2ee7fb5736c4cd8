"""The uncertainty study: its verdicts, and the command."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from experiments.__main__ import main
from experiments.uncertainty_sources import flights
from experiments.uncertainty_sources.flights import (
    ATTITUDE,
    NO_ERRORS,
    STATE,
    TRANSLATION,
)
from experiments.uncertainty_sources.study import (
    BOTH,
    Measured,
    claims,
    measure_flights,
    measure_paths,
)
from scp_recon.results.solution import Solution
from scp_recon.simulation.vehicle import Vehicle

from .support import flown, simulated


def study(*words: str) -> int:
    """The command."""
    return main(["uncertainty_sources", *words])


# --- verdicts -------------------------------------------------------------------------------------


def entries(solution: Solution, vehicle: Vehicle, attitude_m: float) -> list[Measured]:
    found = measure_paths(solution, vehicle, 300, 0)
    flights = [flown(NO_ERRORS, 0, (0.0,) * 6)]
    flights += [
        flown("attitude", seed, attitude_m * np.random.default_rng(seed).normal(size=6))
        for seed in range(20)
    ]
    return [*found.values(), *measure_flights(flights, solution).values()]


@pytest.mark.parametrize(("attitude_m", "holds"), [(0.5, True), (100.0, False)])
def test_the_attitude_may_be_left_out_only_while_it_is_small(
    solution: Solution, vehicle: Vehicle, attitude_m: float, holds: bool
) -> None:
    found = claims(entries(solution, vehicle, attitude_m))
    (claim,) = (c for c in found if c.claim.startswith("the path may be planned without"))
    assert claim.holds is holds


# --- the command ----------------------------------------------------------------------------------


def test_the_command_measures_every_set(
    solution: Solution, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flights, "fly_spacecraft", simulated)
    solution.write(tmp_path)
    out = tmp_path / "out"
    words = ["--solution", str(tmp_path), "--out", str(out), "--paths", "500", "--flights", "10"]
    assert study(*words) == 0
    with (out / "uncertainty_sources.csv").open(encoding="utf-8") as file:
        table = {row["source"]: row for row in csv.DictReader(file)}
    assert set(table) == {"none", *ATTITUDE, "attitude", *TRANSLATION, BOTH, "all"}
    for error_sources, row in table.items():
        assert float(row["rms_m_low"]) <= float(row["rms_m"])
        few = 1 if error_sources == "none" else 10
        assert int(row["flights"]) == (500 if error_sources in (*TRANSLATION, BOTH) else few)
    assert float(table["imu"]["attitude_error_deg"]) == pytest.approx(np.rad2deg(1e-4))
    with (out / "uncertainty_flights.csv").open(encoding="utf-8") as file:
        written = list(csv.DictReader(file))
    assert len(written) == 61
    assert set(STATE) <= set(written[0])
    assert "## Alone, from the largest" in (out / "uncertainty_sources.md").read_text("utf-8")
