"""The uncertainty study: flights of each source, their spread, normality, and its verdicts."""

import csv

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from experiments.__main__ import main
from experiments.spacecraft.flown_plan import sample_distances
from experiments.spacecraft.uncertainty_sources import flights
from experiments.spacecraft.uncertainty_sources.flights import (
    ATTITUDE,
    CHEMICAL,
    INITIAL,
    NO_ERRORS,
    STATE,
    TRANSLATION,
    dispersion,
    fly_paths,
    normality,
)
from experiments.spacecraft.uncertainty_sources.study import (
    BOTH,
    Measured,
    claims,
    measure_flights,
    measure_paths,
)
from scp_recon.mission.mission import Mission
from scp_recon.results.solution import Solution
from scp_recon.simulation.vehicle import Vehicle, load_vehicle
from tests.experiments.support import flown, simulated
from tests.scp_recon.simulation.short_plan import SHORT, short_plan
from tests.scp_recon.support import mission_of

pytestmark = pytest.mark.slow


def study(*words: str) -> int:
    return main(["uncertainty_sources", *words])


def entries(solution: Solution, vehicle: Vehicle, attitude_m: float) -> list[Measured]:
    found = measure_paths(solution, vehicle, 300, 0)
    flights = [flown(NO_ERRORS, 0, (0.0,) * 6)]
    flights += [
        flown("attitude", seed, attitude_m * np.random.default_rng(seed).normal(size=6))
        for seed in range(20)
    ]
    return [*found.values(), *measure_flights(flights, solution).values()]


@pytest.mark.parametrize(("attitude_m", "holds"), [(0.5, True), (100.0, False)])
def test_the_attitude_may_be_left_out_only_while_it_is_small(solution, vehicle, attitude_m, holds):
    found = claims(entries(solution, vehicle, attitude_m))
    (claim,) = (c for c in found if c.claim.startswith("the path may be planned without"))
    assert claim.holds is holds


def test_the_command_measures_every_set(solution, tmp_path, monkeypatch):
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


def test_paths_spread_as_the_linearised_flight_does(solution, vehicle):
    """Finite differences of the end by each error, times the errors' sigmas."""
    mission = Mission.from_scenario(solution.scenario)
    units, step = mission.units, 1e-4
    sigma = vehicle.errors.initial_state * np.abs(mission.initial_state)
    # The draws come in the order: initial state, then a factor for each burn.
    starts = np.vstack([np.diag(step * sigma), np.zeros((5, 6))]) + mission.initial_state
    factors = np.vstack([np.zeros((6, 4)), step * np.eye(4), np.zeros((1, 4))])
    burns = solution.burns_m_s * (1.0 + vehicle.errors.chemical_thruster * factors[:, :, None])
    ends = mission.dynamics.rollout(starts / units.state, burns / units.speed_m_s)[-1] * units.state
    sensitivity = (ends[:-1] - ends[-1]) / step
    expected = {(INITIAL,): sensitivity[:6], (CHEMICAL,): sensitivity[6:], TRANSLATION: sensitivity}
    for sources, factor in expected.items():
        found = fly_paths(solution, vehicle, sources, 4000, 1)
        rms = np.sqrt(np.sum(factor[:, :3] ** 2))
        # Curvature and 4000 flights leave some per cent.
        assert dispersion(found[:, :3] - ends[-1, :3]).value == pytest.approx(rms, rel=0.08)


@pytest.mark.parametrize("flights", [3, 8])
@pytest.mark.parametrize("sigmas", [(1.0, 1.0, 1.0), (5.0, 1.0, 0.2)])
def test_intervals_of_the_dispersion_cover_as_often_as_they_say(sigmas, flights):
    rng = np.random.default_rng(5)
    covariance = np.diag(np.square(sigmas))
    true = np.sqrt(np.trace(covariance))
    draws = multivariate_normal(cov=covariance).rvs((600, flights), random_state=rng)
    found = [dispersion(sample) for sample in draws]
    covered = np.mean([e.low <= true <= e.high for e in found])
    # Never too narrow, and somewhat too wide in three axes.
    assert 0.92 < covered < 0.999
    assert np.mean([e.value**2 for e in found]) == pytest.approx(true**2, rel=0.1)


def test_normality_knows_a_normal_sample_from_another():
    rng = np.random.default_rng(1)
    normal, skew = normality(rng.standard_normal(3000)), normality(rng.exponential(size=3000))
    assert normal.p_value > 0.01
    assert skew.p_value < 1e-20
    assert normal.correlation > 0.999 > skew.correlation
    assert len(normal.expected) == len(normal.observed) <= 199
    assert np.all(np.diff(normal.expected) > 0.0)
    assert normal.observed[0] < -2.5
    assert normal.observed[-1] > 2.5


SPREAD_M = 10.0
"""Of every position in the short plan's covariance."""


def test_samples_spread_as_paths_with_the_same_errors_do():
    mission, vehicle = mission_of(*SHORT), load_vehicle()
    solution = short_plan(mission)
    fraction = solution.scenario.uncertainty.initial_sigma_fraction
    errors = vehicle.errors.model_copy(update={"initial_state": fraction})
    erring = vehicle.model_copy(update={"errors": errors})
    ends = fly_paths(solution, erring, TRANSLATION, 3000, 7) - solution.nodes.state[-1]
    expected = np.linalg.norm(ends[:, :3], axis=1) / SPREAD_M
    found = sample_distances(solution, vehicle, 3000)
    assert found.shape == (3000, len(solution.nodes.t_s))
    assert np.std(found[:, -1]) == pytest.approx(np.std(expected), rel=0.1)
    assert np.mean(found[:, -1]) == pytest.approx(np.mean(expected), rel=0.05)
    first = np.sqrt(np.mean(found[:, 0] ** 2))
    assert first == pytest.approx(np.linalg.norm(mission.initial_sigma[:3]) / SPREAD_M, rel=0.05)
