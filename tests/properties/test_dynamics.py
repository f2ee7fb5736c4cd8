"""Invariants of the flow map on random arcs, and its two arithmetics against each other."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from formulations.arrays import Array
from scp_recon.physics.flow import differentiate, propagate
from scp_recon.physics.forces import ForceModel, acceleration, gravity_curvature, gravity_gradient
from scp_recon.physics.harmonics import HarmonicField
from tests.helpers import generators, random_unit

SUBSTEPS = 32
"""With arcs of at most 0.3 units of time, a Runge-Kutta error below the tolerances here."""

arcs = st.floats(0.01, 0.3)


@st.composite
def models(draw: st.DrawFn) -> ForceModel:
    """A unit point mass with oblateness up to twice Bennu's, and light pressure, in any direction."""
    rng = draw(generators)
    strength = draw(st.floats(0.0, 0.01))
    return ForceModel(
        1.0, strength, random_unit(rng), draw(st.floats(0.0, 0.05)) * random_unit(rng)
    )


@st.composite
def orbits(draw: st.DrawFn) -> Array:
    """States from which no arc comes nearer to the centre than half a unit, bound or not."""
    rng = draw(generators)
    radius, speed = draw(st.floats(0.9, 2.0)), draw(st.floats(0.0, 1.0))
    return np.concatenate([radius * random_unit(rng), speed * random_unit(rng)])


def potential(state: Array, forces: ForceModel) -> float:
    """Negative potential energy; the gradient of it is the acceleration."""
    r, along = np.linalg.norm(state[:3]), state[:3] @ forces.pole
    oblate = forces.j2_strength / 3.0 * (1.0 / r**3 - 3.0 * along**2 / r**5)
    return float(forces.gm / r + oblate + forces.srp @ state[:3])


@given(orbits(), arcs, models())
def test_energy_is_conserved(state: Array, duration: float, forces: ForceModel) -> None:
    after = propagate(state, duration, forces, SUBSTEPS)
    gained = 0.5 * (after[3:] @ after[3:] - state[3:] @ state[3:])
    gained -= potential(after, forces) - potential(state, forces)
    assert abs(gained) < 1e-8


@given(orbits(), arcs, models())
def test_the_stm_is_symplectic_without_radiation_pressure(
    state: Array, duration: float, forces: ForceModel
) -> None:
    dark = replace(forces, srp=np.zeros(3))
    stm = differentiate(state[None], np.array([duration]), dark, SUBSTEPS).stm[0]
    form = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.eye(3), np.zeros((3, 3))]])
    np.testing.assert_allclose(stm.T @ form @ stm, form, rtol=0.0, atol=1e-7)


@given(orbits(), arcs, models())
def test_the_flow_composed_with_its_inverse_is_the_identity(
    state: Array, duration: float, forces: ForceModel
) -> None:
    there = propagate(state, duration, forces, SUBSTEPS)
    np.testing.assert_allclose(
        propagate(there, -duration, forces, SUBSTEPS), state, rtol=0.0, atol=1e-8
    )


@given(orbits(), models())
def test_the_gradient_is_symmetric_and_trace_free_and_the_second_derivative_symmetric(
    state: Array, forces: ForceModel
) -> None:
    position = state[None, :3]
    gradient, second = gravity_gradient(position, forces), gravity_curvature(position, forces)
    size = np.abs(gradient).max(), np.abs(second).max()
    np.testing.assert_allclose(gradient, gradient.swapaxes(1, 2), rtol=0, atol=1e-13 * size[0])
    assert abs(np.trace(gradient[0])) < 1e-12 * size[0]
    for axes in ((0, 1, 3, 2), (0, 2, 1, 3), (0, 3, 2, 1)):
        np.testing.assert_allclose(second, second.transpose(axes), rtol=0, atol=1e-12 * size[1])


@given(orbits(), arcs, models())
def test_the_second_order_tensor_of_an_arc_is_symmetric(
    state: Array, duration: float, forces: ForceModel
) -> None:
    tensor = differentiate(state[None], np.array([duration]), forces, 4).tensor[0]
    np.testing.assert_allclose(
        tensor, tensor.transpose(0, 2, 1), rtol=0.0, atol=1e-12 * np.abs(tensor).max()
    )


@given(orbits(), models())
def test_numpy_and_casadi_see_the_same_forces(state: Array, forces: ForceModel) -> None:
    x = ca.SX.sym("x", 3)
    pull = ca.vertcat(*acceleration(x[0], x[1], x[2], forces))
    function = ca.Function("f", [x], [pull, ca.jacobian(pull, x)])
    theirs, their_gradient = (np.array(part) for part in function(state[:3]))
    ours, gradient = acceleration(*state[:3], forces), gravity_gradient(state[None, :3], forces)
    np.testing.assert_allclose(np.stack(ours), theirs[:, 0], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(gradient[0], their_gradient, rtol=1e-11, atol=1e-13)


@given(generators, st.floats(350.0, 3000.0), st.floats(0.0, 0.1))
def test_j2_is_degree_two_of_the_harmonics(
    rng: np.random.Generator, radius: float, j2: float
) -> None:
    gm, reference = 4.89, 290.0
    c, s = np.zeros((3, 3)), np.zeros((3, 3))
    c[0, 0], c[2, 0] = 1.0, -j2
    field = HarmonicField(gm, reference, c, s)
    forces = ForceModel(gm, 1.5 * gm * j2 * reference**2, np.array([0.0, 0.0, 1.0]), np.zeros(3))
    x, y, z = radius * random_unit(rng)
    theirs = field.acceleration(np.array(x), np.array(y), np.array(z))
    np.testing.assert_allclose(acceleration(x, y, z, forces), theirs, rtol=1e-10, atol=1e-18)
