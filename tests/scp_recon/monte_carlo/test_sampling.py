"""Sampled flights: the right distribution, the right dynamics, and no dependence on how many."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest, norm

from formulations.arrays import Array
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo import sampling
from scp_recon.monte_carlo.estimates import proportion
from scp_recon.monte_carlo.sampling import BLOCK, fly_block, sample_positions
from scp_recon.planning.initial_guess import from_burns
from scp_recon.results.solution import Solution
from tests.scp_recon.support import fly, integrate, mission_of

LOOK = np.array([0.0, 8000.0, 13_140.5, 25_000.0, 34_842.0])


@pytest.fixture(scope="module")
def burns(solution: Solution) -> Array:
    return solution.burns_m_s


def test_flights_do_not_depend_on_how_many_are_flown_and_no_two_are_the_same(
    mission: Mission, burns: Array
) -> None:
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    few = sample_positions(mission, burns, LOOK, 500, 0)
    many = sample_positions(mission, burns, LOOK, 1500, 0)
    assert few.shape == (len(LOOK), 500, 3)
    assert many.shape == (len(LOOK), 1500, 3)
    np.testing.assert_array_equal(few, many[:, :500])
    # Blocks and seeds draw different numbers, and none of NumPy's global ones.
    other = sample_positions(mission, burns, LOOK[:1], 500, 1)[0]
    assert BLOCK < 1500
    assert len(np.unique(np.vstack([many[0], other]), axis=0)) == 2000
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002


def test_looking_more_often_does_not_change_the_flights(mission: Mission, burns: Array) -> None:
    rarely = sample_positions(mission, burns, LOOK[-1:], 50, 0)[-1]
    often = sample_positions(mission, burns, np.linspace(0.0, LOOK[-1], 700), 50, 0)[-1]
    np.testing.assert_allclose(rarely, often, rtol=0.0, atol=1e-2)


def test_without_uncertainty_every_flight_is_the_planned_one(burns: Array) -> None:
    certain = mission_of("uncertainty.initial_sigma_fraction=0", "uncertainty.execution_error=0")
    positions = sample_positions(certain, burns, LOOK, 3, 0)
    look = np.union1d(LOOK, certain.scenario.burns.times_s)
    planned = fly(certain, burns, look)[np.searchsorted(look, LOOK), :3]
    for flight in range(3):
        np.testing.assert_allclose(positions[:, flight], planned, rtol=0.0, atol=1e-3)


def test_each_flight_is_that_of_an_adaptive_integration(mission: Mission, burns: Array) -> None:
    times = np.array(mission.scenario.burns.times_s)
    flights = fly_block(mission, burns, times, 0, flights=4)
    for flight in range(4):
        for leg in range(len(times) - 1):
            end = integrate(mission.forces, flights.states[leg, flight], times[leg : leg + 2])[-1]
            end[3:] += flights.burns_m_s[flight, leg + 1]
            arrived = flights.states[leg + 1, flight]
            np.testing.assert_allclose(arrived[:3], end[:3], rtol=0.0, atol=5e-3)
            np.testing.assert_allclose(arrived[3:], end[3:], rtol=0.0, atol=1e-6)


def test_the_time_step_is_fine_enough(
    mission: Mission, burns: Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    coarse = sample_positions(mission, burns, LOOK, 200, 0)
    monkeypatch.setattr(sampling, "RK4_STEP_MAX_S", 30.0)
    fine = sample_positions(mission, burns, LOOK, 200, 0)
    assert np.linalg.norm(coarse - fine, axis=2).max() < 1e-2


def assert_white(standard: Array) -> None:
    """Independent components, each normal with a deviation of one."""
    for component in standard.T:
        assert kstest(component, "norm").pvalue > 1e-4
    correlation = np.corrcoef(standard.T) - np.eye(standard.shape[1])
    assert np.abs(correlation).max() < 5.0 / np.sqrt(BLOCK)


def test_initial_states_and_burns_err_as_specified(mission: Mission, burns: Array) -> None:
    x0 = mission.initial_state
    flown = fly_block(mission, np.zeros((4, 3)), LOOK[:1], 0).states[0]
    assert_white((flown - x0) / (0.01 * np.abs(x0)))
    executed = fly_block(mission, burns, LOOK[:1], 0).burns_m_s
    assert_white(((executed / burns - 1.0) / 0.08).reshape(BLOCK, 12))


@pytest.mark.parametrize("sigmas", [-1.0, 0.0, 0.5, 1.5])
def test_a_known_probability_is_in_the_interval(
    mission: Mission, burns: Array, sigmas: float
) -> None:
    """At t = 0 a plane is on one side of the flights with a probability that is known exactly."""
    positions = sample_positions(mission, burns, LOOK[:1], 4000, 0)[0]
    normal = np.array([2.0, -1.0, 2.0]) / 3.0
    mean = normal @ mission.initial_state[:3]
    sigma = np.linalg.norm(normal * mission.initial_sigma[:3])
    estimate = proportion(int((positions @ normal <= mean + sigmas * sigma).sum()), 4000)
    assert estimate.low < norm.cdf(sigmas) < estimate.high


def test_sampled_covariance_is_the_predicted_one_where_errors_are_small(burns: Array) -> None:
    """With a hundredth of the uncertainty the spread is linear, and its covariance exact."""
    small = mission_of(
        "uncertainty.initial_sigma_fraction=0.0001", "uncertainty.execution_error=0.0008"
    )
    lin = small.dynamics.linearise(small.problem, from_burns(small, burns))
    factor = lin.factor * small.units.state[:, None]
    samples = 4 * BLOCK
    for node in (int(small.window_nodes[-1]), len(small.times_s) - 1):
        look = small.times_s[[node]]
        states = np.concatenate(
            [fly_block(small, burns, look, block).states[0] for block in range(4)]
        )
        predicted = factor[node] @ factor[node].T
        whiten = np.linalg.inv(np.linalg.cholesky(predicted))
        white = (states - lin.iterate.mean[node] * small.units.state) @ whiten.T
        # Entries of a sampled covariance of N white samples scatter by sqrt(2 / N) at most.
        error = white.T @ white / samples - np.eye(6)
        assert np.abs(error).max() < 5.0 * np.sqrt(2.0 / samples)
        assert np.abs(white.mean(axis=0)).max() < 5.0 / np.sqrt(samples)
