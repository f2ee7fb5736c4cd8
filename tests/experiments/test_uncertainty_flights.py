"""Flights of the uncertainty study: their spread with its interval, and normality."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from experiments.uncertainty_sources.flights import (
    CHEMICAL,
    INITIAL,
    SETS,
    TRANSLATION,
    dispersion,
    fly_paths,
    normality,
)
from scp_recon.mission.mission import Mission
from scp_recon.results.solution import Solution
from scp_recon.simulation.vehicle import Vehicle

# --- flights --------------------------------------------------------------------------------------


def test_paths_spread_as_the_linearised_flight_does(solution: Solution, vehicle: Vehicle) -> None:
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
    expected = {
        (INITIAL,): sensitivity[:6],
        (CHEMICAL,): sensitivity[6:],
        TRANSLATION: sensitivity,
    }
    for sources, factor in expected.items():
        found = fly_paths(solution, vehicle, sources, 4000, 1)
        rms = np.sqrt(np.sum(factor[:, :3] ** 2))
        # Curvature and 4000 flights leave some per cent.
        assert dispersion(found[:, :3] - ends[-1, :3]).value == pytest.approx(rms, rel=0.08)


def test_sets_are_the_vehicles_errors(vehicle: Vehicle) -> None:
    fields = type(vehicle.errors).model_fields  # a source's name, and its unit
    assert len(fields) == len(SETS["all"])
    assert all(sum(field.startswith(name) for field in fields) == 1 for name in SETS["all"])
    alone = [sources for sources in SETS.values() if len(sources) == 1]
    assert sorted(alone) == sorted((source,) for source in SETS["all"])


# --- their spread ---------------------------------------------------------------------------------


@pytest.mark.parametrize("flights", [3, 8])
@pytest.mark.parametrize("sigmas", [(1.0, 1.0, 1.0), (5.0, 1.0, 0.2)])
def test_intervals_of_the_dispersion_cover_as_often_as_they_say(
    sigmas: tuple[float, float, float], flights: int
) -> None:
    rng = np.random.default_rng(5)
    covariance = np.diag(np.square(sigmas))
    true = np.sqrt(np.trace(covariance))
    draws = multivariate_normal(cov=covariance).rvs((600, flights), random_state=rng)
    found = [dispersion(sample) for sample in draws]
    covered = np.mean([e.low <= true <= e.high for e in found])
    # Never too narrow, and somewhat too wide in three axes.
    assert 0.92 < covered < 0.999
    assert np.mean([e.value**2 for e in found]) == pytest.approx(true**2, rel=0.1)


def test_normality_knows_a_normal_sample_from_another() -> None:
    rng = np.random.default_rng(1)
    normal, skew = normality(rng.standard_normal(3000)), normality(rng.exponential(size=3000))
    assert normal.p_value > 0.01
    assert skew.p_value < 1e-20
    assert normal.correlation > 0.999 > skew.correlation
    assert len(normal.expected) == len(normal.observed) <= 199
    assert np.all(np.diff(normal.expected) > 0.0)
    assert normal.observed[0] < -2.5
    assert normal.observed[-1] > 2.5
