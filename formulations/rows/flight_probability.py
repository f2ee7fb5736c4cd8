"""Probability that a whole flight keeps all limits on the position, with its gradient.

All randomness of a flight is one standard normal vector w, one component per column of the covariance
factor. The position at every node is mu_k + S_k w. On a line through the mean, w = s u with u on the
unit sphere, every region at every node contains an interval of s. The directions u are fixed,
quasi-random points of the sphere, so that the probability is a smooth function of means and factors:
see `risk.lines`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.special import ndtri

from formulations.arrays import Array, Booleans, Indices
from formulations.problem.regions import Region
from formulations.risk.directions import Directions
from formulations.risk.lines import Segments, TwoSidedChiLaw, kept_segments, normal_density
from formulations.rows.node_probability import Event

SURE = 1e-12
"""Probability that counts as none, so that its quantile stays finite."""

PROBABILITY_MAX = 1.0 - 1e-5
"""Beyond it the estimate is not to be used. From 4,096 directions in 15 dimensions one limit's 1 - P is
good to a tenth at 1e-3, a third at 1e-4, a half (0.1 standard deviations) at 1e-5, a factor of four at
1e-6; and limits more than `reach` away are left out."""

GRAZING = 1e-6
"""Least cosine between line and normal, which bounds the velocity of ends of nearly tangent lines."""


ROUNDING = 1e-9
"""Distance from a plane at which a line may be on either side of it, in units of length."""


class Limit(NamedTuple):
    """A limit's region at the nodes where a flight may reach it."""

    region: Region
    nodes: Indices

    def at(self, which: Indices) -> Limit:
        """The same at some of its nodes."""
        return Limit(self.region.at(which), self.nodes[which])


class Limits(NamedTuple):
    """Limits on flights; rows are their nodes, those of keep-ins (`inner`) first."""

    inner: tuple[Limit, ...]
    outer: tuple[Limit, ...]

    @property
    def first(self) -> Indices:
        """First row of each limit, and the number of rows."""
        return np.cumsum([0, *(len(limit.nodes) for limit in self.inner + self.outer)])

    @property
    def nodes(self) -> Indices:
        """Node of each row."""
        parts = [limit.nodes for limit in self.inner + self.outer]
        return np.concatenate([np.zeros(0, np.intp), *parts])

    def at(self, rows: Booleans) -> Limits:
        """Some of the rows only."""
        parts = np.split(rows, self.first[1:-1])
        kept = [
            limit.at(np.flatnonzero(part))
            for limit, part in zip(self.inner + self.outer, parts, strict=False)
        ]
        count = len(self.inner)
        return Limits(tuple(kept[:count]), tuple(kept[count:]))

    def normals(self, row: Indices, point: Array) -> Array:
        """Normals to the surface of the region of some rows at points (m, 3) on it."""
        normal, first = np.empty_like(point), self.first
        for limit, start, stop in zip(self.inner + self.outer, first, first[1:], strict=False):
            mine = np.flatnonzero((row >= start) & (row < stop))
            region = limit.region.at(row[mine] - start)
            normal[mine] = region.supporting(point[mine]).normal
        return normal


class FlightQuantile(NamedTuple):
    """g = Phi^-1(P) of the whole flight and derivatives in mean positions and factors at r rows.

    Attributes:
        value: g.
        limits: limits evaluated, r rows.
        by_mean: shape (r, 3).
        by_factor: shape (r, 3, d), of the factor's first d columns.
        ends: share of the flights that a row ends, in density, shape (r,).
    """

    value: float
    limits: Limits
    by_mean: Array
    by_factor: Array
    ends: Array

    @property
    def nodes(self) -> Indices:
        """Node of each row."""
        return self.limits.nodes


@dataclass(frozen=True)
class FlightProbability:
    """Estimates the probability that all events hold at all of their nodes.

    Attributes:
        events: on positions.
        directions: of the lines, in d dimensions.
        reach: standard deviations within which limits are evaluated: one farther off than 6 is broken
            by fewer than 1e-9 of flights.
    """

    events: tuple[Event, ...]
    directions: Directions
    reach: float = 6.0

    def limits(self, mean: Array, factor: Array) -> Limits:
        """Limits that flights within reach meet, for mean positions (n, 3) and factors (n, 3, c)."""
        return limits_within(
            self.events, mean, self.reach * factor[:, :, : self.directions.unit.shape[1]]
        )

    def __call__(self, mean: Array, factor: Array, limits: Limits | None = None) -> FlightQuantile:
        """The quantile g for mean positions (n, 3) and factors (n, 3, c) at all nodes.

        By default all limits within reach are evaluated.
        """
        if limits is None:
            limits = self.limits(mean, factor)
        (unit, weight), law = self.directions, self._law
        lines, d = unit.shape
        factor = factor[:, :, :d]
        kept = self._kept(mean, factor, limits)
        between = np.bincount(kept.line, law.between(kept.low, kept.high), lines)
        p = 1.0 - float(weight @ (1.0 - between)) / lines
        nodes = limits.nodes
        r = len(nodes)
        row, s = np.hstack([kept.low_limit, kept.high_limit]), np.hstack([kept.low, kept.high])
        sign = np.repeat([-1.0, 1.0], len(kept.line))
        met = row >= 0
        row, s, sign, u = row[met], s[met], sign[met], unit[np.tile(kept.line, 2)[met]]
        velocity = np.einsum("nid,nd->ni", factor[nodes[row]], u)
        normal = limits.normals(row, mean[nodes[row]] + s[:, None] * velocity)
        density = weight[np.tile(kept.line, 2)[met]] * law.density(s) / lines
        gradient = (sign * density)[:, None] * _end_velocity(normal, velocity)
        gather = _adding_up(row, r)
        by_factor = [gather @ ((gradient[:, axis] * s)[:, None] * u) for axis in range(3)]
        g = float(ndtri(np.clip(p, SURE, 1.0 - SURE)))
        scale = 1.0 / normal_density(np.array(g))
        by_mean, ends = gather @ gradient, gather @ density
        return FlightQuantile(g, limits, scale * by_mean, scale * np.stack(by_factor, axis=1), ends)

    def failing(self, mean: Array, factor: Array) -> Array:
        """Probability that a flight on each of the lines fails, shape (lines,)."""
        lines, d = self.directions.unit.shape
        kept = self._kept(mean, factor[:, :, :d], self.limits(mean, factor))
        between = self._law.between(kept.low, kept.high)
        return np.asarray(1.0 - np.bincount(kept.line, between, lines))

    @property
    def _law(self) -> TwoSidedChiLaw:
        return TwoSidedChiLaw(self.directions.unit.shape[1])

    def _kept(self, mean: Array, factor: Array, limits: Limits) -> Segments:
        """Segments of the lines on which all limits hold, whose ends are rows of the limits.

        Of keep-outs only chords are computed that a line may meet before it leaves the keep-ins, or
        before the law ends: one in a hundred or fewer.
        """
        inner = self._chords(limits.inner, mean, factor)
        farthest = self._law.farthest
        first = np.maximum(inner[0].max(axis=1, initial=-np.inf), -farthest)
        last = np.minimum(inner[1].min(axis=1, initial=np.inf), farthest)
        met: list[Indices] = []
        lows: list[Array] = []
        highs: list[Array] = []
        for limit, row in zip(limits.outer, limits.first[len(limits.inner) :], strict=False):
            spread, at = factor[limit.nodes], mean[limit.nodes]
            plane = limit.region.supporting(at)
            towards = -np.einsum("ni,nic->nc", plane.normal, spread) @ self.directions.unit.T
            beyond = np.maximum(first * towards, last * towards) + plane.slack(at)[:, None]
            k, line = np.nonzero(beyond >= -ROUNDING)
            direction = np.einsum("nic,nc->ni", spread[k], self.directions.unit[line])
            chord = limit.region.at(k).chord(at[k, None], direction[:, None])
            rows, column = np.unique(k, return_inverse=True)
            for ends, found in zip((lows, highs), chord, strict=True):
                ends.append(np.full((len(first), len(rows)), np.inf))
                ends[-1][line, column] = found[:, 0]
            met.append(row + rows)
        outer = tuple(np.hstack([np.zeros((len(first), 0)), *ends]) for ends in (lows, highs))
        kept = kept_segments(inner, (outer[0], outer[1]))
        row_of = np.concatenate([np.arange(inner[0].shape[1]), *met, [-1]]).astype(np.intp)
        return kept._replace(low_limit=row_of[kept.low_limit], high_limit=row_of[kept.high_limit])

    def _chords(self, limits: Sequence[Limit], mean: Array, factor: Array) -> tuple[Array, Array]:
        """Intervals of the lines in each row's region: starts and ends, shape (lines, rows) each."""
        lines = len(self.directions.unit)
        lows, highs = [np.zeros((0, lines))], [np.zeros((0, lines))]
        for limit in limits:
            # Components first: one product of matrices, and operations run along the lines.
            along = factor[limit.nodes].reshape(-1, factor.shape[2]) @ self.directions.unit.T
            along = np.moveaxis(along.reshape(-1, 3, lines), 1, 2)
            low, high = limit.region.chord(mean[limit.nodes, None], along)
            lows.append(low)
            highs.append(high)
        return np.vstack(lows).T, np.vstack(highs).T


def limits_within(events: tuple[Event, ...], mean: Array, spread: Array) -> Limits:
    """Limits that positions mean + spread w may break, with |w| <= 1; (n, 3) and (n, 3, c)."""
    radius = np.sqrt(np.linalg.eigvalsh(spread @ spread.swapaxes(1, 2))[:, -1])
    inner = (limit for e in events for limit in _met_inside(e, mean, radius))
    outer = (limit for e in events for limit in _met_outside(e, mean, spread))
    return Limits(tuple(inner), tuple(outer))


def _met_inside(event: Event, mean: Array, radius: Array) -> Iterator[Limit]:
    """Keep-in limits that flights within a radius about the mean leave."""
    at = event.nodes
    for region in event.keep_in:
        near = np.flatnonzero(region.inside(mean[at]) < radius[at])
        if len(near):
            yield Limit(region.at(near), at[near])


def _met_outside(event: Event, mean: Array, spread: Array) -> Iterator[Limit]:
    """Keep-out limits where some flight crosses the plane that the region lies behind."""
    at = event.nodes
    for region in event.keep_out:
        planes = region.supporting(mean[at]).complement()
        along = np.linalg.norm(np.einsum("ni,nic->nc", planes.normal, spread[at]), axis=1)
        near = np.flatnonzero(planes.slack(mean[at]) < along)
        if len(near):
            yield Limit(region.at(near), at[near])


def _adding_up(rows: Indices, count: int) -> sp.csr_array:
    """Map that sums entries by row, shape (count, entries)."""
    entries = len(rows)
    return sp.csr_array((np.ones(entries), (rows, np.arange(entries))), shape=(count, entries))


def _end_velocity(normal: Array, direction: Array) -> Array:
    """ds/dr of where lines meet a surface, shape (n, 3): -n / n'v."""
    across = np.einsum("ni,ni->n", normal, direction)
    least = GRAZING * np.linalg.norm(direction, axis=1)
    across = np.where(np.abs(across) < least, np.copysign(least, across), across)
    return np.asarray(-normal / across[:, None])
