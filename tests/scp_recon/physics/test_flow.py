"""The flow map and its sensitivities, against SciPy, automatic differentiation and invariants."""

from functools import reduce

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from formulations.arrays import Array
from formulations.problem.expression_flow import ExpressionFlow
from scp_recon.mission.scene import RK4_STEP_MAX_S
from scp_recon.physics.flow import differentiate, interpolate, propagate
from scp_recon.physics.forces import ForceModel, acceleration
from tests.helpers import unit_vectors
from tests.scp_recon.support import COMPANION, burns_of, fly, integrate

ARC_S = 232.0
SUBSTEPS = 2


@pytest.fixture(scope="module")
def forces(mission) -> ForceModel:
    """Nondimensional, so that positions and velocities are of one size."""
    return mission.forces.in_units(mission.units.length_m, mission.units.time_s)


@pytest.fixture(scope="module")
def arc(mission) -> float:
    return ARC_S / mission.units.time_s


@st.composite
def states(draw: st.DrawFn) -> Array:
    """Bound and unbound states between half and twice the orbit's radius, nondimensional."""
    radius, speed = draw(st.floats(0.5, 2.0)), draw(st.floats(0.2, 1.8))
    return np.concatenate([radius * draw(unit_vectors()), speed * draw(unit_vectors())])


def surroundings(forces: ForceModel, t: ca.SX) -> list[list[ca.SX]]:
    """What `ForceModel.moment` gives, over symbols: the axes of the IAU, and Kepler's ellipse."""
    rows = [[ca.SX(0.0)] * 3] * 4
    if forces.field is not None:
        rotation = forces.field.rotation
        node, across, pole = rotation.equator
        w = rotation.meridian + rotation.rate * t + 0.5 * rotation.acceleration * t**2
        x, y = ca.cos(w) * node + ca.sin(w) * across, ca.cos(w) * across - ca.sin(w) * node
        rows[:3] = [ca.vertsplit(x), ca.vertsplit(y), [ca.SX(part) for part in pole]]
    if (other := forces.companion) is not None:
        mean, e = other.mean_anomaly + other.rate * t, other.eccentricity
        anomaly = reduce(lambda found, _: mean + e * ca.sin(found), range(30), mean)
        along = (ca.cos(anomaly) - e, np.sqrt(1.0 - e**2) * ca.sin(anomaly))
        place = sum(part * axis for part, axis in zip(along, other.axes, strict=True))
        rows[3] = ca.vertsplit(other.semi_major_axis * place)
    return rows


@pytest.mark.slow
@pytest.mark.parametrize(
    "entries", [{}, {"body.planned_degree": 4}, {"body.companion": COMPANION}], ids=str
)
def test_expression_of_same_forces_gives_same_flow(entries, mission, default_plan):
    if entries:
        mission = mission.changed(entries)
    flow, rng = mission.flow, np.random.default_rng(0)
    starts = default_plan.final.result.lin.iterate.mean[:-1] * rng.uniform(0.7, 1.5, (flow.arcs, 6))
    times, forces = mission.times_s / mission.units.time_s, flow.forces

    def rate(r: ca.SX, _v: ca.SX, t: ca.SX, _p: ca.SX) -> tuple[ca.SX, ...]:
        return acceleration(r[0], r[1], r[2], forces, surroundings(forces, t))

    other = ExpressionFlow(rate, times, substeps=flow.substeps)
    ours, theirs = flow.differentiate(starts), other.differentiate(starts)
    for name in ("state", "stm", "tensor"):
        expected = getattr(ours, name)
        assert getattr(theirs, name) == pytest.approx(expected, rel=1e-12, abs=1e-13), name
    assert other.propagate(starts, 3) == pytest.approx(flow.propagate(starts, 3), rel=1e-12)


@given(state=states(), seed=st.integers(0, 2**32 - 1))
def test_a_small_move_needs_no_new_derivatives(state, forces, arc, seed):
    deviation = 1e-8 * np.random.default_rng(seed).standard_normal((1, 6))
    there = differentiate(state[None] + deviation, np.array([arc]), forces, SUBSTEPS)
    here = differentiate(state[None], np.array([arc]), forces, SUBSTEPS).moved(deviation)
    np.testing.assert_allclose(here.state, there.state, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(here.stm, there.stm, rtol=0.0, atol=1e-6)


QUICK_ORBIT = np.array([0.6, 0.1, -0.2, -0.3, 1.0, 0.5])
"""Low and fast, so that the scheme's error stands far above roundoff; nondimensional."""


def test_flow_converges_with_the_fourth_power(forces, arc):
    """Each halving of the step divides the error by about 2^4, down to roundoff."""
    truth = integrate(forces, QUICK_ORBIT, [0.0, 6.0 * arc], rtol=1e-13)[-1]
    flown = [propagate(QUICK_ORBIT, 6.0 * arc, forces, n) for n in (2, 4, 8, 16)]
    errors = np.abs(np.array(flown) - truth).max(axis=1)
    above_roundoff = errors[:-1] > 1e-11
    assert above_roundoff.any()
    assert np.all((errors[:-1] / errors[1:])[above_roundoff] > 10.0)


def test_planner_stays_within_a_millimetre(mission, default_plan):
    lin = default_plan.final.result.lin
    flown = fly(mission, burns_of(mission, lin.iterate.burns), mission.times_s)
    planned = lin.iterate.mean * mission.units.state
    assert np.linalg.norm(planned[:, :3] - flown[:, :3], axis=1).max() < 1e-3
    assert np.linalg.norm(planned[:, 3:] - flown[:, 3:], axis=1).max() < 1e-6
    assert np.diff(mission.times_s).max() / mission.arc_substeps <= RK4_STEP_MAX_S


@given(state=states(), u=st.floats(0.0, 1.0))
def test_interpolation_is_as_good_as_the_steps(state, u, forces, arc):
    end = propagate(state, arc, forces)
    position, velocity = interpolate((state[:3], state[3:]), (end[:3], end[3:]), arc, u)
    inside = propagate(state, u * arc, forces, 8)
    # The fourth derivative is a'' v v + a' a, at most 6 v^2 / r^4 + 2 / r^5 and a little for J2:
    # 480 where an arc begins half a unit from the centre at speed 1.8 and falls for its length.
    # A cubic misses h^4 / 384 of it, and less than h^3 / 60 in velocities.
    assert position == pytest.approx(inside[:3], abs=550.0 * arc**4 / 384.0)
    assert velocity == pytest.approx(inside[3:], abs=550.0 * arc**3 / 60.0)
