"""Estimate the probability that a whole flight keeps all limits on the position, with its gradient.

A flight depends on one standard normal vector w with a component per column of the covariance
factor. The position at every node is mu_k + S_k w. On a line through the mean, w = s u with u on
the unit sphere, every region at every node contains an interval of s. The directions u are fixed,
quasi-random points of the sphere, so that the probability is a smooth function of means and
factors: see `risk.lines`. The factors have rows of p uncertain parameters too. Where regions move with
these, S_k is that of the position relative to the region, linearised at the mean.

`Coordinates` express the law of a flight in few numbers: its first state, and velocities after later
burns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import ndtri

from formulations.arrays import Array, Booleans, Indices
from formulations.problem.regions import Motion, Region, relative, with_parameters
from formulations.risk.lines import (
    Chords,
    Directions,
    Segments,
    TwoSidedChiLaw,
    kept_segments,
    normal_density,
)
from formulations.rows.node_probability import Event

SURE = 1e-12
"""Probability that counts as none, so that its quantile stays finite."""

PROBABILITY_MAX = 1.0 - 1e-5
"""Beyond it the estimate is not to be used. From 4,096 directions in 15 dimensions one limit's 1 - P is
good to a tenth at 1e-3, a third at 1e-4, a half (0.1 standard deviations) at 1e-5, a factor of four at
1e-6; and limits more than `reach` away are left out."""

GRAZING = 1e-6
"""Least cosine between line and normal, which bounds the velocity of ends of nearly tangent lines."""


ROWS, LINES = 16, 1024
"""Size of a block of chords, whose arrays fit into the processor's cache."""

ROUNDING = 1e-9
"""Distance from a plane at which a line may be on either side of it, in units of length."""


class Limit(NamedTuple):
    """A limit's region at the nodes where a flight may reach it."""

    region: Region
    nodes: Indices
    motion: Motion | None = None

    def at(self, which: Indices) -> Limit:
        """The limit at some of its nodes."""
        motion = self.motion and self.motion.at(which)
        return Limit(self.region.at(which), self.nodes[which], motion)


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

    @property
    def moving(self) -> Iterator[tuple[slice, Motion]]:
        """Rows of limits whose regions move, with the motion."""
        parts = zip(self.inner + self.outer, self.first, self.first[1:], strict=False)
        for limit, start, stop in parts:
            if limit.motion is not None:
                yield slice(start, stop), limit.motion

    def relative(self, at: Array, factor: Array) -> Array:
        """Factors (b, r, 3, d) relative to the rows' regions, from (b, r, 3) and (b, r, 3 + p, d)."""
        found = factor[:, :, :3]
        if factor.shape[2] == 3:
            return found
        found = found.copy()
        for rows, motion in self.moving:
            for flight, (point, own) in enumerate(zip(at[:, rows], factor[:, rows], strict=True)):
                found[flight, rows] = relative(motion, point, own)
        return found

    def normals(self, row: Indices, point: Array) -> Array:
        """Normals to the surface of the region of ascending rows at points (m, 3) on it."""
        normal, first = np.empty_like(point), self.first
        cuts = np.searchsorted(row, first)
        for limit, start, cut, stop in zip(
            self.inner + self.outer, first, cuts, cuts[1:], strict=False
        ):
            region = limit.region.at(row[cut:stop] - start)
            normal[cut:stop] = region.supporting(point[cut:stop]).normal
        return normal


class FlightValue(NamedTuple):
    """g = Phi^-1(P) of the whole flight, and derivatives in mean positions and factors.

    They are at the r rows of limits; `Coordinates` give them at all nodes instead, by the factors' rows
    of the state.

    Attributes:
        value: g.
        limits: limits evaluated, r rows.
        by_mean: shape (r, 3) or (n_nodes, 3).
        by_factor: of the factor's first d columns, shape (r, 3 + p, d); or (n_nodes, 6, c).
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
        reach: standard deviations within which limits are evaluated. A limit farther off than 6 is
            broken by fewer than 1e-9 of flights.
    """

    events: tuple[Event, ...]
    directions: Directions
    reach: float = 6.0

    def limits(self, mean: Array, factor: Array) -> Limits:
        """Limits that flights within reach meet, for mean positions (n, 3), factors (n, 3 + p, c)."""
        return limits_within(
            self.events, mean, self.reach * factor[:, :, : self.directions.unit.shape[1]]
        )

    def __call__(self, mean: Array, factor: Array) -> FlightValue:
        """The quantile g for mean positions (n, 3) and factors (n, 3 + p, c) at all nodes."""
        return self.of_many(mean[None], factor[None], self.limits(mean, factor))[0]

    def of_many(self, mean: Array, factor: Array, limits: Limits) -> list[FlightValue]:
        """The quantiles g of b flights by the same limits, from (b, n, 3) and (b, n, 3 + p, c)."""
        (unit, weight), law, nodes = self.directions, self._law, limits.nodes
        (lines, d), b, r = unit.shape, len(mean), len(nodes)
        at, every = mean[:, nodes], factor[:, nodes, :, :d]
        spread = limits.relative(at, every)
        kept = self._kept(at, spread, limits)
        between = np.bincount(kept.line, law.between(kept.low, kept.high), b * lines)
        p = 1.0 - (1.0 - between.reshape(b, lines)) @ weight / lines
        g = ndtri(np.clip(p, SURE, 1.0 - SURE))
        row, s = np.hstack([kept.low_limit, kept.high_limit]), np.hstack([kept.low, kept.high])
        flight, line = np.divmod(np.tile(kept.line, 2), lines)
        sign = np.repeat([-1.0, 1.0], len(kept.line)) / normal_density(g)[flight]
        seen = np.flatnonzero((row >= 0) & (np.abs(s) < law.farthest))
        order = seen[np.argsort((b * row + flight)[seen], kind="stable")]
        row, flight, line = row[order], flight[order], line[order]
        s, sign = s[order], sign[order]
        u = unit[line]
        velocity = np.einsum("nid,nd->ni", spread[flight, row], u)
        normal = limits.normals(row, at[flight, row] + s[:, None] * velocity)
        density = weight[line] * law.density(s) / lines
        gradient = (sign * density)[:, None] * _end_velocity(normal, velocity)
        moved = (gradient * s[:, None])[:, :, None] * u[:, None]
        met, start = np.unique(b * row + flight, return_index=True)
        sums = [np.zeros((r, b, *parts.shape[1:])) for parts in (gradient, moved, density)]
        if len(met):
            for of_all, parts in zip(sums, (gradient, moved, density), strict=True):
                of_all[np.divmod(met, b)] = np.add.reduceat(parts, start)
        by_mean, by_factor, ends = sums
        if every.shape[2] > 3:
            by_mean, by_factor = _with_motion(limits, at, every, by_mean, by_factor)
        parts = by_mean, by_factor, ends
        return [FlightValue(float(g[j]), limits, *(part[:, j] for part in parts)) for j in range(b)]

    def failing(self, mean: Array, factor: Array) -> Array:
        """Probability that a flight on each of the lines fails, shape (lines,)."""
        lines, d = self.directions.unit.shape
        limits = self.limits(mean, factor)
        nodes = limits.nodes
        at = mean[None, nodes]
        kept = self._kept(at, limits.relative(at, factor[None, nodes, :, :d]), limits)
        between = self._law.between(kept.low, kept.high)
        return np.asarray(1.0 - np.bincount(kept.line, between, lines))

    @property
    def _law(self) -> TwoSidedChiLaw:
        return TwoSidedChiLaw(self.directions.unit.shape[1])

    def _kept(self, at: Array, spread: Array, limits: Limits) -> Segments:
        """Segments of the lines on which all limits hold, whose ends are rows of the limits.

        Chords of keep-outs are computed only if a line may meet them before it leaves the keep-ins,
        or before the law ends: one chord in a hundred or fewer.

        Args:
            at: mean positions of b flights at the rows of the limits, shape (b, r, 3).
            spread: their factors there, relative to the regions, shape (b, r, 3, d).
            limits: of r rows.

        Returns:
            Segments of the first flight's lines, then of the second's, and so on.
        """
        lines, farthest = len(self.directions.unit), self._law.farthest
        kept_in = int(limits.first[len(limits.inner)])
        inner, outer = list(_parts(limits.inner, 0)), list(_parts(limits.outer, kept_in))
        low, high = np.empty((2, kept_in, len(at) * lines))
        out = [Chords(*np.zeros((2, 0), np.intp), *np.zeros((2, 0)))]
        for flight, (start, factor) in enumerate(zip(at, spread, strict=True)):
            planes = [region.supporting(start[rows]) for region, rows in outer]
            for begin in range(0, lines, LINES):
                unit, before = self.directions.unit[begin : begin + LINES].T, flight * lines + begin
                count = unit.shape[1]
                here = slice(before, before + count)
                for region, rows in inner:
                    # Components first: one product of matrices, and operations run along the lines.
                    along = (factor[rows].reshape(-1, len(unit)) @ unit).reshape(-1, 3, count)
                    chord = region.chord(start[rows, None], np.moveaxis(along, 1, 2))
                    low[rows, here], high[rows, here] = chord
                first = np.maximum(low[:, here].max(axis=0, initial=-np.inf), -farthest)
                last = np.minimum(high[:, here].min(axis=0, initial=np.inf), farthest)
                for (region, rows), plane in zip(outer, planes, strict=True):
                    ahead = np.einsum("ni,nic->nc", plane.normal, factor[rows]) @ unit
                    least = np.minimum(first * ahead, last * ahead)
                    k, line = np.nonzero(least <= ROUNDING + plane.inside(start[rows])[:, None])
                    if len(k) == 0:
                        continue
                    direction = np.einsum("nic,cn->ni", factor[rows][k], unit[:, line])
                    chord = region.at(k).chord(start[rows][k, None], direction[:, None])
                    out.append(Chords(rows.start + k, before + line, *(s[:, 0] for s in chord)))
        keep_out = Chords(*(np.concatenate(parts) for parts in zip(*out, strict=True)))
        return kept_segments((low, high), keep_out)


def _with_motion(
    limits: Limits, at: Array, factor: Array, by_mean: Array, by_factor: Array
) -> tuple[Array, Array]:
    """Derivatives by positions (r, b, 3) and all rows (r, b, 3 + p, d), from those by relative ones.

    At positions (b, r, 3) with factors (b, r, 3 + p, d).
    """
    found = np.concatenate([by_factor, np.zeros_like(factor[:, :, 3:].swapaxes(0, 1))], axis=2)
    by_mean = by_mean.copy()
    for rows, motion in limits.moving:
        for flight in range(len(at)):
            own = by_factor[rows, flight]
            seen, parameters = motion.seen(at[flight, rows]), factor[flight, rows, 3:]
            found[rows, flight, 3:] = seen.swapaxes(1, 2) @ own
            by_mean[rows, flight] += motion.pulled(own @ parameters.swapaxes(1, 2))
    return by_mean, found


def _parts(limits: Sequence[Limit], first: int) -> Iterator[tuple[Region, slice]]:
    """Regions of some limits, and their rows from the first on, in blocks."""
    for limit in limits:
        count = len(limit.nodes)
        for start in range(0, count, ROWS):
            some = np.arange(start, min(start + ROWS, count))
            yield limit.region.at(some), slice(first + some[0], first + some[-1] + 1)
        first += count


def limits_within(events: tuple[Event, ...], mean: Array, spread: Array) -> Limits:
    """Limits that positions mean + spread w may break, with |w| <= 1; (n, 3) and (n, 3 + p, c)."""
    radius = _reach(spread[:, :3])
    inner = (limit for e in events for limit in _met_inside(e, mean, spread, radius))
    outer = (limit for e in events for limit in _met_outside(e, mean, spread))
    return Limits(tuple(inner), tuple(outer))


def _reach(spread: Array) -> Array:
    """Radius of the balls that hold spread w with |w| <= 1, shape (n,), of (n, 3, c)."""
    return np.sqrt(np.linalg.eigvalsh(spread @ spread.swapaxes(1, 2))[:, -1])


def _met_inside(event: Event, mean: Array, spread: Array, radius: Array) -> Iterator[Limit]:
    """Keep-in limits that flights leave, which are within a radius about the mean of a still region."""
    at, within = event.nodes, radius[event.nodes]
    if event.keep_in and event.motion is not None:
        within = _reach(relative(event.motion, mean[at], spread[at]))
    for region in event.keep_in:
        near = np.flatnonzero(region.inside(mean[at]) < within)
        if len(near):
            yield _limit(event, region, near)


def _met_outside(event: Event, mean: Array, spread: Array) -> Iterator[Limit]:
    """Keep-out limits where some flight crosses the plane that the region lies behind."""
    at = event.nodes
    for region in event.keep_out:
        planes = region.supporting(mean[at]).complement()
        own = relative(event.motion, mean[at], spread[at])
        along = np.linalg.norm(np.einsum("ni,nic->nc", planes.normal, own), axis=1)
        near = np.flatnonzero(planes.inside(mean[at]) < along)
        if len(near):
            yield _limit(event, region, near)


def _limit(event: Event, region: Region, near: Indices) -> Limit:
    """One of an event's limits at some of its nodes."""
    return Limit(region.at(near), event.nodes[near], event.motion and event.motion.at(near))


def _end_velocity(normal: Array, direction: Array) -> Array:
    """ds/dr of where lines meet a surface, shape (n, 3): -n / n'v."""
    across = np.einsum("ni,ni->n", normal, direction)
    least = GRAZING * np.linalg.norm(direction, axis=1)
    across = np.where(np.abs(across) < least, np.copysign(least, across), across)
    return np.asarray(-normal / across[:, None])


CERTAIN = 1e-9
"""Standard deviation that is added to each coordinate, so that certain ones have a direction."""

DIRECTED = 1e-2
"""The same relative to a coordinate's own deviation, with corrected burns. A burn that has vanished
with its gains adds nothing to a velocity. The direction of such a coordinate would turn with every
step, and with it the lines of flights."""


class Coordinates:
    """Numbers in which a flight's positions are linear, and the root of their law.

    They are the state at the first of the nodes at which the flight's legs start, the velocities at the
    others, and the uncertain parameters. Factors have rows of the state and of the p parameters.

    Y are the rows of the covariance factor that belong to them, W the triangular root of Y Y'. With
    R = W^-1 Y a factor S is (S R') R, so that S R' has its covariance in fewer columns.
    """

    def __init__(self, starts: Sequence[int], parameters: int = 0) -> None:
        first, *later = starts
        few = 6 + parameters
        self._node = np.r_[[first] * few, np.repeat(later, 3)].astype(np.intp)
        self._row = np.r_[np.arange(few), np.tile([3, 4, 5], len(later))].astype(np.intp)
        self._turning = self._row < 6  # parameters are constant
        self.count, self.nodes = len(self._node), np.unique(self._node)
        self._certain = np.full(self.count, CERTAIN)

    def settle(self, factor: Array) -> None:
        """Keep coordinates that a factor leaves nearly certain from turning near it."""
        own = np.linalg.norm(factor[self._node, self._row], axis=1)
        self._certain = np.maximum(CERTAIN, DIRECTED * own)

    def __call__(self, probability: FlightProbability, mean: Array, factor: Array) -> FlightValue:
        """G for means (n_nodes, 3) and factors (n_nodes, 6 + p, c) at all nodes."""
        limits = probability.limits(mean, self.reduced(factor))
        return self.of_many(probability, mean[None], factor[None], limits)[0]

    def of_many(
        self, probability: FlightProbability, mean: Array, factor: Array, limits: Limits
    ) -> list[FlightValue]:
        """G of b flights by the same limits, from (b, n_nodes, 3) and (b, n_nodes, 6 + p, c)."""
        roots = [self._root(one) for one in factor]
        reduced = [self._reduced(one, rows) for one, (_, rows) in zip(factor, roots, strict=True)]
        found = probability.of_many(mean, np.stack(reduced), limits)
        parts = zip(found, factor, reduced, roots, strict=True)
        return [self._value(g, one, few, *root) for g, one, few, root in parts]

    def _value(
        self, g: FlightValue, factor: Array, reduced: Array, root: Array, rows: Array
    ) -> FlightValue:
        """G with derivatives at all nodes from those in the coordinates, whose W and R are given."""
        n, size, columns = factor.shape
        by_mean, by_factor = np.zeros((n, 3)), np.zeros((n, 6, columns))
        np.add.at(by_mean, g.nodes, g.by_mean)
        nodes, which = np.unique(g.nodes, return_inverse=True)
        here = np.zeros((len(nodes), size - 3, self.count))
        np.add.at(here, which, g.by_factor)
        by_factor[nodes, :3] = here[:, :3] @ rows
        # What turning the coordinates does to directions that stay as they are: W has a derivative,
        # W low(A + A') with A = W^-1 dY R', where W A is already counted.
        turned = np.tensordot(reduced[nodes], here, axes=([0, 1], [0, 1]))
        turned = np.triu(turned.T - turned, 1)
        by_own = solve_triangular(root, turned @ rows, lower=True, trans="T")
        own = self._turning
        np.add.at(by_factor, (self._node[own], self._row[own]), by_own[own])
        return g._replace(by_mean=by_mean, by_factor=by_factor)

    def reduced(self, factor: Array) -> Array:
        """Factors of positions and parameters in fewer columns, S R', (n_nodes, 3 + p, count)."""
        return self._reduced(factor, self._root(factor)[1])

    def _reduced(self, factor: Array, rows: Array) -> Array:
        own = with_parameters(factor)
        flat = own.reshape(-1, factor.shape[2])
        return np.asarray(flat @ rows.T).reshape(*own.shape[:2], self.count)

    def _root(self, factor: Array) -> tuple[Array, Array]:
        """W and R, by an orthogonal factorisation, which bears any ratio of standard deviations."""
        own = factor[self._node, self._row]
        across, up = np.linalg.qr(np.hstack([own, np.diag(self._certain)]).T)
        sign = np.copysign(1.0, np.diag(up))
        return (sign[:, None] * up).T, (across * sign).T[:, : own.shape[1]]
