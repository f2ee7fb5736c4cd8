"""Laws along lines against SciPy's, and kept segments against points along the lines."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import chi, norm

from formulations.arrays import Array
from formulations.risk.lines import Segments, TwoSidedChiLaw, kept_segments, normal_density
from tests.helpers import generators

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


# --- laws ---------------------------------------------------------------------------------------


@given(coordinates)
def test_the_normal_density_is_scipys(s: float) -> None:
    assert normal_density(np.array(s)).item() == pytest.approx(norm.pdf(s), rel=1e-12, abs=1e-300)


@given(dimensions, coordinates, coordinates)
def test_the_chi_law_is_scipys_in_both_tails(dimension: int, one: float, other: float) -> None:
    low, high = sorted([one, other])
    expected = chi_between(dimension, low, high)
    found = between(TwoSidedChiLaw(dimension), low, high)
    # A difference of tails errs by the rounding of the larger one.
    near = min(abs(low), abs(high))
    rounding = 1e-15 * (1.0 if low < 1.0 and high > -1.0 else float(chi(dimension).sf(near)))
    assert found == pytest.approx(expected, rel=1e-9, abs=rounding + 1e-300)


@pytest.mark.parametrize("law", LAWS, ids=NAMES)
def test_all_of_a_law_is_one_and_none_of_it_nothing(law: TwoSidedChiLaw) -> None:
    assert between(law, -np.inf, np.inf) == pytest.approx(1.0, abs=1e-15)
    assert between(law, -np.inf, 0.0) == pytest.approx(0.5, abs=1e-15)
    for s in (-np.inf, -1.0, 0.0, 2.0, np.inf):
        assert between(law, s, s) == 0.0
    tail = 0.5 * float(chi(law.dimension).sf(15.0))  # where 1 - F has no digits left
    for low, high in ((15.0, np.inf), (-np.inf, -15.0)):
        assert between(law, low, high) == pytest.approx(tail, rel=1e-9)


@given(st.sampled_from(LAWS), st.floats(-8.0, 8.0), st.floats(0.01, 6.0))
def test_the_density_integrates_to_the_law(law: TwoSidedChiLaw, low: float, width: float) -> None:
    high = low + width
    breaks = [0.0] if low < 0.0 < high else None
    found, _ = quad(lambda s: law.density(np.array(s)).item(), low, high, points=breaks)
    assert found == pytest.approx(between(law, low, high), rel=1e-8, abs=1e-14)


@pytest.mark.parametrize("law", LAWS, ids=NAMES)
def test_the_density_is_even_and_finite_and_vanishes_at_infinity(law: TwoSidedChiLaw) -> None:
    s = np.array([0.0, 1e-300, 1e-3, 1.0, 50.0, np.inf])
    density = law.density(s)
    if law.dimension == 1:
        np.testing.assert_allclose(density, normal_density(s), rtol=1e-12)
    np.testing.assert_array_equal(density, law.density(-s))
    assert np.isfinite(density).all()
    assert density[-1] == 0.0


# --- segments -----------------------------------------------------------------------------------

GRID = np.linspace(-5.0, 5.0, 2001) + 1e-4


def some_intervals(rng: np.random.Generator, lines: int, count: int) -> tuple[Array, Array]:
    """Starts and ends; some empty, some of them half-lines or whole ones, some on top of others."""
    low = rng.integers(-8, 8, (lines, count)) / 2.0
    high = low + rng.integers(1, 12, (lines, count)) / 2.0
    low = np.where(rng.random(low.shape) < 0.15, -np.inf, low)
    high = np.where(rng.random(low.shape) < 0.15, np.inf, high)
    empty = rng.random(low.shape) < 0.15
    return np.where(empty, np.inf, low), np.where(empty, np.inf, high)


def kept_of(segments: Segments, lines: int) -> Array:
    """How many segments hold each point of the grid, shape (lines, grid)."""
    held = np.zeros((lines, len(GRID)))
    for line, low, high in zip(segments.line, segments.low, segments.high, strict=True):
        held[line] += (low < GRID) & (high > GRID)
    return held


@given(generators, st.integers(0, 3), st.integers(0, 5))
def test_segments_are_where_all_limits_hold(
    rng: np.random.Generator, inner: int, outer: int
) -> None:
    lines = 6
    keep_in, keep_out = some_intervals(rng, lines, inner), some_intervals(rng, lines, outer)

    def within(intervals: tuple[Array, Array]) -> Array:
        low, high = (end[:, :, None] for end in intervals)
        return (low < GRID) & (high > GRID)

    expected = within(keep_in).all(axis=1) & ~within(keep_out).any(axis=1)
    np.testing.assert_array_equal(
        kept_of(kept_segments(keep_in, keep_out), lines), expected.astype(float)
    )


@given(generators, st.integers(0, 3), st.integers(0, 5))
def test_the_ends_of_a_segment_are_those_of_the_limits_named(
    rng: np.random.Generator, inner: int, outer: int
) -> None:
    keep_in, keep_out = some_intervals(rng, 6, inner), some_intervals(rng, 6, outer)
    found = kept_segments(keep_in, keep_out)
    assert np.all(found.low < found.high)
    starts = np.hstack([keep_in[0], keep_out[1]])
    ends = np.hstack([keep_in[1], keep_out[0]])
    for values, limits, candidates in (
        (found.low, found.low_limit, starts),
        (found.high, found.high_limit, ends),
    ):
        met = limits >= 0
        np.testing.assert_array_equal(met, np.isfinite(values))
        named = candidates[found.line[met], limits[met]]
        np.testing.assert_array_equal(named, values[met])


def test_a_line_that_meets_nothing_is_kept_whole() -> None:
    nothing = np.zeros((2, 0))
    found = kept_segments((nothing, nothing), (nothing, nothing))
    np.testing.assert_array_equal(found.line, [0, 1])
    assert np.all(found.low == -np.inf)
    assert np.all(found.high == np.inf)
    assert np.all(found.low_limit == -1)
    assert np.all(found.high_limit == -1)


def test_keep_outs_that_touch_or_overlap_leave_nothing_between() -> None:
    none = np.zeros((1, 0))
    out = np.array([[0.0, 1.0, 0.5]]), np.array([[1.0, 3.0, 2.0]])
    found = kept_segments((none, none), out)
    np.testing.assert_array_equal(found.low, [-np.inf, 3.0])
    np.testing.assert_array_equal(found.high, [0.0, np.inf])
    np.testing.assert_array_equal(found.high_limit[0], 0)
    np.testing.assert_array_equal(found.low_limit[1], 1)
