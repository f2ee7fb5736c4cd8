"""Probability along lines: the laws, segments within limits, directions, forms of normal vectors."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import ndtr
from scipy.stats import chi, ncx2, norm

from formulations.arrays import Array
from formulations.risk.lines import (
    Chords,
    Directions,
    Segments,
    TwoSidedChiLaw,
    aimed_directions,
    kept_segments,
    normal_density,
    sphere_directions,
)
from formulations.risk.quadratic_forms import below, below_beyond
from tests.helpers import generators, random_rotation

dimensions = st.sampled_from([1, 2, 3, 6, 15, 60])
coordinates = st.floats(-40.0, 40.0)
LAWS = tuple(TwoSidedChiLaw(d) for d in (1, 2, 3, 15))
NAMES = ("chi1", "chi2", "chi3", "chi15")


def between(law: TwoSidedChiLaw, low: float, high: float) -> float:
    return law.between(np.array(low), np.array(high)).item()


def chi_between(dimension: int, low: float, high: float) -> float:
    """By SciPy, in the tail that loses no digits; half of the law on either side of the centre."""
    law = chi(dimension)
    if high < 0.0:
        low, high = -high, -low
    if low < 0.0:
        return 0.5 * float(law.cdf(-low) + law.cdf(high))
    return 0.5 * float(law.sf(low) - law.sf(high))


@given(dimensions, coordinates, coordinates)
def test_the_chi_law_is_scipys_in_both_tails(dimension, one, other):
    low, high = sorted([one, other])
    expected = chi_between(dimension, low, high)
    found = between(TwoSidedChiLaw(dimension), low, high)
    # A difference of tails errs by the rounding of the larger one.
    near = min(abs(low), abs(high))
    rounding = 1e-15 * (1.0 if low < 1.0 and high > -1.0 else float(chi(dimension).sf(near)))
    assert found == pytest.approx(expected, rel=1e-9, abs=rounding + 1e-300)


@pytest.mark.parametrize("law", LAWS, ids=NAMES)
def test_whole_line_has_probability_one_empty_zero(law):
    assert between(law, -np.inf, np.inf) == pytest.approx(1.0, abs=1e-15)
    assert between(law, -np.inf, 0.0) == pytest.approx(0.5, abs=1e-15)
    for s in (-np.inf, -1.0, 0.0, 2.0, np.inf):
        assert between(law, s, s) == 0.0
    tail = 0.5 * float(chi(law.dimension).sf(15.0))  # where 1 - F has no digits left
    for low, high in ((15.0, np.inf), (-np.inf, -15.0)):
        assert between(law, low, high) == pytest.approx(tail, rel=1e-9)


@given(st.sampled_from(LAWS), st.floats(-8.0, 8.0), st.floats(0.01, 6.0))
def test_the_density_integrates_to_the_law(law, low, width):
    high = low + width
    breaks = [0.0] if low < 0.0 < high else None
    found, _ = quad(lambda s: law.density(np.array(s)).item(), low, high, points=breaks)
    assert found == pytest.approx(between(law, low, high), rel=1e-8, abs=1e-14)


@pytest.mark.parametrize("law", LAWS, ids=NAMES)
def test_density_is_even_finite_and_vanishes(law):
    s = np.array([0.0, 1e-300, 1e-3, 1.0, 50.0, np.inf])
    density = law.density(s)
    if law.dimension == 1:
        np.testing.assert_allclose(density, normal_density(s), rtol=1e-12)
    np.testing.assert_array_equal(density, law.density(-s))
    assert np.isfinite(density).all()
    assert density[-1] == 0.0


GRID = np.linspace(-5.0, 5.0, 2001) + 1e-4


def some_intervals(rng: np.random.Generator, lines: int, count: int) -> tuple[Array, Array]:
    """Starts and ends; some empty, some of them half-lines or whole ones, some on top of others."""
    low = rng.integers(-8, 8, (count, lines)) / 2.0
    high = low + rng.integers(1, 12, (count, lines)) / 2.0
    low = np.where(rng.random(low.shape) < 0.15, -np.inf, low)
    high = np.where(rng.random(low.shape) < 0.15, np.inf, high)
    empty = rng.random(low.shape) < 0.15
    return np.where(empty, np.inf, low), np.where(empty, np.inf, high)


def chords(intervals: tuple[Array, Array], first: int = 0) -> Chords:
    """Of keep-outs that come after so many keep-ins, those that are not empty."""
    limit, line = np.nonzero(intervals[0] < np.inf)
    return Chords(first + limit, line, *(end[limit, line] for end in intervals))


def kept_of(segments: Segments, lines: int) -> Array:
    """How many segments hold each point of the grid, shape (lines, grid)."""
    held = np.zeros((lines, len(GRID)))
    for line, low, high in zip(segments.line, segments.low, segments.high, strict=True):
        held[line] += (low < GRID) & (high > GRID)
    return held


@given(generators, st.integers(0, 3), st.integers(0, 5))
def test_segments_satisfy_limits_and_name_their_ends(rng, inner, outer):
    lines = 6
    keep_in, keep_out = some_intervals(rng, lines, inner), some_intervals(rng, lines, outer)

    def within(intervals: tuple[Array, Array]) -> Array:
        low, high = (end[:, :, None] for end in intervals)
        return (low < GRID) & (high > GRID)

    expected = within(keep_in).all(axis=0) & ~within(keep_out).any(axis=0)
    found = kept_segments(keep_in, chords(keep_out, inner))
    np.testing.assert_array_equal(kept_of(found, lines), expected.astype(float))
    assert np.all(found.low < found.high)
    starts = np.vstack([keep_in[0], keep_out[1]])
    ends = np.vstack([keep_in[1], keep_out[0]])
    for values, limits, candidates in (
        (found.low, found.low_limit, starts),
        (found.high, found.high_limit, ends),
    ):
        met = limits >= 0
        np.testing.assert_array_equal(met, np.isfinite(values))
        named = candidates[limits[met], found.line[met]]
        np.testing.assert_array_equal(named, values[met])


LINES = 4096


@pytest.mark.parametrize("dimension", [3, 9, 15])
def test_even_directions_are_unit_vectors_spread_evenly(dimension):
    u, weight = sphere_directions(LINES, dimension)
    assert u.shape == (LINES, dimension)
    np.testing.assert_array_equal(weight, 1.0)
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(u.mean(axis=0), 0.0, atol=2e-3)
    np.testing.assert_allclose(u.T @ u / LINES, np.eye(dimension) / dimension, atol=5e-3)


def failing(directions: Directions, away: float) -> np.ndarray:
    """Probability of a half-space `away` standard deviations off, on each line."""
    along = np.maximum(np.abs(directions.unit[:, 0]), 1e-300)
    law = TwoSidedChiLaw(directions.unit.shape[1])
    return np.asarray(law.between(away / along, np.full(len(along), np.inf)))


@pytest.mark.parametrize("dimension", [6, 12])
@pytest.mark.parametrize("away", [2.3, 3.1, 4.3])
def test_aimed_directions_tell_a_half_spaces_probability(dimension, away):
    aimed = aimed_directions(LINES, dimension, lambda u: failing(u, away))
    assert aimed.weight.max() <= 2.0
    assert aimed.weight.mean() == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(np.linalg.norm(aimed.unit, axis=1), 1.0, rtol=1e-12)
    exact = norm.sf(away)
    found = float((aimed.weight * failing(aimed, away)).mean())
    assert found == pytest.approx(exact, rel=0.01 if dimension == 6 else 0.05)


def test_where_nothing_fails_directions_stay_even():
    aimed = aimed_directions(64, 4, lambda u: np.zeros(len(u.unit)))
    np.testing.assert_array_equal(aimed.unit, sphere_directions(64, 4).unit)


ERROR = 1e-7


def law(rng: np.random.Generator, n: int, slenderness: float = 30.0) -> tuple[Array, Array]:
    """Means (n, 3) and covariances (n, 3, 3) whose axes differ up to so many times."""
    sigma = np.exp(rng.uniform(0.0, np.log(slenderness), (n, 3)))
    turn = np.array([random_rotation(rng) for _ in range(n)])
    return sigma.max() * rng.normal(size=(n, 3)), (turn * sigma[:, None] ** 2) @ turn.swapaxes(1, 2)


@given(st.floats(0.05, 20.0), st.floats(0.0, 10.0), st.floats(-4.0, 4.0), generators)
def test_round_form_has_noncentral_chi_square_law(sigma, distance, deviations, rng):
    radius = max(distance + deviations * sigma, 0.1 * sigma)
    mean = distance * random_rotation(rng)[:1]
    found = below(np.eye(3)[None], mean, np.array([radius**2]), sigma**2 * np.eye(3)[None])
    law = ncx2(3, (distance / sigma) ** 2)
    assert found.below.item() == pytest.approx(law.cdf((radius / sigma) ** 2), abs=1e-8, rel=1e-5)
    assert found.above.item() == pytest.approx(law.sf((radius / sigma) ** 2), abs=1e-8, rel=1e-5)


@given(generators)
def test_a_form_of_one_coordinate_is_a_slab(rng):
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
def test_double_wedge_about_mean_has_its_angle(slope, rng):
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
def test_above_and_below_change_places_with_the_sign(rng):
    n = 10
    mean, covariance = law(rng, n)
    matrix = np.array([np.diag(rng.normal(size=3)) for _ in range(n)])
    level = np.einsum("ni,nij,nj->n", mean, matrix, mean) * rng.uniform(0.5, 1.5, n)
    one, other = (below(s * matrix, mean, s * level, covariance) for s in (1.0, -1.0))
    np.testing.assert_allclose(one.below, other.above, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(one.below + one.above, 1.0, rtol=0.0, atol=1e-15)


@given(generators)
def test_covariance_derivative_is_half_second_mean_derivative(rng):
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
