"""Quadratic forms of a normal vector against laws in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr
from scipy.stats import ncx2

from formulations.arrays import Array
from formulations.risk.quadratic_forms import below, below_beyond
from tests.helpers import generators, random_rotation

ERROR = 1e-7


def law(rng: np.random.Generator, n: int, slenderness: float = 30.0) -> tuple[Array, Array]:
    """Means (n, 3) and covariances (n, 3, 3) whose axes differ up to so many times."""
    sigma = np.exp(rng.uniform(0.0, np.log(slenderness), (n, 3)))
    turn = np.array([random_rotation(rng) for _ in range(n)])
    return sigma.max() * rng.normal(size=(n, 3)), (turn * sigma[:, None] ** 2) @ turn.swapaxes(1, 2)


@given(st.floats(0.05, 20.0), st.floats(0.0, 10.0), st.floats(-4.0, 4.0), generators)
def test_a_round_form_has_the_noncentral_chi_square_law(
    sigma: float, distance: float, deviations: float, rng: np.random.Generator
) -> None:
    radius = max(distance + deviations * sigma, 0.1 * sigma)
    mean = distance * random_rotation(rng)[:1]
    found = below(np.eye(3)[None], mean, np.array([radius**2]), sigma**2 * np.eye(3)[None])
    law = ncx2(3, (distance / sigma) ** 2)
    assert found.below.item() == pytest.approx(law.cdf((radius / sigma) ** 2), abs=1e-8, rel=1e-5)
    assert found.above.item() == pytest.approx(law.sf((radius / sigma) ** 2), abs=1e-8, rel=1e-5)


@given(generators)
def test_a_form_of_one_coordinate_is_a_slab(rng: np.random.Generator) -> None:
    """|a'x| < b, whatever the law is like in other directions."""
    n = 10
    mean, covariance = law(rng, n)
    a, b = rng.normal(size=(n, 3)), rng.uniform(0.5, 20.0, n)
    found = below(a[:, :, None] * a[:, None], mean, b**2, covariance)
    centre = np.einsum("ni,ni->n", a, mean)
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", a, covariance, a))
    slab = ndtr((b - centre) / sigma) - ndtr((-b - centre) / sigma)
    np.testing.assert_allclose(found.below, slab, rtol=0.0, atol=ERROR)


@given(st.floats(0.05, 20.0), generators)
def test_a_double_wedge_about_the_mean_has_its_angle(
    slope: float, rng: np.random.Generator
) -> None:
    """|u| < slope |v| of independent coordinates has the share 2 atan(slope) / pi; a side has half."""
    turn = random_rotation(rng)
    form = turn[0][:, None] * turn[0] - slope**2 * turn[1][:, None] * turn[1]
    mean, covariance = np.zeros((1, 3)), np.eye(3)[None]
    found = below(form[None], mean, np.zeros(1), covariance)
    share = 2.0 * np.arctan(slope) / np.pi
    assert found.below.item() == pytest.approx(share, abs=1e-5)
    side = below_beyond(form[None], mean, turn[None, 1], covariance)
    assert side.below.item() == pytest.approx(0.5 * share, abs=1e-5)


@given(generators)
def test_above_and_below_change_places_with_the_sign(rng: np.random.Generator) -> None:
    n = 10
    mean, covariance = law(rng, n)
    matrix = np.array([np.diag(rng.normal(size=3)) for _ in range(n)])
    level = np.einsum("ni,nij,nj->n", mean, matrix, mean) * rng.uniform(0.5, 1.5, n)
    one, other = (below(s * matrix, mean, s * level, covariance) for s in (1.0, -1.0))
    np.testing.assert_allclose(one.below, other.above, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(one.below + one.above, 1.0, rtol=0.0, atol=1e-15)


@given(generators)
def test_the_derivative_in_the_covariance_is_half_the_second_in_the_mean(
    rng: np.random.Generator,
) -> None:
    """The heat equation, and the derivative in the mean by differences of values."""
    mean, covariance = law(rng, 1, 5.0)
    radius = np.linalg.norm(mean, axis=1) + 2.0
    step = 1e-3
    moves = step * np.concatenate([np.eye(3), -np.eye(3)])
    sphere, six = np.eye(3)[None], np.zeros(6, dtype=np.intp)
    found = below(sphere, mean, radius**2, covariance)
    moved = below(sphere[six], mean + moves, radius[six] ** 2, covariance[six])
    slope = (moved.below[:3] - moved.below[3:]) / (2.0 * step)
    np.testing.assert_allclose(found.by_mean[0], slope, rtol=0.0, atol=1e-5)
    bend = (moved.by_mean[:3] - moved.by_mean[3:]) / (2.0 * step)
    np.testing.assert_allclose(found.by_covariance[0], 0.5 * bend, rtol=0.0, atol=1e-5)
