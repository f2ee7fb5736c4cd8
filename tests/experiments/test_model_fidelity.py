"""The fidelity study: its flights against independent ones, its rule, and its distances."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experiments.left_out import (
    BURNS,
    GRAVITY,
    PLANNER,
    SRP,
    flight_plan,
    fly,
    models_of,
)
from scp_recon.physics.flow import propagate
from scp_recon.results.solution import ballistic_arc
from scp_recon.simulation.guidance import FlightPlan
from scp_recon.simulation.vehicle import load_vehicle

THRUST_M_S2 = 1.0 / 178.0


@pytest.fixture(scope="module")
def arc(mission) -> FlightPlan:
    return flight_plan(ballistic_arc(mission), mission, load_vehicle())


def test_planners_model_is_flown_to_a_millimetre(mission, arc):
    """Against the planner's own equations, integrated by Runge and Kutta in steps of 20 s."""
    models, burns = models_of(arc), np.array([firing.dv_m_s for firing in arc.firings])
    model: dict[str, Any] = {effect: models[effect][name] for effect, name in PLANNER.items()}
    end_s = float(mission.times_s[-1])
    found = fly(mission, burns, model, end_s, thrust_m_s2=THRUST_M_S2)
    state = mission.initial_state + np.r_[np.zeros(3), burns[0]]
    expected = propagate(state, end_s, mission.forces, 1742)
    np.testing.assert_allclose(found[:3], expected[:3], atol=1e-3)
    np.testing.assert_allclose(found[3:], expected[3:], atol=1e-7)


@pytest.mark.parametrize(("late", "lead_s"), [(0.0, 0.0), (0.5, 0.5), (None, 0.5)])
def test_burn_acts_from_its_middle(mission, late, lead_s):
    """In empty space an impulse leads a finite burn by half of its length times the velocity."""
    burns = np.array([[0.1, 0.0, 0.0], [0.0, 0.05, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    nothing = SimpleNamespace(acceleration=lambda *_: np.zeros(3))
    model: dict[str, Any] = {GRAVITY: nothing, SRP: lambda _: np.zeros(3), BURNS: late}
    lengths, start = np.array([0.1, 0.05]) / THRUST_M_S2, mission.initial_state
    for time in (3000.0, 20_000.0):
        found = fly(mission, burns, model, time, thrust_m_s2=THRUST_M_S2)
        acting = np.maximum(time - np.array([0.0, 8000.0]) - lead_s * lengths, 0.0)
        expected = start[:3] + time * start[3:] + np.r_[0.1 * acting[0], 0.05 * acting[1], 0.0]
        np.testing.assert_allclose(found[:3], expected, atol=1e-6)
