"""Rolling burns out over the grid, and making a step of the linear model dynamically exact."""

from __future__ import annotations

import numpy as np
import pytest

from formulations.linearisation import dynamics
from formulations.linearisation.linearisation import Linearisation, final_state_map, step_mean
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Plan
from tests.scp_recon.support import burns_of, fly


@pytest.fixture(scope="module")
def optimum(default_plan: Plan) -> Linearisation:
    return default_plan.final.result.lin


def test_rollout_is_the_flight_with_the_burns(mission: Mission, optimum: Linearisation) -> None:
    burns = optimum.iterate.burns * [[1.3], [0.5], [-1.0], [2.0]]
    rolled = mission.dynamics.rollout(mission.problem.initial_state, burns) * mission.units.state
    flown = fly(mission, burns_of(mission, burns), mission.times_s)
    np.testing.assert_allclose(rolled[:, :3], flown[:, :3], rtol=0.0, atol=5e-3)


def test_rollouts_of_many_flights_are_those_one_by_one(
    mission: Mission, optimum: Linearisation
) -> None:
    factors = np.array([0.5, 1.0, 1.5])
    burns = optimum.iterate.burns * factors[:, None, None]
    start = np.broadcast_to(mission.problem.initial_state, (3, 6))
    together = mission.dynamics.rollout(start, burns)
    assert together.shape == (len(mission.times_s), 3, 6)
    for n in range(3):
        alone = mission.dynamics.rollout(start[n], burns[n])
        np.testing.assert_allclose(together[:, n], alone, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("size", [1e-4, 1e-2, 0.1])
def test_a_flown_step_obeys_the_dynamics_and_ends_where_the_model_promised(
    mission: Mission, optimum: Linearisation, size: float
) -> None:
    change = np.random.default_rng(5).normal(scale=size, size=optimum.iterate.burns.shape)
    # Only steps that keep the final state of the linear model are proposed near a solution.
    jacobian = final_state_map(optimum)[1]
    change -= (np.linalg.pinv(jacobian) @ jacobian @ change.ravel()).reshape(change.shape)
    burns = optimum.iterate.burns + change
    promised = step_mean(optimum, burns)[-1]
    flown = mission.dynamics.close_defects(optimum, burns)
    assert np.abs(flown.defects[:-1]).max() < 1e-11
    np.testing.assert_allclose(flown.iterate.mean[-1], promised, rtol=0.0, atol=1e-9)
    # The correction is of second order in the step.
    assert np.abs(flown.iterate.burns - burns).max() < 100.0 * size**2


@pytest.mark.parametrize("size", [0.3, 3.0, 30.0, None])
def test_no_step_is_too_large_to_end_dynamically_exact(
    mission: Mission, optimum: Linearisation, size: float | None
) -> None:
    """From a flight, or from the straight line to the final state."""
    start, problem = optimum, mission.problem
    if size is None:
        start = mission.dynamics.linearise(problem, initial_guess.cold(mission))
        constant, jacobian = final_state_map(start)
        burns = np.linalg.lstsq(jacobian, problem.final_state - constant)[0].reshape(-1, 3)
    else:
        burns = optimum.iterate.burns + size
    flown = mission.dynamics.close_defects(start, burns)
    assert np.abs(flown.defects[:-1]).max() < 1e-9


def test_where_newton_s_method_does_not_converge_the_burns_are_rolled_out_as_they_are(
    mission: Mission, optimum: Linearisation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dynamics, "NEWTON_MAX", 1)
    burns = optimum.iterate.burns + 0.1
    flown = mission.dynamics.close_defects(optimum, burns)
    np.testing.assert_array_equal(flown.iterate.burns, burns)
    rolled = mission.dynamics.rollout(mission.problem.initial_state, burns)
    np.testing.assert_array_equal(flown.iterate.mean, rolled)
