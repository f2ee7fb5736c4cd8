"""Studies of the spacecraft: cones of too little power, uncertainty, flights by policy, durations."""

import csv
from importlib.util import find_spec

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from experiments import flown
from experiments.__main__ import main
from experiments.left_out import SAMPLES, dispersion, find_cones
from scp_recon.errors import InputError
from scp_recon.simulation.guidance import SolarArray, irradiance
from scp_recon.simulation.record import Record, read_record
from scp_recon.simulation.vehicle import Vehicle, load_vehicle
from tests.helpers import nightly
from tests.scp_recon.simulation.short_plan import SHORT, short_plan
from tests.scp_recon.support import mission_of

needs_basilisk = pytest.mark.skipif(not find_spec("Basilisk"), reason="needs the extra [sim]")


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    return load_vehicle()


@pytest.fixture(scope="module")
def panels(mission, vehicle) -> SolarArray:
    return SolarArray.of(vehicle, irradiance(mission.scenario))


# --- battery cones --------------------------------------------------------------------------------


def test_panels_have_their_peak_powers(panels):
    """Peaks of SP1 to SP5 by areas of 0.0286, 0.0676 and 0.36 m^2, 30 % cells and 1332 W/m^2."""
    assert panels.peak_w == pytest.approx([11.4, 27.0, 27.0, 143.9, 143.9], abs=0.05)
    sun = -np.eye(3)[0]
    assert panels.generation(sun).sum() == pytest.approx(299.2, abs=0.2)
    assert np.linalg.norm(panels.best_direction()) == pytest.approx(300.4, abs=0.2)


def test_cones_are_the_papers_and_hold_their_samples(panels):
    cones = find_cones(0)
    most = np.linalg.norm(panels.best_direction())
    assert [cone["load_w"] for cone in cones] == 2 * [115.0, 90.0]
    for cone in cones:
        half = np.deg2rad(cone["half_angle_deg"])
        if cone["calibrated"]:
            assert cone["half_angle_deg"] == pytest.approx(cone["paper_deg"], abs=0.2)
        else:
            assert np.sin(half) * most == pytest.approx(cone["load_w"])
        share = 1.0 - np.cos(half)
        # Five standard deviations, as a wrong share would miss by more.
        spread = np.sqrt(share * (1.0 - share) / SAMPLES)
        assert cone["sampled_fraction"] == pytest.approx(share, abs=5.0 * spread)


# --- sources of uncertainty -----------------------------------------------------------------------


@pytest.mark.parametrize("flights", [3, 8])
@pytest.mark.parametrize("sigmas", [(1.0, 1.0, 1.0), (5.0, 1.0, 0.2)])
def test_intervals_of_dispersion_cover_the_truth(sigmas, flights):
    rng = np.random.default_rng(5)
    covariance = np.diag(np.square(sigmas))
    true = np.sqrt(np.trace(covariance))
    draws = multivariate_normal(cov=covariance).rvs((600, flights), random_state=rng)
    found = [dispersion(sample) for sample in draws]
    covered = np.mean([e.low <= true <= e.high for e in found])
    # Never too narrow, and somewhat too wide in three axes.
    assert 0.92 < covered < 0.999
    assert np.mean([e.value**2 for e in found]) == pytest.approx(true**2, rel=0.1)


# --- flights by the simulation --------------------------------------------------------------------


@needs_basilisk
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
