"""Choose facets of the chance constraints at a guess, by largest probability; then they are fixed.

Risk is split evenly over facets by Boole's inequality. Facets are those of polytopes around and inside
balls, and of pyramids around and inside circular cones.

A ball polytope is kept as the unit normals u_j of its facets. Then {y : u_j'y <= 1} contains the
unit ball with every facet tangent to it, and {y : u_j'y <= 1/reach} lies inside, where `reach` is
the distance of the outer polytope's farthest vertex.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
from scipy.spatial import ConvexHull
from scipy.special import ndtri

from formulations.arrays import Array, Booleans, Indices
from formulations.problem.flyby import FlybyProblem, StateConstraint
from formulations.problem.regions import (
    Ball,
    Cone,
    Ellipsoid,
    Halfspaces,
    Motion,
    Polytope,
    Region,
    perpendicular,
    reject,
    relative,
    unit,
    with_parameters,
)


@dataclass(frozen=True)
class BallPolytope:
    """Facets of a polytope about the unit ball.

    Attributes:
        normals: unit outward normals, shape (m, 3).
        reach: distance of the outer polytope's farthest vertex, > 1; 1/reach is its tightness.
        vertex: unit vector towards such a vertex, shape (3,).
    """

    normals: Array
    reach: float
    vertex: Array


def paper_ball() -> BallPolytope:
    """The paper's polytope: convex hull of six unit axes and eight unit cube corners, 24 equal facets.

    Source: Echigo et al., arXiv 2412.06816, section VI. All facets are equally far from the centre,
    so that their normals give both the inner and the outer polytope. A cube corner is the vertex
    turned to the line of sight.
    """
    axes = [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
    corners = [np.array(signs) / np.sqrt(3.0) for signs in product((1.0, -1.0), repeat=3)]
    planes = ConvexHull(np.array(axes + corners)).equations
    return BallPolytope(planes[:, :3], float(-1.0 / planes[0, 3]), corners[0])


@cache
def ball(facets: int) -> BallPolytope:
    """Polytope with a given number of facets: normals by farthest-point insertion.

    Starting from the regular tetrahedron, the next facet cuts off the farthest vertex. The facets
    for n are among those for n + 1, so the outer polytopes are nested and `reach` never grows.

    Raises:
        ValueError: with fewer than four facets, which bound no polytope.
    """
    if facets < 4:
        raise ValueError(f"a polytope needs at least 4 facets, got {facets}")
    normals = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3.0)
    while True:
        # A facet of the hull of the normals, at distance h along w, is the vertex w / h of the
        # outer polytope (polar duality).
        planes = ConvexHull(normals).equations
        far = int(np.argmax(planes[:, 3]))
        vertex, reach = planes[far, :3], -1.0 / planes[far, 3]
        if len(normals) == facets:
            return BallPolytope(normals, float(reach), vertex)
        normals = np.vstack([normals, vertex])


def inner_pyramid_angle(half_angle: float, facets: int) -> float:
    """Angle between axis and facets of the pyramid whose edges lie on a cone of `half_angle`.

    The outer pyramid's facets are tangent to the cone, at `half_angle` itself.

    Raises:
        ValueError: with fewer than three facets, which bound no pyramid.
    """
    if facets < 3:
        raise ValueError(f"a pyramid needs at least 3 facets, got {facets}")
    return float(np.arctan(np.tan(half_angle) * np.cos(np.pi / facets)))


def rotations_between(start: Array, end: Array) -> Array:
    """Smallest rotations that carry the unit vector `start` (3,) to the unit vectors `end` (n, 3).

    Rodrigues' formula in the form I + [v] + [v]^2 / (1 + c), shape (n, 3, 3). Where the two point
    apart it loses its digits, so the half-turn about the same axis is taken out first; antiparallel
    vectors turn about some perpendicular axis.
    """
    start = np.broadcast_to(start, end.shape)
    apart = np.einsum("ni,ni->n", start, end) < 0.0
    first = np.broadcast_to(np.eye(3), (len(end), 3, 3))
    if apart.any():
        axis = unit(reject(np.cross(start, end), start), perpendicular(start))
        half_turn = 2.0 * axis[:, :, None] * axis[:, None, :] - np.eye(3)
        first = np.where(apart[:, None, None], half_turn, first)
    start = np.where(apart[:, None], -start, start)
    v, c = np.cross(start, end), np.einsum("ni,ni->n", start, end)
    cross = np.zeros((len(end), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = v
    cross[:, [1, 2, 0], [2, 0, 1]] = -v
    return (np.eye(3) + cross + cross @ cross / (1.0 + c)[:, None, None]) @ first


ROUNDING = 1e-9
"""Room, nondimensional, within which two choices of facets leave the same."""


def split_risk(probability: float, parts: int) -> float:
    """Probability that each of `parts` events needs so that all hold together with `probability`.

    P(all) >= 1 - sum P(not each), so a uniform split requires 1 - (1 - p) / n of each.
    """
    return 1.0 - (1.0 - probability) / parts


def quantile(probability: float) -> float:
    """Standard normal quantile Psi^-1: P(a'x <= b) >= p iff a'mu + Psi^-1(p) ||S'a|| <= b.

    Raises:
        ValueError: if the probability is not in [0.5, 1); below one half the condition is not convex.
    """
    if not 0.5 <= probability < 1.0:
        raise ValueError(f"probability {probability} is outside [0.5, 1)")
    return float(ndtri(probability))


@dataclass(frozen=True)
class Polytopes:
    """Polytopes that approximate the regions.

    Attributes:
        ball: polytope about the unit ball, or None for a single facet through the sphere's point on
            the line of sight. That tangent facet is an outer approximation of a keep-in ball: a
            first-order condition, good while the spread is small against the radius, and to be
            backed by a Monte Carlo check. For a keep-out ball it is exact.
        cone_facets: facets of the pyramids about and inside cones.
    """

    ball: BallPolytope | None
    cone_facets: int


PARTS = "constraint", "node", "normal", "offset", "quantile"
"""Arrays of `Facets`."""


@dataclass(frozen=True, eq=False)
class Facets:
    """Affine chance constraints a'r_k + q ||S_k'a|| <= b on positions, m of them.

    Attributes:
        constraint: index into the problem's constraints, shape (m,).
        node: node index, shape (m,).
        normal: a, shape (m, 3).
        offset: b, shape (m,).
        quantile: q = Psi^-1 of the facet's share of the probability, shape (m,).
        motion: of the regions with p uncertain parameters; None without any. S_k is then the factor of
            the position relative to the region.
    """

    constraint: Indices
    node: Indices
    normal: Array
    offset: Array
    quantile: Array
    motion: Motion | None = None

    def chosen(self, which: Booleans) -> Facets:
        """The facets of a mask, shape (m,)."""
        motion = self.motion and self.motion.at(np.flatnonzero(which))
        own = {name: getattr(self, name)[which] for name in PARTS}
        return Facets(**own, motion=motion)

    def along(self, mean: Array, factor: Array) -> Array:
        """S_k'a of means (n_nodes, 6) and factors (n_nodes, 6 + p, c), shape (m, c)."""
        found = np.einsum("mi,mic->mc", self.normal, factor[self.node, :3])
        if self.motion is not None:
            seen = self.motion.seen(mean[self.node, :3])
            found += np.einsum("mi,mip,mpc->mc", self.normal, seen, factor[self.node, 6:])
        return np.asarray(found)

    def deviation(self, mean: Array, factor: Array) -> Array:
        """Standard deviation along each facet's normal, ||S_k'a||, (m,)."""
        return np.linalg.norm(self.along(mean, factor), axis=1)

    def margin(self, mean: Array, factor: Array) -> Array:
        """Room b - a'r_k - q ||S_k'a||, >= 0 where satisfied, (m,)."""
        distance = self.offset - np.einsum("mi,mi->m", self.normal, mean[self.node, :3])
        return distance - self.quantile * self.deviation(mean, factor)

    def are_near(self, others: Facets) -> bool:
        """Whether another choice at the same nodes is the same but for rounding."""
        pairs = (self.normal, others.normal), (self.offset, others.offset)
        return all(np.allclose(one, other) for one, other in pairs)

    def where_they_hold(self, others: Facets, mean: Array, factor: Array) -> Facets:
        """Another choice at the nodes where it holds or leaves no less room; these facets elsewhere.

        What is feasible with these facets is therefore feasible with the result. The others are of the
        same constraints and nodes in the same order; mean and factor as in `choose_facets`.
        """
        _, group = np.unique(np.stack([self.constraint, self.node]), axis=1, return_inverse=True)
        least = np.full((2, group.max(initial=-1) + 1), np.inf)
        for room, facets in zip(least, (self, others), strict=True):
            np.minimum.at(room, group, facets.margin(mean, factor))
        taken = (least[1] >= np.minimum(least[0], 0.0) - ROUNDING)[group]
        return replace(
            self,
            normal=np.where(taken[:, None], others.normal, self.normal),
            offset=np.where(taken, others.offset, self.offset),
        )


def choose_facets(
    problem: FlybyProblem, polytopes: Polytopes, mean: Array, factor: Array
) -> Facets:
    """Choose all facets of keep-in polytopes, and of each keep-out polytope the most probable one.

    The guess's means (n_nodes, 6), by their lines of sight, orient the polytopes; its factor has
    shape (n_nodes, 6 + p, c).
    """
    parts = [
        _constraint_facets(index, constraint, polytopes, mean, factor)
        for index, constraint in enumerate(problem.constraints)
    ]
    return _joined(problem, parts)


def touching_facets(problem: FlybyProblem, mean: Array) -> Facets:
    """A facet for each region that touches it nearest to the mean, with the whole probability.

    That is the probability of keep-in and keep-out sets to first order: the bends of their surfaces
    within the spread are left out. Shape of the mean as in `choose_facets`.
    """
    parts = []
    for index, one in enumerate(problem.constraints):
        plane = one.region.supporting(mean[one.nodes, :3])
        parts.append(_facets_of(index, one, [plane if one.keep == "in" else plane.complement()]))
    return _joined(problem, parts)


def _joined(problem: FlybyProblem, parts: Sequence[Facets]) -> Facets:
    """Facets of several constraints, in their order."""
    if not parts:
        none = np.zeros(0, dtype=np.intp)
        return Facets(none, none, np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    joined = {n: np.concatenate([getattr(part, n) for part in parts]) for n in PARTS}
    found = Facets(**joined, motion=None)
    if not problem.parameters:
        return found
    motions = [
        motion_at(constraint, problem.parameters, part.node)
        for constraint, part in zip(problem.constraints, parts, strict=True)
    ]
    fields = ([getattr(one, name) for one in motions] for name in ("apex", "shift", "turn"))
    return replace(found, motion=Motion(*(np.concatenate(each) for each in fields)))


def motion_at(constraint: StateConstraint, parameters: int, node: Indices) -> Motion:
    """The motion of a constraint's region at some of its nodes; none at all if it stays."""
    if constraint.motion is not None:
        return constraint.motion.at(np.searchsorted(constraint.nodes, node))
    still = np.zeros((len(node), 3, parameters))
    return Motion(np.zeros((len(node), 3)), still, still)


def _constraint_facets(
    index: int, constraint: StateConstraint, polytopes: Polytopes, mean: Array, factor: Array
) -> Facets:
    point = mean[constraint.nodes, :3]
    if constraint.keep == "in":
        return _facets_of(index, constraint, inner_facets(constraint.region, polytopes, point))
    outside = [plane.complement() for plane in outer_facets(constraint.region, polytopes, point)]
    own = relative(constraint.motion, point, with_parameters(factor[constraint.nodes]))
    return _facets_of(index, constraint, [_most_probable(outside, point, own)])


def _facets_of(index: int, constraint: StateConstraint, candidates: list[Halfspaces]) -> Facets:
    """Facets that hold together, with equal shares of a constraint's risk; one has the whole of it."""
    share = split_risk(constraint.probability, len(candidates))
    count = len(candidates) * len(constraint.nodes)
    return Facets(
        constraint=np.full(count, index),
        node=np.tile(constraint.nodes, len(candidates)),
        normal=np.concatenate([plane.normal for plane in candidates]),
        offset=np.concatenate([plane.offset for plane in candidates]),
        quantile=np.full(count, quantile(share)),
    )


def inner_facets(region: Region, polytopes: Polytopes, point: Array) -> list[Halfspaces]:
    """Facets of a polytope inside the region, a vertex or an edge of it turned towards `point`.

    If a facet faced `point` instead, the polytope would be thinnest where the spacecraft flies.
    """
    if isinstance(region, Ellipsoid):
        return [region.back(a) for a in inner_facets(region.ball, polytopes, region.seen(point))]
    if isinstance(region, Halfspaces | Polytope):
        return [region.supporting(point)]
    if isinstance(region, Ball):
        if polytopes.ball is None:
            return [region.supporting(point)]
        return _turned_ball(
            region, polytopes.ball, polytopes.ball.vertex, point, polytopes.ball.reach
        )
    n = polytopes.cone_facets
    return _pyramid(region, inner_pyramid_angle(region.half_angle, n), n, np.pi / n, point)


def outer_facets(region: Region, polytopes: Polytopes, point: Array) -> list[Halfspaces]:
    """Facets of a polytope around the region, one of them turned towards `point`."""
    if isinstance(region, Ellipsoid):
        return [region.back(a) for a in outer_facets(region.ball, polytopes, region.seen(point))]
    if isinstance(region, Halfspaces):
        return [region]
    if isinstance(region, Polytope):
        n = len(point)
        every = zip(region.normal, region.offset, strict=True)
        return [Halfspaces(np.tile(a, (n, 1)), np.full(n, b)) for a, b in every]
    if isinstance(region, Ball):
        if polytopes.ball is None:
            return [region.supporting(point)]
        return _turned_ball(region, polytopes.ball, polytopes.ball.normals[0], point, 1.0)
    return _pyramid(region, region.half_angle, polytopes.cone_facets, 0.0, point)


def _turned_ball(
    region: Ball, polytope: BallPolytope, facing: Array, point: Array, shrink: float
) -> list[Halfspaces]:
    sight = region.supporting(point).normal
    normals = np.einsum("nij,mj->mni", rotations_between(facing, sight), polytope.normals)
    offsets = np.einsum("mni,ni->mn", normals, region.center) + region.radius / shrink
    return [Halfspaces(a, b) for a, b in zip(normals, offsets, strict=True)]


def _pyramid(
    region: Cone, angle: float, facets: int, first_azimuth: float, point: Array
) -> list[Halfspaces]:
    across = region.across(point)
    side = np.cross(region.axis, across)
    azimuths = first_azimuth + 2.0 * np.pi * np.arange(facets) / facets
    return [region.facets(np.cos(phi) * across + np.sin(phi) * side, angle) for phi in azimuths]


def _most_probable(candidates: list[Halfspaces], point: Array, factor: Array) -> Halfspaces:
    """Choose at each node the half-space with the largest probability: argmax (b - a'mu) / ||S'a||."""
    normal = np.stack([plane.normal for plane in candidates])  # (m, n, 3)
    offset = np.stack([plane.offset for plane in candidates])
    slack = offset - np.einsum("mni,ni->mn", normal, point)
    spread = normal.swapaxes(0, 1) @ factor  # (n, m, c)
    deviation = np.sqrt(np.einsum("nmc,nmc->mn", spread, spread))
    # Without spread the quotient is a very large number of the slack's sign and order.
    best = np.argmax(slack / np.maximum(deviation, 1e-150), axis=0)
    nodes = np.arange(len(point))
    return Halfspaces(normal[best, nodes], offset[best, nodes])
