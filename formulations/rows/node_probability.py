"""Probability at each node that a joint constraint holds, with its gradient in mean and covariance.

Integrated along the normal of the facet nearest to the mean in closed form, and across it by
Gauss-Hermite points. On the normal quantile scale, g = Phi^-1(P), a half-space gives the mean's
distance in standard deviations, so that g is nearly affine in what it depends on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.special import ndtri

from formulations.problem.flyby import Nodes, StateConstraint
from formulations.problem.regions import Array, Region, perpendicular
from formulations.risk.lines import NormalLaw, kept_segments

ACROSS = {0.05: 8, 0.15: 16, np.inf: 32}
"""Gauss-Hermite points in each direction across, by the spread over the radius of curvature up to which
they serve. Lines that graze a limit limit their accuracy once the spread nears that radius."""

GRAZED, SLANT = 0.15, 3.0
"""Spread over radius from which on lines run along a limit's normal, and the slope of the limit across
it, in standard deviations, up to which they do."""

FAR = 7.0
"""Deviations from the nearest limit at which its facet alone tells: P is within 1e-12 of 0 or 1."""

SPREAD_MIN = 1e-6
"""Standard deviation, in units of length, that is added in each direction: a millimetre at most, what
counts as no violation. Without it a flight that cannot err would have no gradient."""

GRAZING = 1e-6
"""Cosine between line and surface below which an end counts as moving no faster."""


class Quantiles(NamedTuple):
    """g of one event at its n nodes and derivatives in mean position and factor.

    Attributes:
        value: g, shape (n,).
        by_mean: shape (n, 3).
        by_factor: shape (n, 3, c).
    """

    value: Array
    by_mean: Array
    by_factor: Array


@dataclass(frozen=True)
class Event:
    """A joint constraint: the limits that have to hold together at each of some nodes.

    Attributes:
        name: of the chance constraint.
        nodes: shape (n,).
        keep_in, keep_out: one region per node each.
    """

    name: str
    nodes: Nodes
    keep_in: tuple[Region, ...]
    keep_out: tuple[Region, ...]

    @property
    def limits(self) -> tuple[Region, ...]:
        """All regions, in the order in which `Segments` counts them."""
        return self.keep_in + self.keep_out

    def at(self, which: Nodes) -> Event:
        """The event at some of its nodes only."""
        return Event(
            self.name,
            self.nodes[which],
            tuple(region.at(which) for region in self.keep_in),
            tuple(region.at(which) for region in self.keep_out),
        )

    def facets(self, position: Array) -> tuple[Array, Array]:
        """Facets a'r <= b that support each limit nearest to each point.

        Returns:
            Normals a (limits, n, 3) and offsets b (limits, n).
        """
        planes = [region.supporting(position) for region in self.keep_in]
        planes += [region.supporting(position).complement() for region in self.keep_out]
        return np.stack([p.normal for p in planes]), np.stack([p.offset for p in planes])


def joint_events(constraints: Sequence[StateConstraint]) -> tuple[Event, ...]:
    """The joint constraints that some constraints are the sides of, in their order."""
    names = dict.fromkeys(c.event for c in constraints)
    sides = {name: [c for c in constraints if c.event == name] for name in names}
    return tuple(
        Event(
            name,
            own[0].nodes,
            tuple(c.region for c in own if c.keep == "in"),
            tuple(c.region for c in own if c.keep == "out"),
        )
        for name, own in sides.items()
    )


def node_quantiles(event: Event, position: Array, factor: Array, careful: float = FAR) -> Quantiles:
    """The quantile g at each node and its gradient.

    Args:
        event: n nodes.
        position: means there, shape (n, 3).
        factor: of the positions, shape (n, 3, c).
        careful: deviations from which on a limit's curvature asks for no more points: the tail
            beyond it is told to some per cent.
    """
    covariance = factor @ factor.swapaxes(1, 2) + SPREAD_MIN**2 * np.eye(3)
    normals, offsets = event.facets(position)
    sigmas = np.sqrt(np.einsum("lni,nij,lnj->ln", normals, covariance, normals))
    values = (offsets - np.einsum("lni,ni->ln", normals, position)) / sigmas
    nearest, nodes = np.argmin(values, axis=0), np.arange(len(position))
    normal, sigma, value = (part[nearest, nodes] for part in (normals, sigmas, values))
    by_mean = -normal / sigma[:, None]
    along = np.einsum("ni,nic->nc", normal, factor)
    by_factor = -(value / sigma**2)[:, None, None] * normal[:, :, None] * along[:, None]
    radii = np.stack([region.curvature_radius(position) for region in event.limits])
    radius = np.where(values < careful, radii, np.inf).min(axis=0)
    ratio = np.sqrt(np.trace(covariance, axis1=1, axis2=2)) / radius
    tier = np.searchsorted(list(ACROSS), ratio)
    told = np.abs(value) < FAR
    for number, (limit, points) in enumerate(ACROSS.items()):
        near = np.flatnonzero(told & (tier == number))
        if len(near) == 0:
            continue
        p, p_mean, p_covariance = _probability(
            event, near, position, covariance, normal, points, wide=limit > GRAZED
        )
        sure = np.clip(p, 1e-13, 1.0 - 1e-13)
        g = ndtri(sure)
        # Where the quadrature sees no more of it than rounding, the facet goes on telling which way.
        seen = sure == p
        unseen = near[~seen]
        sign = np.sign(g[~seen])
        value[unseen] = sign * np.maximum(sign * value[unseen], np.abs(g[~seen]))
        near, g, p_mean, p_covariance = near[seen], g[seen], p_mean[seen], p_covariance[seen]
        scale = 1.0 / NormalLaw().density(g)
        value[near] = g
        by_mean[near] = scale[:, None] * p_mean
        by_factor[near] = 2.0 * scale[:, None, None] * (p_covariance @ factor[near])
    return Quantiles(value, by_mean, by_factor)


def _probability(
    event: Event,
    near: Nodes,
    position: Array,
    covariance: Array,
    normal: Array,
    points: int,
    *,
    wide: bool,
) -> tuple[Array, Array, Array]:
    """P at some of the nodes with dP/dmean (k, 3) and the symmetric dP/dcovariance (k, 3, 3)."""
    root = np.asarray(np.linalg.cholesky(covariance[near]), dtype=float)
    first = _line_direction(root, normal[near], wide=wide)
    second = perpendicular(first)
    frame = np.stack([first, second, np.cross(first, second)], axis=1)  # rows
    u, v, weight = _grid_across(points)
    across = u[:, None] * frame[:, None, 1] + v[:, None] * frame[:, None, 2]  # (k, lines, 3)
    start = position[near, None] + np.einsum("nij,nmj->nmi", root, across)
    along = np.einsum("nij,nj->ni", root, first)[:, None]
    direction = np.broadcast_to(along, start.shape)
    k, m = start.shape[:2]

    def chords(regions: Sequence[Region]) -> tuple[Array, Array]:
        ends = [region.at(near).chord(start, direction) for region in regions]
        empty = np.zeros((k * m, 0))
        return (
            np.column_stack([empty, *(low.ravel() for low, _ in ends)]),
            np.column_stack([empty, *(high.ravel() for _, high in ends)]),
        )

    kept = kept_segments(chords(event.keep_in), chords(event.keep_out))
    node, line = np.divmod(kept.line, m)
    law = NormalLaw()
    p = np.bincount(node, weight[line] * law.between(kept.low, kept.high), minlength=k)
    by_mean, by_root = np.zeros((k, 3)), np.zeros((k, 3, 3))
    for s, limit, sign in ((kept.low, kept.low_limit, -1.0), (kept.high, kept.high_limit, 1.0)):
        for index, region in enumerate(event.limits):
            mine = np.flatnonzero(limit == index)
            at, s_at = node[mine], s[mine, None]
            point = start[at, line[mine]] + s_at * along[at, 0]
            drawn = across[at, line[mine]] + s_at * first[at]
            moved = end_velocity(region.at(near[at]).supporting(point).normal, along[at, 0])
            amount = sign * weight[line[mine]] * law.density(s[mine])
            gradient = amount[:, None] * moved
            gather = adding_up(at, k)
            by_mean += gather @ gradient
            outer = (gradient[:, :, None] * drawn[:, None]).reshape(-1, 9)
            by_root += np.asarray(gather @ outer).reshape(k, 3, 3)
    # P depends on the root L of the covariance only through LL': dP/dL = 2 G L.
    half = 0.5 * np.linalg.solve(root.swapaxes(1, 2), by_root.swapaxes(1, 2)).swapaxes(1, 2)
    return np.asarray(p, dtype=float), by_mean, 0.5 * (half + half.swapaxes(1, 2))


def _line_direction(root: Array, normal: Array, *, wide: bool) -> Array:
    """Unit vectors w such that lines run along L w, shape (k, 3).

    In standard deviations, those that meet the limit at right angles need the fewest points across.
    Where the spread is wide some of them graze it, and those along its normal serve better, unless they
    meet it at too much of a slant.
    """
    upright = np.einsum("nij,ni->nj", root, normal)
    straight = np.linalg.solve(root, normal[:, :, None])[:, :, 0]
    sizes = [np.linalg.norm(w, axis=1, keepdims=True) for w in (upright, straight)]
    slanted = sizes[0] * sizes[1] > np.hypot(1.0, SLANT)
    return np.where(slanted | (not wide), upright / sizes[0], straight / sizes[1])


@cache
def _grid_across(points: int) -> tuple[Array, Array, Array]:
    """Both coordinates across and the weight of each line, shape (points^2,)."""
    at, weights = np.polynomial.hermite_e.hermegauss(points)
    weights = weights / weights.sum()
    u, v = np.meshgrid(at, at)
    return u.ravel(), v.ravel(), np.outer(weights, weights).ravel()


def adding_up(rows: Nodes, count: int) -> sp.csr_array:
    """Map that adds entries up into the rows that they belong to, shape (count, entries)."""
    entries = len(rows)
    return sp.csr_array((np.ones(entries), (rows, np.arange(entries))), shape=(count, entries))


def end_velocity(normal: Array, direction: Array) -> Array:
    """ds/dr of where lines meet a surface, shape (n, 3): -n / n'v."""
    across = np.einsum("ni,ni->n", normal, direction)
    least = GRAZING * np.linalg.norm(direction, axis=1)
    across = np.where(np.abs(across) < least, np.copysign(least, across), across)
    return np.asarray(-normal / across[:, None])
