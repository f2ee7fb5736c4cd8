"""Probability that a whole flight keeps all limits on the position, with its gradient.

All randomness of a flight is one standard normal vector w: the columns of the covariance factor. The
position at every node is mu_k + S_k w, so that on a line through the mean, w = s u with u on the unit
sphere, every limit at every node holds an interval of s. The directions u are fixed, quasi-random
points of the sphere, so that the probability is a smooth function of means and factors: see
`risk.lines`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from formulations.problem.flyby import Nodes
from formulations.problem.regions import Array, Region
from formulations.risk.lines import NormalLaw, TwoSidedChiLaw, kept_segments
from formulations.rows.node_probability import Event, adding_up, end_velocity

SURE = 1e-12
"""Probability that counts as none, so that its quantile stays finite."""


class FlightQuantile(NamedTuple):
    """g = Phi^-1(P) of the whole flight and derivatives in mean positions and factors at r rows.

    Attributes:
        value: g.
        nodes: node of each row, shape (r,).
        by_mean: shape (r, 3).
        by_factor: shape (r, 3, d), of the factor's first d columns.
        ends: share of the flights that a row ends, in density, shape (r,).
    """

    value: float
    nodes: Nodes
    by_mean: Array
    by_factor: Array
    ends: Array


class _Limit(NamedTuple):
    """One region at the nodes where a flight within reach may meet it."""

    region: Region
    nodes: Nodes


@dataclass(frozen=True)
class FlightProbability:
    """Estimates the probability that all events hold at all of their nodes.

    Attributes:
        events: on positions.
        directions: unit vectors u, shape (lines, d).
        reach: standard deviations within which limits are looked for: one farther off than 6 ends fewer
            than 1e-7 of flights.
    """

    events: tuple[Event, ...]
    directions: Array
    reach: float = 6.0

    def __call__(self, mean: Array, factor: Array) -> FlightQuantile:
        """The quantile g for mean positions (n, 3) and their factors (n, 3, c) at all nodes."""
        lines, d = self.directions.shape
        factor = factor[:, :, :d]
        law = TwoSidedChiLaw(d)
        inner = [limit for e in self.events for limit in _met_inside(e, mean, self.reach * factor)]
        outer = [limit for e in self.events for limit in _met_outside(e, mean, self.reach * factor)]
        kept = kept_segments(self._chords(inner, mean, factor), self._chords(outer, mean, factor))
        p = float(law.between(kept.low, kept.high).sum()) / lines
        limits = inner + outer
        nodes = np.concatenate([limit.nodes for limit in limits] or [np.zeros(0, np.intp)])
        first = np.cumsum([0, *(len(limit.nodes) for limit in limits)])
        r = len(nodes)
        by_mean, by_factor, ends = np.zeros((r, 3)), np.zeros((r, 3, d)), np.zeros(r)
        for s, met, sign in ((kept.low, kept.low_limit, -1.0), (kept.high, kept.high_limit, 1.0)):
            for limit, start, stop in zip(limits, first, first[1:], strict=False):
                mine = np.flatnonzero((met >= start) & (met < stop))
                row, u, s_at = met[mine], self.directions[kept.line[mine]], s[mine]
                velocity = np.einsum("nid,nd->ni", factor[nodes[row]], u)
                point = mean[nodes[row]] + s_at[:, None] * velocity
                normal = limit.region.at(row - start).supporting(point).normal
                density = law.density(s_at) / lines
                gradient = (sign * density)[:, None] * end_velocity(normal, velocity)
                gather = adding_up(row, r)
                by_mean += gather @ gradient
                for axis in range(3):
                    by_factor[:, axis] += gather @ ((gradient[:, axis] * s_at)[:, None] * u)
                ends += gather @ density
        g = float(ndtri(np.clip(p, SURE, 1.0 - SURE)))
        scale = 1.0 / NormalLaw().density(np.array(g))
        return FlightQuantile(g, nodes, scale * by_mean, scale * by_factor, ends)

    def _chords(self, limits: Sequence[_Limit], mean: Array, factor: Array) -> tuple[Array, Array]:
        """Where lines lie in each limit's regions, shape (lines, rows) twice."""
        lines = len(self.directions)
        lows, highs = [np.zeros((lines, 0))], [np.zeros((lines, 0))]
        for limit in limits:
            direction = (factor[limit.nodes] @ self.directions.T).swapaxes(1, 2)
            low, high = limit.region.chord(mean[limit.nodes, None], direction)
            lows.append(low.T)
            highs.append(high.T)
        return np.hstack(lows), np.hstack(highs)


def _met_inside(event: Event, mean: Array, spread: Array) -> Iterator[_Limit]:
    """Keep-in limits where some flight within `spread`, S times its reach, leaves the region."""
    at = event.nodes
    for region in event.keep_in:
        near = np.flatnonzero(
            region.inside(mean[at]) < np.linalg.norm(spread[at], ord=2, axis=(1, 2))
        )
        if len(near):
            yield _Limit(region.at(near), at[near])


def _met_outside(event: Event, mean: Array, spread: Array) -> Iterator[_Limit]:
    """Keep-out limits where some flight crosses the plane that the region lies behind."""
    at = event.nodes
    for region in event.keep_out:
        planes = region.supporting(mean[at]).complement()
        along = np.linalg.norm(np.einsum("ni,nic->nc", planes.normal, spread[at]), axis=1)
        near = np.flatnonzero(planes.slack(mean[at]) < along)
        if len(near):
            yield _Limit(region.at(near), at[near])


def sphere_directions(count: int, dimension: int) -> Array:
    """Quasi-random unit vectors, shape (count, dimension): Sobol points through the normal quantile.

    Args:
        count: a power of two.
        dimension: d.
    """
    from scipy.stats import qmc  # half a second to import

    points = qmc.Sobol(dimension, scramble=True, rng=SEED).random(count)
    normal = ndtri(points)
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


SEED = 20200121
"""Of the scrambling: the same flights for everyone."""
