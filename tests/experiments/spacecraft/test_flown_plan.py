import csv
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("Basilisk", reason="needs the extra [sim]")

from experiments.__main__ import main
from experiments.in_flight import flown_policies
from experiments.spacecraft import flown_plan
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.results.solution import Solution
from scp_recon.simulation.record import Record, read_record
from tests.helpers import nightly
from tests.scp_recon.simulation.short_plan import SHORT, short_plan
from tests.scp_recon.support import mission_of

pytestmark = pytest.mark.slow


def study(*words: str) -> int:
    return main(["flown_plan", *words])


@pytest.fixture(scope="module", autouse=True)
def few_samples() -> Iterator[None]:
    """Beside the flight; what is tested here does not depend on their number."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flown_plan, "SAMPLES", 500)
        yield


@pytest.fixture(scope="module")
def mission() -> Mission:
    return mission_of(*SHORT)


@pytest.fixture(scope="module")
def flown(mission, tmp_path_factory) -> tuple[Solution, Path]:
    solution, out = short_plan(mission), tmp_path_factory.mktemp("flown")
    solution.write(out)
    assert study(str(out), "--out", str(out), "--seeds", "1") == 0
    return solution, out


@nightly
def test_the_table_is_what_the_flight_says(flown):
    _, out = flown
    with (out / "flown_plan.csv").open(encoding="utf-8", newline="") as file:
        (row,) = csv.DictReader(file)
    record = read_record(out / "seed_0")
    assert row["modes_hold"] == row["settled_in_time"] == "true"
    # The short plan allows 650 s for a slew, which its longest takes nearly.
    assert 600.0 < max(leg.settled_s or 0.0 for leg in record.summary.legs) < 650.0
    executed = [burn.executed_pointing_deg for burn in record.summary.burns]
    assert float(row["burn_executed_max_deg"]) == max(executed) < 0.5
    assert float(row["least_charge"]) == record.summary.least_charge > 0.3
    assert float(row["camera_max_deg"]) == record.summary.window_pointing_deg.camera.q100
    assert float(row["terminal_sigma"]) == record.arrays["node_sigma_distance"][-1]
    assert "positions at all nodes" in (
        out / "position_against_the_planned_covariance.csv"
    ).read_text("utf-8")


@nightly
def test_flights_by_policy_are_judged_and_summed_up(flown, mission, monkeypatch):
    """Of the flight that was flown, and of one whose commands the thruster cannot give."""
    solution, out = flown
    record = read_record(out / "seed_0")

    def simulate(_: object, *, seed: int, **__: object) -> Record:
        if seed:
            raise InputError("vehicle", "a burn", "must end before the mode does")
        return record

    monkeypatch.setattr(flown_policies, "simulate", simulate)
    plans = {"short": solution}
    rows = [flown_policies.fly_policy(plans, None, ("short", "open", seed)) for seed in (0, 1)]
    first, last = mission.schedule.window_s
    assert rows[0]["window_s"] == last - first
    assert 0.0 <= rows[0]["observed_s"] <= last - first + 1e-6
    assert rows[0]["whole"] <= (rows[0]["observed_s"] > last - first - 1e-3)
    assert rows[0]["commanded_m_s"] == pytest.approx(solution.total_dv_m_s)
    assert "must end before" in rows[1]["shortfalls"]
    (summed,) = flown_policies.by_policy(rows)
    assert (summed["flights"], summed["observed_mean_s"]) == (2, rows[0]["observed_s"])
    assert summed["as_required"] == (not rows[0]["shortfalls"])
