"""Covariance lifting: the factor is the covariance, and its affine map is the derivative."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from formulations.arrays import Array, Indices
from formulations.linearisation.factor import propagate_factor
from formulations.linearisation.linearisation import (
    Linearisation,
    LinearisationError,
    Sensitivity,
    condense,
    final_state_map,
    step_mean,
)
from formulations.problem.execution_errors import GatesErrors
from formulations.problem.flyby import FlybyProblem, Iterate, Legs, factor_columns_used
from tests.helpers import Arcs, Flyby, generators, random_flyby


@st.composite
def some_flybys(draw: st.DrawFn, curvature: float = 0.1) -> Flyby:
    """Of two to four burns, the first of them at once or after a coast."""
    coast, burns, free = draw(st.integers(0, 3)), draw(st.integers(2, 4)), draw(st.integers(1, 4))
    rng, nodes = draw(generators), coast + burns + free
    return random_flyby(rng, nodes=nodes, burns=burns, curvature=curvature, coast=coast)


flybys = some_flybys()
GATES = GatesErrors(0.03, 0.05, 0.01, 0.04, 0.06)
curvatures = st.booleans()


def close(found: Array, expected: Array | float, rel: float = 1e-9, size: float = 1e-11) -> None:
    """Up to the rounding of a product of a dozen matrices of order one."""
    np.testing.assert_allclose(found, expected, rtol=rel, atol=size)


def covariance(factor: Array) -> Array:
    return factor @ factor.swapaxes(-1, -2)


def applied(sensitivity: Sensitivity, burns: Array) -> tuple[Array, Array]:
    """Mean and factor of the affine map."""
    s, z = sensitivity, burns.ravel()
    return s.mean_constant + s.mean_jacobian @ z, s.factor_constant + s.factor_jacobian @ z


def nonlinear(flyby: Flyby, burns: Array, defects: Array | float = 0.0) -> tuple[Array, Array]:
    """Mean and factor of the arcs themselves."""
    mean = flyby.waves.rollout(flyby.problem, burns, defects).mean
    stm = flyby.waves.derivatives(mean[:-1]).stm
    return mean, factor_of(flyby.problem, stm, burns)


def factor_of(problem: FlybyProblem, stm: Array, burns: Array) -> Array:
    """The factor for the arcs' STMs, without corrections."""
    every = problem.legs.compose(stm)
    return propagate_factor(problem, every, Iterate(burns, np.zeros((len(every), 6)))).factor


def some_burns(rng: np.random.Generator, problem: FlybyProblem) -> Array:
    return rng.normal(size=(problem.n_burns, 3))


def some_nodes(rng: np.random.Generator, problem: FlybyProblem) -> Indices:
    """Where legs start, and some others."""
    others = rng.choice(problem.n_nodes, int(rng.integers(0, problem.n_nodes)), replace=False)
    return np.union1d(problem.leg_starts, others)


@given(flybys, generators)
def test_the_factors_square_obeys_the_covariance_recursion(flyby, rng):
    problem, burns = flyby.problem, some_burns(rng, flyby.problem)
    stm = rng.normal(size=(problem.n_nodes - 1, 6, 6))
    lifted = covariance(factor_of(problem, stm, burns))
    errors, expected = problem.execution_errors, covariance(problem.initial_factor)
    for k in range(problem.n_nodes):
        if k > 0:
            expected = stm[k - 1] @ expected @ stm[k - 1].T
        for burn in burns[problem.burn_nodes == k]:
            expected[3:, 3:] += covariance(errors.columns(burn[None])[0])
        close(lifted[k], expected, 1e-9, 1e-9 * np.abs(expected).max())


@given(flybys, generators)
def test_columns_left_out_are_zero_in_the_positions(flyby, rng):
    lin = flyby.perturbed(rng, 0.3, 0.1)
    count = int(rng.integers(1, flyby.problem.n_nodes))
    nodes = np.sort(rng.choice(flyby.problem.n_nodes, count, replace=False))
    used = factor_columns_used(flyby.problem, nodes)
    s = condense(lin)
    for part in (lin.factor, s.factor_constant, s.factor_jacobian):
        assert not np.any(part[nodes, :3, used:])


@given(flybys)
def test_columns_used_are_initial_and_earlier_burns(flyby):
    problem = flyby.problem
    initial = problem.initial_factor.shape[1]
    assert np.array_equal(problem.leg_starts, np.union1d([0], problem.burn_nodes))
    assert problem.coasts == len(problem.leg_starts) - problem.n_burns
    assert np.array_equal(problem.legs.ends, problem.leg_starts[1:])
    assert factor_columns_used(problem, np.zeros(0, dtype=np.intp)) == initial
    for node in range(problem.n_nodes):
        before = int((problem.burn_nodes < node).sum())
        assert factor_columns_used(problem, np.array([0, node])) == initial + 3 * before


@given(flybys, st.sampled_from([None, GATES]), generators)
def test_condense_is_the_derivative_by_the_burns(flyby, gates, rng):
    """Also where burns share a bias, and have errors of a fixed size."""
    if gates:
        flyby = replace(flyby, problem=replace(flyby.problem, execution_errors=gates))
    lin = flyby.perturbed(rng, 0.3, 0.0)
    s, h = condense(lin), 1e-5
    direction = some_burns(rng, flyby.problem)
    step = h * direction
    ahead, behind = (nonlinear(flyby, lin.iterate.burns + x) for x in (step, -step))
    mean, factor = ((a - b) / (2.0 * h) for a, b in zip(ahead, behind, strict=True))
    # Truncation and rounding of the central difference are both of order 1e-10; a small burn's
    # errors of a fixed size bend faster.
    close(s.mean_jacobian @ direction.ravel(), mean, 1e-7, 1e-8)
    fixed = 1e-4 * (1.0 + np.abs(factor).max()) if gates else 1e-8
    close(s.factor_jacobian @ direction.ravel(), factor, 1e-7, fixed)
    close(applied(s, lin.iterate.burns)[1], lin.factor)


@given(flybys, st.sampled_from([0.0, 0.1]), curvatures, generators)
def test_model_error_is_quadratic_without_curvature_linear(flyby, defect, curvature, rng):
    """Of mean and factor, part of the way along a step that moves burns and closes all defects."""
    lin = flyby.perturbed(rng, 0.3, defect)
    burns, step = lin.iterate.burns, some_burns(rng, flyby.problem)
    start = lin.iterate.mean, lin.factor
    model = applied(condense(lin, curvature=curvature), burns + step)
    errors = []
    for t in (1e-3, 1e-4):
        truth = nonlinear(flyby, burns + t * step, (1.0 - t) * lin.defects[:-1])
        parts = zip(start, model, truth, strict=True)
        errors.append([np.linalg.norm(x0 + t * (x1 - x0) - x) for x0, x1, x in parts])
    assert np.min(errors[0]) > 1e-10  # so that an order can be observed
    mean, factor = np.log10(np.divide(*errors))
    assert mean >= 1.8
    assert factor >= 1.8 if curvature else factor <= 1.2


@given(flybys, generators)
def test_without_curvature_factor_has_iterates_stms(flyby, rng):
    lin = flyby.perturbed(rng, 0.3, 0.1)
    burns = some_burns(rng, flyby.problem)
    _, factor = applied(condense(lin, curvature=False), burns)
    expected = factor_of(flyby.problem, lin.arcs.stm, burns)
    close(factor, expected)


@given(flybys, generators)
def test_condensed_means_close_every_defect(flyby, rng):
    lin = flyby.perturbed(rng, 0.3, 0.1)
    burns, s = some_burns(rng, flyby.problem), condense(lin)
    constant, jacobian = final_state_map(lin)
    close(constant, s.mean_constant[-1])
    close(jacobian, s.mean_jacobian[-1])
    mean = step_mean(lin, burns)
    close(mean, applied(s, burns)[0])
    start = flyby.problem.initial_state.copy()
    start[3:] += burns[0] * (flyby.problem.burn_nodes[0] == 0)
    close(mean[0], start)
    linear = np.einsum("kij,kj->ki", lin.arcs.stm, mean[:-1] - lin.iterate.mean[:-1])
    defects = flyby.problem.defects(Iterate(burns, mean), lin.arcs.state + linear)
    assert defects[:-1] == pytest.approx(0.0, abs=1e-9)
    assert defects[-1] == pytest.approx(mean[-1] - flyby.problem.final_state)


@given(flybys, generators)
def test_maps_from_leg_starts_compose_condensed_map(flyby, rng):
    """As the lifted form has them: from the states where a leg starts, after its burn."""
    lin, problem = flyby.perturbed(rng, 0.3, 0.1), flyby.problem
    burns = some_burns(rng, problem)
    means, factors = applied(condense(lin), burns)
    starts = problem.leg_starts[problem.legs.of]
    off = np.column_stack([means - lin.iterate.mean, np.ones(problem.n_nodes)])[starts]
    kicks = burns - lin.iterate.burns
    for k in range(1, problem.n_nodes):
        mean = lin.iterate.mean[k] + lin.affine_map_from_last_burn[k, :6] @ off[k]
        factor = lin.stm_from_last_burn[k] @ factors[starts[k]]
        factor += (lin.bent[k] @ off[k]) @ lin.factor[starts[k]]
        for i in np.flatnonzero(problem.burn_nodes == k):
            mean[3:] += kicks[i]
            columns = problem.execution_errors.columns(burns[i : i + 1])[0]
            factor[3:, problem.columns_of_burn(i)] += columns
        close(mean, means[k])
        close(factor, factors[k])


@given(flybys, st.sampled_from(["state", "stm", "tensor"]), st.sampled_from([np.nan, np.inf]))
def test_dynamics_without_finite_derivatives_have_no_affine_map(flyby, part, value):
    iterate = flyby.waves.rollout(flyby.problem, flyby.burns)
    arcs: Arcs = flyby.waves.derivatives(iterate.mean[:-1])
    broken = getattr(arcs, part).copy()
    broken[-1] = value
    with np.errstate(invalid="ignore"):
        lin = Linearisation(flyby.problem, iterate, replace(arcs, **{part: broken}))
        with pytest.raises(LinearisationError, match="no finite derivatives"):
            condense(lin)


@given(st.integers(2, 60), st.integers(0, 6), st.integers(1, 7), generators)
def test_legs_compose_the_arcs_since_the_last_burn(n_nodes, between, size, rng):
    inner = rng.choice(np.arange(1, n_nodes - 1), min(between, n_nodes - 2), replace=False)
    burns = np.unique([0, *inner, n_nodes - 1])
    maps = rng.normal(size=(n_nodes - 1, size, size)) / np.sqrt(size)
    legs = Legs(n_nodes, burns)
    composed = legs.compose(maps)
    product = np.eye(size)
    assert np.array_equal(composed[0], product)
    for k in range(1, n_nodes):
        product = maps[k - 1] @ (np.eye(size) if k - 1 in burns else product)
        close(composed[k], product, 1e-9, 1e-11)
        assert burns[legs.of[k]] == burns[burns < k].max()
    assert np.array_equal(legs.ends, burns[1:])


@given(flybys, generators)
def test_condensing_some_nodes_is_condensing_all_and_choosing(flyby, rng):
    lin, nodes = flyby.perturbed(rng, 0.3, 0.1), some_nodes(rng, flyby.problem)
    every, some, mean = condense(lin), condense(lin, nodes), condense(lin, nodes, factor=False)
    for name in Sensitivity.__annotations__:
        close(getattr(some, name), getattr(every, name)[nodes])
    assert np.array_equal(mean.mean_jacobian, some.mean_jacobian)
    assert mean.factor_jacobian.shape[2] == mean.factor_constant.shape[2] == 0
