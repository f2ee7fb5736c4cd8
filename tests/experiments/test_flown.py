"""Flights by the simulation, tabulated and judged."""

import csv
from importlib.util import find_spec

import pytest

from experiments import flown
from experiments.__main__ import main
from scp_recon.errors import InputError
from scp_recon.simulation.record import Record, read_record
from tests.helpers import nightly
from tests.scp_recon.simulation.short_plan import SHORT, short_plan
from tests.scp_recon.support import mission_of


@pytest.mark.skipif(not find_spec("Basilisk"), reason="needs the extra [sim]")
@nightly
def test_a_short_flight_is_tabulated_and_judged(tmp_path, monkeypatch):
    """By the study of plans, and by policies beside one whose commands the thruster cannot give."""
    mission = mission_of(*SHORT)
    solution = short_plan(mission)
    monkeypatch.setattr(flown, "default_plan", lambda: solution)
    monkeypatch.setattr(flown, "SAMPLES", 500)
    monkeypatch.setattr(flown, "SEEDS", 1)
    assert main(["flown_plan", "--out", str(tmp_path)]) == 0
    with (tmp_path / "flown_plan.csv").open(encoding="utf-8", newline="") as file:
        (row,) = csv.DictReader(file)
    record = read_record(tmp_path / "seed_0")
    assert row["modes_hold"] == row["settled_in_time"] == "True"
    assert float(row["least_charge"]) == record.summary.least_charge > 0.3
    assert float(row["largest_sigma"]) == record.arrays["node_sigma_distance"].max()

    def simulate(_: object, *, seed: int, **__: object) -> Record:
        if seed:
            raise InputError("vehicle", "a burn", "must end before the mode does")
        return record

    monkeypatch.setattr(flown, "simulate", simulate)
    first, last = mission.schedule.window_s
    rows = [flown.fly_policy(solution, ("open", seed)) for seed in (0, 1)]
    assert rows[0]["window_s"] == last - first
    assert 0.0 <= rows[0]["observed_s"] <= last - first + 1e-6
    assert rows[0]["whole"] <= (rows[0]["observed_s"] > last - first - 1e-3)
    assert rows[0]["commanded_m_s"] == pytest.approx(solution.total_dv_m_s)
    assert "must end before" in rows[1]["shortfalls"]
    (summed,) = flown.by_policy(rows)
    assert (summed["flights"], summed["observed_mean_s"]) == (2, rows[0]["observed_s"])
    assert summed["as_required"] == (not rows[0]["shortfalls"])
