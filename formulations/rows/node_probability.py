"""Compute at each node the probability that a joint constraint holds, with its gradient.

Balls, ellipsoids and cones are quadratic forms of the position. Their probability is one integral
along a contour: see `risk.quadratic_forms`. The limits of an event are nested. No position breaks
two of them, so the probabilities of breaking each add up. On the normal quantile scale, g =
Phi^-1(P), a half-space gives the mean's distance in standard deviations. There g is nearly affine
in mean and deviation. Gradients are by mean and covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.arrays import Array, Indices
from formulations.problem.flyby import StateConstraint
from formulations.problem.regions import Ball, Cone, Ellipsoid, Halfspaces, Motion, Polytope, Region
from formulations.risk.lines import normal_density
from formulations.risk.quadratic_forms import NAPPE, WHOLE, Below, below, below_beyond

FAR = 7.0
"""Deviations from a limit beyond which it is kept or broken for certain, up to 1e-11."""

LEAST = 1e-13
"""Least probability for which the integral gives g; below it may be nothing but rounding."""

APEX = 6.0
"""Deviations along its axis from a cone's apex beyond which its other nappe holds nothing: < 1e-9."""

SPREAD_MIN = 1e-6
"""Standard deviation, in units of length, that is added in each direction: at most a millimetre,
which counts as no violation. Without it a flight without errors would have no gradient."""


ROUNDING = 1e-14
"""Share of the variance that rounding may take from a direction across it."""


class Quantiles(NamedTuple):
    """g at n nodes, (n,), its derivatives in mean position, (n, 3), and in factor, (n, 3, c)."""

    value: Array
    by_mean: Array
    by_factor: Array


@dataclass(frozen=True)
class Event:
    """A joint constraint: limits, with a region per node, that must hold together at n nodes.

    All its regions have one motion with the uncertain parameters; None where they stay.
    """

    name: str
    nodes: Indices
    keep_in: tuple[Region, ...]
    keep_out: tuple[Region, ...]
    motion: Motion | None = None

    def check_nested(self) -> None:
        """Check that there is at most one keep-in and one keep-out, the latter within the former.

        There may be many keep-in half-spaces: the probabilities of leaving each add up to a bound
        (Boole).

        Raises:
            ValueError: if the limits are not nested so.
        """
        if all(isinstance(region, Halfspaces) for region in self.limits) and not self.keep_out:
            return
        if not (len(self.keep_in) <= 1 and len(self.keep_out) <= 1):
            raise ValueError(f"{self.name} has more than two limits")
        for outer, inner in zip(self.keep_in, self.keep_out, strict=False):
            if not _holds(outer, inner):
                raise ValueError(f"the limits of {self.name} are not nested")

    @property
    def limits(self) -> tuple[Region, ...]:
        """All regions, in the order in which `Segments` counts them."""
        return self.keep_in + self.keep_out

    def at(self, which: Indices) -> Event:
        """The event at some of its nodes only."""
        return Event(
            self.name,
            self.nodes[which],
            tuple(region.at(which) for region in self.keep_in),
            tuple(region.at(which) for region in self.keep_out),
            self.motion and self.motion.at(which),
        )

    def facets(self, position: Array) -> tuple[Array, Array]:
        """Facets a'r <= b that support each limit nearest to n points; (limits, n, 3), (limits, n)."""
        planes = [region.supporting(position) for region in self.keep_in]
        planes += [region.supporting(position).complement() for region in self.keep_out]
        return np.stack([p.normal for p in planes]), np.stack([p.offset for p in planes])


def _holds(outer: Region, inner: Region) -> bool:
    """Whether a region contains another of its kind at all nodes, up to rounding."""
    if isinstance(outer, Ball) and isinstance(inner, Ball):
        apart = np.linalg.norm(outer.center - inner.center, axis=1)
        return bool(np.all(apart <= outer.radius - inner.radius + SPREAD_MIN))
    if isinstance(outer, Cone) and isinstance(inner, Cone):
        apart = np.linalg.norm(np.cross(outer.axis, inner.axis), axis=1)
        ahead = np.einsum("ni,ni->n", outer.axis, inner.axis)
        turned = np.arctan2(apart, ahead) <= outer.half_angle - inner.half_angle + SPREAD_MIN
        return bool(np.all(turned & np.all(outer.apex == inner.apex, axis=1)))
    return False


def joint_events(constraints: Sequence[StateConstraint]) -> tuple[Event, ...]:
    """The joint constraints to which some constraints belong, in their order."""
    names = dict.fromkeys(c.event for c in constraints)
    sides = {name: [c for c in constraints if c.event == name] for name in names}
    return tuple(
        Event(
            name,
            own[0].nodes,
            tuple(c.region for c in own if c.keep == "in"),
            tuple(c.region for c in own if c.keep == "out"),
            own[0].motion,
        )
        for name, own in sides.items()
    )


def node_quantiles(event: Event, position: Array, factor: Array) -> Quantiles:
    """The quantile g at each node and its gradient, for mean positions (n, 3) and factors (n, 3, c).

    The factors are those of the positions relative to regions that stay: see `moving_quantiles`.

    Raises:
        ValueError: if the event's limits are not nested.
    """
    event.check_nested()
    if isinstance(region := event.limits[0], Ellipsoid):
        own = (region.ball,)
        ball = Event(event.name, event.nodes, *((own, ()) if event.keep_in else ((), own)))
        seen_as = node_quantiles(ball, region.seen(position), region.matrix @ factor)
        by_mean, by_factor = seen_as.by_mean @ region.matrix, region.matrix.T @ seen_as.by_factor
        return Quantiles(seen_as.value, by_mean, by_factor)
    covariance = factor @ factor.swapaxes(1, 2)
    # A spread in one direction alone leaves nothing but rounding across it.
    least = SPREAD_MIN**2 + ROUNDING * np.trace(covariance, axis1=1, axis2=2)
    covariance += least[:, None, None] * np.eye(3)
    normals, offsets = event.facets(position)
    sigmas = np.sqrt(np.einsum("lni,nij,lnj->ln", normals, covariance, normals))
    values = (offsets - np.einsum("lni,ni->ln", normals, position)) / sigmas
    nearest, nodes = np.argmin(values, axis=0), np.arange(len(position))
    normal, sigma, value = (part[nearest, nodes] for part in (normals, sigmas, values))
    by_mean = -normal / sigma[:, None]
    along = np.einsum("ni,nic->nc", normal, factor)
    by_factor = -(value / sigma**2)[:, None, None] * normal[:, :, None] * along[:, None]
    near, missed = _missed(event, position, covariance, values)
    sure = np.clip(missed.below, LEAST, 1.0 - LEAST)
    g = np.where(sure < 0.5, -ndtri(sure), ndtri(1.0 - sure))
    # Where the integral sees no more of it than rounding, the facet goes on telling which way.
    seen = sure == missed.below
    unseen = near[~seen]
    sign = np.sign(g[~seen])
    value[unseen] = sign * np.maximum(sign * value[unseen], np.abs(g[~seen]))
    scale = -1.0 / normal_density(g[seen])
    near = near[seen]
    value[near] = g[seen]
    by_mean[near] = scale[:, None] * missed.by_mean[seen]
    by_factor[near] = 2.0 * scale[:, None, None] * (missed.by_covariance[seen] @ factor[near])
    return Quantiles(value, by_mean, by_factor)


def moving_quantiles(event: Event, position: Array, factor: Array, parameters: Array) -> Quantiles:
    """As `node_quantiles` of regions that may move; `parameters` are the parameters' rows (p, c).

    The gradient is by the positions themselves, and by their factors.
    """
    if event.motion is None:
        return node_quantiles(event, position, factor)
    g = node_quantiles(event, position, factor + event.motion.seen(position) @ parameters)
    by_mean = g.by_mean + event.motion.pulled(g.by_factor @ parameters.T)
    return Quantiles(g.value, by_mean, g.by_factor)


def _missed(
    event: Event, position: Array, covariance: Array, values: Array
) -> tuple[Indices, Below]:
    """Nodes where the event is neither sure nor impossible, and the probability that it fails there.

    A position beyond a region's facet is outside the region; the converse holds nearly only where the
    mean is outside.
    """
    n, count = len(position), len(event.keep_in)
    reach = FAR * np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    depth = np.stack([region.inside(position) for region in event.limits])
    inner = np.arange(len(event.limits))[:, None] < count
    outside = np.where(inner, -values, values) > FAR
    inside = depth > reach
    lost = np.where(inner, outside, inside).any(axis=0)
    open_ = ~(outside | inside) & ~lost
    total = Below(np.zeros(n), np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3, 3)))
    for number, region in enumerate(event.limits):
        near = np.flatnonzero(open_[number])
        if len(near) == 0:
            continue
        held = _held(region.at(near), position[near], covariance[near])
        sign = -1.0 if number < count else 1.0
        total.below[near] += held.above if number < count else held.below
        total.by_mean[near] += sign * held.by_mean
        total.by_covariance[near] += sign * held.by_covariance
    near = np.flatnonzero(open_.any(axis=0))
    return near, Below(*(part[near] for part in total))


def _held(region: Region, position: Array, covariance: Array) -> Below:
    """Probability of a region at each node."""
    n = len(position)
    if isinstance(region, Ball):
        sphere = np.broadcast_to(np.eye(3), (n, 3, 3))
        return below(sphere, position - region.center, np.full(n, region.radius**2), covariance)
    if isinstance(region, Halfspaces | Polytope):
        return _held_planes(_least_likely(region, position, covariance), position, covariance)
    assert isinstance(region, Cone)
    axis, d = region.axis, position - region.apex
    matrix = np.cos(region.half_angle) ** 2 * np.eye(3) - axis[:, :, None] * axis[:, None]
    spread = np.sqrt(np.einsum("ni,nij,nj->n", axis, covariance, axis))
    height = np.einsum("ni,ni->n", axis, d) / spread
    held = Below(np.zeros(n), np.ones(n), np.zeros((n, 3)), np.zeros((n, 3, 3)))
    ahead, astride = height > APEX, np.abs(height) <= APEX
    for some, rule in ((ahead, WHOLE), (astride & (height > 0.0), NAPPE)):
        part = below(matrix[some], d[some], np.zeros(some.sum()), covariance[some], rule)
        for all_of, new in zip(held, part, strict=True):
            all_of[some] = new
    # The nappe that the mean is not on; where it is the wrong one it is seen from the other side.
    if np.any(astride):
        side = np.where(height[astride] > 0.0, -1.0, 1.0)
        nappe = below_beyond(
            matrix[astride], side[:, None] * d[astride], axis[astride], covariance[astride]
        )
        held.below[astride] += side * nappe.below
        held.above[astride] -= side * nappe.below
        held.by_mean[astride] += nappe.by_mean
        held.by_covariance[astride] += side[:, None, None] * nappe.by_covariance
    return held


def _least_likely(region: Halfspaces | Polytope, position: Array, covariance: Array) -> Halfspaces:
    """The face of a polytope below which each position is least likely, a bound for the polytope."""
    if isinstance(region, Halfspaces):
        return region
    sigma = np.sqrt(np.einsum("fi,nij,fj->nf", region.normal, covariance, region.normal))
    least = np.argmin((region.offset - position @ region.normal.T) / sigma, axis=1)
    return Halfspaces(region.normal[least], region.offset[least])


def _held_planes(planes: Halfspaces, position: Array, covariance: Array) -> Below:
    """Probability of half-spaces: Phi of the distance in standard deviations."""
    normal = planes.normal
    variance = np.einsum("ni,nij,nj->n", normal, covariance, normal)
    sigma = np.sqrt(variance)
    g = planes.inside(position) / sigma
    density = normal_density(g)
    outer = normal[:, :, None] * normal[:, None]
    by_covariance = -(0.5 * density * g / variance)[:, None, None] * outer
    return Below(ndtr(g), ndtr(-g), -(density / sigma)[:, None] * normal, by_covariance)
