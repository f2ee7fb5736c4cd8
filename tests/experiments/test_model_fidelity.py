"""The fidelity study: its flights against independent ones, its rule, and the command."""

import numpy as np
import pytest

from experiments.model_fidelity.models import (
    BURNS,
    GRAVITY,
    SRP,
    Choices,
    Firing,
    Flight,
    Model,
    fly,
    passing,
    relapses,
)
from experiments.model_fidelity.study import Compared, compare
from formulations.arrays import Array
from scp_recon.physics.flow import propagate
from scp_recon.results.solution import ballistic_arc
from scp_recon.simulation.vehicle import load_vehicle
from tests.helpers import nightly

from .support import session_in

THRUST_M_S2 = 1.0 / 178.0


@pytest.fixture(scope="module")
def flight(mission) -> Flight:
    return Flight.of("ballistic arc", ballistic_arc(mission), mission, load_vehicle())


@pytest.fixture(scope="module")
def compared(flight, tmp_path_factory) -> list[Compared]:
    with session_in(tmp_path_factory.mktemp("fidelity")) as session:
        return compare(flight, session, session.store())


class Nothing:
    def acceleration(self, *position: Array) -> tuple[Array, ...]:
        return tuple(0.0 * x for x in position)


def test_the_planners_model_is_flown_to_a_millimetre(mission, flight):
    """Against the planner's own equations, integrated by Runge and Kutta in steps of 20 s."""
    choices = Choices.of(flight)
    model = choices.model({SRP: "cannonball", GRAVITY: "J2", BURNS: "impulsive"})
    end = mission.times_s[-1:]
    found = fly(mission, flight.burns_m_s, model, end, thrust_acceleration_m_s2=THRUST_M_S2)
    state = mission.initial_state + np.r_[np.zeros(3), flight.burns_m_s[0]]
    expected = propagate(state, float(end[0]), mission.forces, 1742)
    np.testing.assert_allclose(found[0, :3], expected[:3], atol=1e-3)
    np.testing.assert_allclose(found[0, 3:], expected[3:], atol=1e-7)


@pytest.mark.parametrize(
    ("firing", "lead_s"), [(Firing(False), 0.0), (Firing(False, 0.5), 0.5), (Firing(True), 0.5)]
)
def test_in_empty_space_a_burn_acts_from_its_middle(mission, firing, lead_s):
    """An impulse at the start is ahead of a finite burn by half of its length times the velocity."""
    times = np.array([0.0, 3000.0, 20_000.0])
    burns = np.array([[0.1, 0.0, 0.0], [0.0, 0.05, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    model = Model(Nothing(), lambda _: np.zeros(3), firing)
    found = fly(mission, burns, model, times, thrust_acceleration_m_s2=THRUST_M_S2)
    lengths = np.array([0.1, 0.05]) / THRUST_M_S2
    start = mission.initial_state
    np.testing.assert_allclose(found[0], start)
    for state, time in zip(found[1:], times[1:], strict=True):
        acting = np.maximum(time - np.array([0.0, 8000.0]) - lead_s * lengths, 0.0)
        expected = start[:3] + time * start[3:] + np.r_[0.1 * acting[0], 0.05 * acting[1], 0.0]
        np.testing.assert_allclose(state[:3], expected, atol=1e-6)


def test_the_lowest_fidelity_within_the_limit_is_named():
    names = ["crude", "better", "good", "truth"]
    distance = {"crude": 30.0, "better": 9.9, "good": 12.0}
    assert passing(names, distance, 10.0) == "better"
    assert relapses(names, distance, 10.0) == ["good"]
    assert passing(names, dict.fromkeys(distance, 11.0), 10.0) == "truth"
    assert passing(names, dict.fromkeys(distance, 10.0), 10.0) == "truth"


@nightly
def test_distances_on_the_arc(compared, flight):
    """Orders of magnitude that follow from the forces alone; no light pressure shifts by 10 m."""
    assert len(compared) == 2 + len(list(Choices.of(flight).single()))
    end = {entry.model: entry.terminal_m for entry in compared}
    assert end["none"] == pytest.approx(10.0, abs=1.0)
    assert end["cannonball"] < 0.2 * end["none"]
    # Half of the firing's length times the burn, 0.45 m, carried on.
    assert 0.3 < end["impulsive"] < 3.0
    assert end["impulsive, mid-firing"] < 1e-3
    degrees = [end[f"degree {n}"] for n in (0, 2, 3, 4, 6)]
    assert degrees == sorted(degrees, reverse=True)
    assert end["degree 0"] == end["degree 1"]
    # The planner's whole model is no further off than its parts together.
    planner = compared[-1]
    assert planner.model == "cannonball, J2, impulsive"
    assert planner.passes
    assert planner.terminal_m <= sum(end[m] for m in planner.model.split(", ")) + 0.1
