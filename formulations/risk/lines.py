"""Find the segments of lines on which all limits hold, and the probability of each segment.

A position depends on one standard normal vector. On a line through the space of that vector, the
position is affine in the coordinate s along the line, r = m + s v. Every convex region then
contains an interval of the line. All limits hold on an intersection of intervals less a union of
intervals, whose ends have closed forms. The mean over lines of its probability is the probability
that all limits hold. The motion of the ends gives the gradient:

    P = E[sum F(end) - F(start)],    dP = E[sum f(end) d end - f(start) d start],
    n'(dm + s dv) + n'v ds = 0  with n normal to the limit that is met there.

Lines through the mean in all directions, with the chi law, make the spherical-radial decomposition
(Deak, Numer. Math. 35 (1980); gradients: van Ackooij and Henrion, SIAM J. Optim. 24 (2014) 1864).

Directions of lines are chosen evenly, or half of them where flights fail. Only few of many even
directions meet the limits that flights are likely to break. The estimate has a kink where the first
broken limit changes on one of these lines. Half of the directions can therefore be drawn from the
angular central Gaussian law of a matrix A: the law of A^(1/2) z / |A^(1/2) z| with z standard
normal. Its density relative to the even law is

    |A|^(-1/2) (u'A^-1 u)^(-d/2)

(D. E. Tyler, "Statistical analysis for the angular central Gaussian distribution on the sphere",
Biometrika 74 (1987) 579, whose fixed point fits A to directions). All directions are weighted by
the density of the mixture (E. Veach and L. Guibas, "Optimally combining sampling techniques",
SIGGRAPH 1995). No weight exceeds two, and the estimate has no bias.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import gammainc, gammaincc, gammainccinv, gammaln, ndtri, xlogy

from formulations.arrays import Array, Indices

SEED = 20200121
"""Seed of the scrambling: every run draws the same flights."""

ROUNDS, STEPS = 3, 4
"""Times that failing directions are looked for, and steps of Tyler's fixed point each time."""

EVEN = 0.1
"""Share of the even law's matrix in A, which bounds how narrow the aim is."""


class Directions(NamedTuple):
    """Unit vectors, shape (count, d), and their weights, of mean one, shape (count,)."""

    unit: Array
    weight: Array


def sphere_directions(count: int, dimension: int) -> Directions:
    """Quasi-random unit vectors, evenly: Sobol points through the normal quantile.

    The count is a power of two.
    """
    return Directions(_onto_sphere(normal_points(count, dimension)), np.ones(count))


def aimed_directions(
    count: int, dimension: int, failing: Callable[[Directions], Array]
) -> Directions:
    """Directions of which half are drawn where flights fail.

    Args:
        count: a power of two.
        dimension: d.
        failing: probability that a flight fails on each of some lines, shape (count,).
    """
    normal, eye = normal_points(count, dimension), np.eye(dimension)
    even, half = _onto_sphere(normal[: count // 2]), count // 2
    matrix, found = eye, Directions(_onto_sphere(normal), np.ones(count))
    for _ in range(ROUNDS):
        share = found.weight * failing(found)
        if share.sum() <= 0.0:
            break
        matrix = _fitted(found.unit, share / share.sum())
        root = np.linalg.cholesky(matrix)
        unit = np.vstack([even, _onto_sphere(normal[half:] @ root.T)])
        density = np.linalg.norm(np.linalg.solve(root, unit.T), axis=0) ** -dimension
        density /= np.prod(np.diag(root))
        found = Directions(unit, 2.0 / (1.0 + density))
    return found


def _fitted(unit: Array, share: Array) -> Array:
    """A of determinant one by Tyler's fixed point, for directions with shares that sum up to one."""
    dimension = unit.shape[1]
    eye = np.eye(dimension)
    matrix = eye
    for _ in range(STEPS):
        square = np.einsum("ni,ni->n", unit, np.linalg.solve(matrix, unit.T).T)
        fitted = np.einsum("n,ni,nj->ij", dimension * share / square, unit, unit)
        matrix = (1.0 - EVEN) * fitted * dimension / np.trace(fitted) + EVEN * eye
    return np.asarray(matrix / np.linalg.det(matrix) ** (1.0 / dimension))


@lru_cache(maxsize=8)
def normal_points(count: int, dimension: int) -> Array:
    """Quasi-random standard normal vectors, shape (count, dimension), always the same.

    The count is a power of two.
    """
    from scipy.stats import qmc  # half a second to import

    points = np.asarray(ndtri(qmc.Sobol(dimension, scramble=True, rng=SEED).random(count)))
    points.flags.writeable = False
    return points


def _onto_sphere(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


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
            start, end = (0.5 * s[side] ** 2 for s in np.broadcast_arrays(low, high))
            near, far = np.minimum(start, end), np.maximum(start, end)
            between[side] = one_side(half, near) + sign * one_side(half, far)
        return 0.5 * between

    @property
    def farthest(self) -> float:
        """Distance beyond which the law has a probability of 1e-18."""
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


class Chords(NamedTuple):
    """Intervals of some limits on some lines, one entry each; limits by index as in `Segments`."""

    limit: Indices
    line: Indices
    low: Array
    high: Array


def kept_segments(keep_in: tuple[Array, Array], keep_out: Chords) -> Segments:
    """Parts of lines inside all keep-in intervals and outside all keep-out intervals.

    Args:
        keep_in: starts and ends of the intervals, shape (i, lines) each; an empty one starts after it
            ends.
        keep_out: those that are not empty.
    """
    in_low, in_high = keep_in
    first, last = in_low.max(axis=0, initial=-np.inf), in_high.min(axis=0, initial=np.inf)
    lost = (keep_out.low < last[keep_out.line]) & (keep_out.high > first[keep_out.line])
    out = Chords(*(part[lost] for part in keep_out))
    some, place = np.unique(out.line, return_inverse=True)
    whole = first < last
    whole[some] = False
    starts, ends = _met(in_low, first), _met(in_high, last)
    unbroken = Segments(np.flatnonzero(whole), *(p[whole] for p in (first, last, starts, ends)))
    limits, column = np.unique(out.limit, return_inverse=True)
    opens = np.full((len(limits), len(some)), np.inf)
    closes = opens.copy()
    opens[column, place], closes[column, place] = out.low, out.high
    order = np.argsort(opens, axis=0)
    sorted_, until = (np.take_along_axis(ends_, order, axis=0) for ends_ in (opens, closes))
    low = np.vstack([first[None, some], np.maximum(np.maximum.accumulate(until), first[some])])
    high = np.vstack([np.minimum(sorted_, last[some]), last[None, some]])
    at, segment = np.nonzero((high > low).T)
    low, high = low[segment, at], high[segment, at]
    named = np.concatenate([np.arange(len(in_low)), limits, [-1]])
    starts = named[_met(np.vstack([in_low[:, some], closes])[:, at], low)]
    ends = named[_met(np.vstack([in_high[:, some], opens])[:, at], high)]
    broken = Segments(some[at], low, high, starts, ends)
    return Segments(*(np.concatenate(pair) for pair in zip(unbroken, broken, strict=True)))


def _met(candidates: Array, value: Array) -> Indices:
    """Index of the first candidate (i, n) that equals a value (n,), -1 for infinite values."""
    index = np.full(len(value), -1)
    found, at = np.nonzero(candidates == value)
    index[at[::-1]] = found[::-1]
    return np.where(np.isfinite(value), index, -1)
