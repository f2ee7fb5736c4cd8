"""Probability along lines: the segments on which a line keeps all limits, and their probability.

All randomness of a position is one standard normal vector. On a line through its space a position is
affine in the coordinate s along it, r = m + s v, and every convex region contains an interval of the
line. All limits hold on an intersection of intervals less a union of intervals, with ends in closed
form. Its mean over lines is the probability, and the motion of the ends gives the gradient:

    P = E[sum F(end) - F(start)],    dP = E[sum f(end) d end - f(start) d start],
    n'(dm + s dv) + n'v ds = 0  with n normal to the limit that is met there.

Lines through the mean in all directions, with the chi law, make the spherical-radial decomposition
(Deak, Numer. Math. 35 (1980); gradients: van Ackooij and Henrion, SIAM J. Optim. 24 (2014) 1864).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import gammainc, gammaincc, gammainccinv, gammaln, xlogy

from formulations.arrays import Array, Indices


def normal_density(s: Array) -> Array:
    """Density of the standard normal law."""
    return np.asarray(np.exp(-0.5 * s * s) / np.sqrt(2.0 * np.pi))


@dataclass(frozen=True)
class TwoSidedChiLaw:
    """Signed distance from the centre of a standard normal vector along a random line through it."""

    dimension: int

    def between(self, low: Array, high: Array) -> Array:
        """Probability of [low, high], where low <= high; accurate in both tails."""
        apart, half = (low > 0.0) | (high < 0.0), 0.5 * self.dimension
        between = np.empty(np.shape(apart))
        for side, one_side, sign in ((~apart, gammainc, 1.0), (apart, gammaincc, -1.0)):
            start, end = np.broadcast_arrays(low, high)
            near, far = np.sort(np.abs([start[side], end[side]]), axis=0)
            between[side] = one_side(half, 0.5 * near**2) + sign * one_side(half, 0.5 * far**2)
        return 0.5 * between

    @property
    def farthest(self) -> float:
        """Distance beyond which the law has nothing: 1e-18."""
        return float(np.sqrt(2.0 * gammainccinv(0.5 * self.dimension, 1e-18)))

    def density(self, s: Array) -> Array:
        """Density at s, zero at infinity."""
        n = self.dimension
        size = np.abs(s)
        with np.errstate(invalid="ignore"):
            log = xlogy(n - 1, size) - 0.5 * size**2 - (0.5 * n - 1.0) * np.log(2.0)
        value = 0.5 * np.exp(log - gammaln(0.5 * n))
        return np.where(np.isfinite(size), value, 0.0)


class Segments(NamedTuple):
    """Segments of lines on which all limits hold, one entry each; an end without a limit is infinite.

    The limits at both ends are given by index, keep-ins first, -1 for none.
    """

    line: Indices
    low: Array
    high: Array
    low_limit: Indices
    high_limit: Indices


def kept_segments(keep_in: tuple[Array, Array], keep_out: tuple[Array, Array]) -> Segments:
    """Parts of lines inside all keep-in intervals and outside all keep-out intervals.

    Args:
        keep_in: starts and ends of the intervals, shape (lines, i) each; an empty one starts after it
            ends.
        keep_out: the same, shape (lines, o); an empty one is (inf, inf).
    """
    (in_low, in_high), (out_low, out_high) = keep_in, keep_out
    first = in_low.max(axis=1, initial=-np.inf)
    last = in_high.min(axis=1, initial=np.inf)
    lost = (out_low < last[:, None]) & (out_high > first[:, None])
    interrupted = lost.any(axis=1)
    whole = np.flatnonzero(~interrupted & (first < last))
    starts, ends = _met(in_low[whole], first[whole]), _met(in_high[whole], last[whole])
    unbroken = Segments(whole, first[whole], last[whole], starts, ends)
    some = np.flatnonzero(interrupted)
    inner, outer = (in_low[some], in_high[some]), (out_low[some], out_high[some])
    parts = _segments(inner, outer, first[some, None], last[some, None])
    broken = parts._replace(line=some[parts.line])
    return Segments(*(np.concatenate(pair) for pair in zip(unbroken, broken, strict=True)))


def _segments(
    keep_in: tuple[Array, Array], keep_out: tuple[Array, Array], first: Array, last: Array
) -> Segments:
    """Parts of [first, last] of each line, shape (lines, 1), outside the keep-out intervals."""
    (in_low, in_high), (out_low, out_high) = keep_in, keep_out
    order = np.argsort(out_low, axis=1)
    opens = np.take_along_axis(out_low, order, axis=1)
    closes = np.maximum.accumulate(np.take_along_axis(out_high, order, axis=1), axis=1)
    low = np.hstack([first, np.maximum(closes, first)])
    high = np.hstack([np.minimum(opens, last), last])
    line, segment = np.nonzero(high > low)
    low, high = low[line, segment], high[line, segment]
    starts = np.hstack([in_low, out_high])[line]
    ends = np.hstack([in_high, out_low])[line]
    return Segments(line, low, high, _met(starts, low), _met(ends, high))


def _met(candidates: Array, value: Array) -> Indices:
    """Index of the candidate that equals a value, -1 for infinite values."""
    if candidates.shape[1] == 0:
        return np.full(len(value), -1)
    index = np.argmax(candidates == value[:, None], axis=1)
    return np.where(np.isfinite(value), index, -1)
