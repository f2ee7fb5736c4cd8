"""Build polytopes around and inside the unit ball, and pyramids around and inside a circular cone.

A ball polytope is kept as the unit normals u_j of its facets. Then {y : u_j'y <= 1} contains the
unit ball with every facet tangent to it, and {y : u_j'y <= 1/reach} lies inside, where `reach` is
the distance of the outer polytope's farthest vertex.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from scipy.spatial import ConvexHull

from formulations.arrays import Array
from formulations.problem.regions import perpendicular, reject, unit


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
