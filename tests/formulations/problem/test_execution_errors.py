"""Columns of the burns' errors: their derivative, their product, what they forbid, what is drawn."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formulations.arrays import Array
from formulations.nlp.covariance import own_covariance, shared_columns
from formulations.problem.execution_errors import (
    VANISHED,
    ComponentwiseErrors,
    ExecutionErrors,
    GatesErrors,
    skew,
)
from tests.helpers import generators, random_unit, share_of_examples

few = settings(max_examples=share_of_examples(3))

fractions = st.just(0.0) | st.floats(1e-3, 0.3)
sizes = st.just(0.0) | st.floats(1e-3, 0.1)
gates = st.builds(GatesErrors, sizes, fractions, sizes, fractions, fractions)
models = gates | st.builds(ComponentwiseErrors, fractions)


def burns_about(rng: np.random.Generator, errors: ExecutionErrors) -> Array:
    """Burns of every size that a model treats in its own way, none right where it changes."""
    bound = getattr(errors, "fixed_bound", 0.0) or 1e-2
    shares = np.array([0.3 * VANISHED, 0.9 * VANISHED, 3 * VANISHED, 0.3, 0.8, 3.0, 30.0])
    return bound * shares[:, None] * random_unit(rng, len(shares))


def product(columns: Array) -> Array:
    return columns @ columns.swapaxes(1, 2)


def printed(errors: GatesErrors, burns: Array) -> Array:
    """Gates' covariance as printed, the bias with it."""
    size2 = np.einsum("mi,mi->m", burns, burns)[:, None, None]
    along = burns[:, :, None] * burns[:, None, :] / size2
    e = errors
    magnitude = e.magnitude_fixed**2 + (e.magnitude_proportional**2 + e.magnitude_bias**2) * size2
    pointing = e.pointing_fixed**2 + e.pointing_proportional**2 * size2
    return magnitude * along + pointing * (np.eye(3) - along)


@given(models, generators)
def test_the_jacobian_is_the_derivative_by_finite_differences(errors, rng):
    burns = burns_about(rng, errors)
    found = errors.jacobian(burns)
    assert found.shape == (len(burns), 3, errors.shared + errors.own, 3)
    step = 1e-6 * np.linalg.norm(burns, axis=1)[:, None]
    ends = [[errors.columns(burns + s * step * axis) for s in (1, -1)] for axis in np.eye(3)]
    slopes = np.stack([(a - b) / (2 * step[:, :, None]) for a, b in ends], axis=-1)
    np.testing.assert_allclose(found, slopes, rtol=1e-6, atol=1e-6 * (1e-9 + np.abs(slopes).max()))


@given(gates, generators)
def test_burn_errs_by_gates_above_fixed_error(errors, rng):
    burns = (errors.fixed_bound + rng.uniform(1e-3, 1.0, (5, 1))) * random_unit(rng, 5)
    np.testing.assert_allclose(
        product(errors.columns(burns)), printed(errors, burns), rtol=1e-9, atol=1e-15
    )
    if errors.affine:
        twice = errors.columns(2.0 * burns)
        np.testing.assert_allclose(twice, 2.0 * errors.columns(burns), rtol=1e-12)
    cross = np.cross(burns, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(skew(burns) @ [1.0, 2.0, 3.0], cross, atol=1e-14)


@given(gates, generators, st.floats(1.0, 2e3))
def test_executed_burn_errs_at_least_by_gates(errors, rng, share):
    """An isotropic bound near zero, where nothing depends on where the burn points."""
    bound = errors.fixed_bound or 1e-2
    burns = share * VANISHED * bound * random_unit(rng, 3)
    extra = product(errors.columns(burns)) - printed(errors, burns)
    assert np.linalg.eigvalsh(extra).min() >= -1e-12
    first = product(replace(errors, magnitude_bias=0.0).columns(1.001 * burns / share))
    isotropic = np.broadcast_to(errors.fixed_bound**2 * np.eye(3), first.shape)
    np.testing.assert_allclose(first, isotropic, rtol=1e-4, atol=1e-9)


@given(gates, generators)
def test_a_burn_that_has_vanished_has_no_error(errors, rng):
    assert not errors.columns(np.zeros((1, 3))).any()
    burns = 1e-3 * VANISHED * (errors.fixed_bound or 1e-2) * random_unit(rng, 1)
    # The slope of the fixed part is sqrt(3) there.
    assert np.linalg.norm(errors.columns(burns)[0], 2) <= 2e-3 * (errors.fixed_bound or 1e-2)


@few
@given(gates.filter(lambda errors: not errors.affine), generators)
def test_the_spread_does_not_jump_anywhere(errors, rng):
    """On a ray from zero, across both places where the columns are written in another way."""
    share = np.sort(np.r_[np.geomspace(1e-2 * VANISHED, 3.0, 300), VANISHED, 1.0])
    share = np.repeat(share, 2) * np.tile([1 - 1e-9, 1 + 1e-9], len(share))
    burns = errors.fixed_bound * share[:, None] * random_unit(rng, 1)
    spread = np.linalg.eigvalsh(product(errors.columns(burns)))[:, ::2]
    either = spread.reshape(-1, 2, 2)
    assert np.abs(either[:, 0] - either[:, 1]).max() < 1e-7 * errors.fixed_bound**2


@given(gates, generators)
def test_otherwise_are_the_vanished_burns_each_executed(errors, rng):
    burns = burns_about(rng, errors)
    others = list(errors.alternatives(burns))
    assert len(others) == (0 if errors.affine else 2)
    for i, other in enumerate(others):
        columns = other.columns(burns)
        assert np.array_equal(np.delete(columns, i, 0), np.delete(errors.columns(burns), i, 0))
        excess = product(columns)[i] - product(errors.columns(burns))[i]
        assert np.linalg.eigvalsh(excess)[0] >= -1e-12
        assert not list(other.alternatives(np.delete(burns, 1 - i, 0))) or i == 1
    assert not list(ComponentwiseErrors(0.1).alternatives(burns))


@few
@given(models, generators)
def test_the_nonlinear_program_has_the_same_covariance(errors, rng):
    burn = ca.MX.sym("v", 3)
    parts = [own_covariance(errors, burn), shared_columns(errors, burn)]
    function = ca.Function("errors", [burn], parts)
    shared = errors.shared
    for v in burns_about(rng, errors):
        ours = errors.columns(v[None])[0]
        covariance, common = (np.array(part) for part in function(v))
        expected, scale = ours[:, shared:] @ ours[:, shared:].T, 1e-12 + np.abs(ours).max() ** 2
        np.testing.assert_allclose(covariance, expected, atol=1e-10 * scale)
        np.testing.assert_allclose(common, ours[:, :shared], atol=1e-15)


@pytest.mark.parametrize(
    "errors",
    [
        GatesErrors(0.02, 0.1, 0.05, 0.2, 0.3),
        GatesErrors(0.0, 0.1, 0.0, 0.2),
        ComponentwiseErrors(0.1),
    ],
    ids=["gates", "proportional", "componentwise"],
)
def test_sampled_errors_have_the_covariance_of_the_columns(errors):
    """Of all burns at once, what they share between them included: large, small and vanished."""
    rng = np.random.default_rng(0)
    burns = np.array([1.0, 0.03, 0.0])[:, None] * random_unit(rng, 3)
    n = 100_000
    drawn = (errors.execute(burns, rng.standard_normal((n, errors.draws(3)))) - burns).reshape(n, 9)
    columns = errors.columns(burns)
    together = np.zeros((9, errors.draws(3)))
    for i, each in enumerate(columns):
        together[3 * i : 3 * i + 3, : errors.shared] = each[:, : errors.shared]
        own = errors.shared + errors.own * i
        together[3 * i : 3 * i + 3, own : own + errors.own] = each[:, errors.shared :]
    expected = together @ together.T
    sigma = np.sqrt(np.diag(expected))
    # An entry of a sampled covariance scatters by at most sqrt(2 / n) of the product of its sigmas.
    scatter = np.outer(sigma, sigma) * np.sqrt(2.0 / n)
    assert (np.abs(drawn.T @ drawn / n - expected) <= 5.0 * scatter + 1e-15).all()
    assert (np.abs(drawn.mean(axis=0)) <= 5.0 * sigma / np.sqrt(n) + 1e-15).all()
