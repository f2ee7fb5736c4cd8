"""Regions of the position, one per node: distances, planes and chords.

All are convex, so the complement of each is described by supporting planes: for a point x the
plane a'y = b that touches the region where it is closest to x. With it

    inside(x) = b - a'x

is the signed distance of x to the region's surface, positive inside (for a cone: to the infinite
surface of the plane through the axis, which is the distance wherever the nearest point is not the
apex; for an ellipsoid in coordinates in which it is a ball). Keep-in demands inside(x) >= 0, keep-out
demands inside(x) <= 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from numbers import Real

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array, Booleans, Indices


@dataclass(frozen=True)
class Halfspaces:
    """Half-spaces a'y <= b: unit normals a (n, 3) and offsets b (n,).

    As planes that touch an ellipsoid their normals are shorter.

    Attributes:
        normal: a.
        offset: b.

    Examples:
        >>> Halfspaces(np.array([[1.0, 0.0, 0.0]]), np.array([3.0])).inside(np.ones((1, 3))).item()
        2.0
    """

    normal: Array
    offset: Array

    def __post_init__(self) -> None:
        """Refuse normals that are no vectors."""
        check_vectors(normal=self.normal)

    def at(self, which: Indices) -> Halfspaces:
        """The half-spaces of some nodes."""
        return Halfspaces(self.normal[which], self.offset[which])

    def supporting(self, point: Array) -> Halfspaces:
        """Themselves, whatever the points (n, 3)."""
        del point
        return self

    def inside(self, point: Array) -> Array:
        """Signed distance of points (n, ..., 3) to the planes, positive inside, (n, ...)."""
        offset = self.offset.reshape(-1, *[1] * (point.ndim - 2))
        return np.asarray(offset - np.einsum("n...i,ni->n...", point, self.normal))

    def chord(self, start: Array, direction: Array) -> Chord:
        """See `Chord`; from starts (n, k or 1, 3) along directions (n, k, 3)."""
        climb = np.einsum("nki,ni->nk", direction, self.normal)
        room = np.broadcast_to(self.inside(start), climb.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            met = room / climb
        low, high = np.where(climb < 0.0, met, -np.inf), np.where(climb > 0.0, met, np.inf)
        outside = (climb == 0.0) & (room < 0.0)
        return np.where(outside, np.inf, low), high

    @cached_property
    def second_order_cone(self) -> SecondOrderCone:
        """0 <= b - a'y."""
        zero = np.zeros_like(self.normal)
        return _second_order_cone(zero, np.zeros((3, 3)), -self.normal, self.offset)

    def complement(self) -> Halfspaces:
        """The closed half-spaces on the other side of the same planes."""
        return Halfspaces(-self.normal, -self.offset)


SecondOrderCone = tuple[Array, Array, Array]
"""M (n, 4, 3), r (n, 3) and m (n, 4) of regions with ||y_1..|| <= y_0, y = M (position - r) + m."""


def _second_order_cone(
    origin: Array, matrix: Array, linear: Array, constant: Array | float
) -> SecondOrderCone:
    """Cone || matrix (y - origin) || <= linear'(y - origin) + constant; one matrix serves all nodes."""
    matrices = np.broadcast_to(matrix, (len(origin), 3, 3))
    both = np.concatenate([linear[:, None], matrices], axis=1)
    return both, origin, np.reshape(constant, (-1, 1)) * np.eye(1, 4)


def unit(vector: Array, fallback: Array) -> Array:
    """Unit vectors; where the vector vanishes, `fallback` (a direction is not unique there)."""
    largest = np.abs(vector).max(axis=-1, keepdims=True)
    zero = largest == 0.0
    scaled = vector / np.where(zero, 1.0, largest)  # whose square neither overflows nor vanishes
    return np.where(zero, fallback, scaled / np.where(zero, 1.0, _size(scaled)))


def _size(vector: Array) -> Array:
    """Norms of vectors (..., 3), shape (..., 1): faster than a reduction along so short an axis."""
    square = vector * vector
    return np.sqrt(square[..., 0] + square[..., 1] + square[..., 2])[..., None]


def reject(vector: Array, axis: Array) -> Array:
    """Part of each vector across a unit axis, (n, 3); zero where only rounding is left.

    The part along the axis is removed twice: its rounding matters where the part across is small.
    """
    across = vector
    for _ in range(2):
        across = across - np.einsum("ni,ni->n", across, axis)[:, None] * axis
    left = _size(across) > 4.0 * np.finfo(float).eps * _size(vector)
    return np.where(left, across, 0.0)


def perpendicular(axis: Array) -> Array:
    """Some unit vector perpendicular to each axis (n, 3)."""
    least = np.eye(3)[np.argmin(np.abs(axis), axis=-1)]
    return unit(np.cross(axis, least), least)


def _for_each(vector: Array, point: Array) -> Array:
    """Vectors (n, 3) of nodes, for points (n, ..., 3)."""
    return vector.reshape(len(vector), *[1] * (point.ndim - 2), 3)


Chord = tuple[Array, Array]
"""Interval of s in which lines start + s direction lie in a region; (inf, inf) if none."""


def _roots(a: Array, b: Array, c: Array) -> Chord:
    """Both roots of a s^2 + 2 b s + c in ascending order, without cancellation; inf if there are none.

    For negative `a` there always are two. A zero `a` is treated as negative: one root is infinite.
    """
    discriminant = b * b - a * c
    none = ~((discriminant > 0.0) | (a < 0.0))
    q = -(b + np.copysign(np.sqrt(np.maximum(discriminant, 0.0)), b))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        one, other = q / np.where(a == 0.0, -0.0, a), np.where(q == 0.0, 0.0, c / q)
    low, high = np.minimum(one, other), np.maximum(one, other)
    low[none] = high[none] = np.inf
    return low, high


def _all_along(still: Booleans, low: Array, high: Array) -> Chord:
    """Interval of a line without direction: all of it if it starts inside, else unchanged."""
    if not still.any():
        return low, high
    return np.where(still, -np.inf, low), np.where(still, np.inf, high)


def check_size(
    name: str, given: object, below: float = np.inf, allowed: str = "0 or more, and finite"
) -> None:
    """Refuse what is no number from 0 to less than a bound.

    Raises:
        ValueError: naming the entry, what was given and what is allowed.
    """
    if isinstance(given, bool) or not (isinstance(given, Real) and 0.0 <= float(given) < below):
        raise ValueError(f"{name}: got {given!r}; must be {allowed}")


def check_vectors(**named: npt.ArrayLike) -> None:
    """Refuse what is no vector of three finite numbers, or rows of such; rows by their shape alone.

    Raises:
        ValueError: naming the entry, what was given and what is allowed.
    """
    for name, given in named.items():
        if isinstance(given, np.ndarray) and given.ndim == 2 and given.shape[1] == 3:
            continue  # as the programs make them, at every iteration
        try:
            array = np.asarray(given, dtype=float)
        except (TypeError, ValueError):
            array = np.zeros(0)
        if array.ndim not in (1, 2) or array.shape[-1] != 3 or not np.isfinite(array).all():
            words = " ".join(f"{given!r}".split())[:60]
            raise ValueError(f"{name}: got {words}; must be three finite numbers, or rows of three")


@dataclass(frozen=True)
class Ball:
    """Points within `radius` of `center` (n, 3).

    Examples:
        >>> Ball(np.zeros((1, 3)), 2.0).inside(np.array([[0.0, 0.5, 0.0]])).item()
        1.5
    """

    center: Array
    radius: float

    def __post_init__(self) -> None:
        """Refuse a center or a radius of no ball."""
        check_vectors(center=self.center)
        check_size("radius", self.radius)

    def at(self, which: Indices) -> Ball:
        """The balls of some nodes."""
        return Ball(self.center[which], self.radius)

    def supporting(self, point: Array) -> Halfspaces:
        """Half-spaces that contain the balls and touch them towards each point (n, 3)."""
        up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), self.center.shape)
        normal = unit(point - self.center, up)
        return Halfspaces(normal, np.einsum("ni,ni->n", normal, self.center) + self.radius)

    def inside(self, point: Array) -> Array:
        """Signed distance of points (n, ..., 3) to the surface, positive inside, (n, ...)."""
        off = point - _for_each(self.center, point)
        return np.asarray(self.radius - np.sqrt(np.einsum("...i,...i->...", off, off)))

    def chord(self, start: Array, direction: Array) -> Chord:
        """See `Chord`; from starts (n, k or 1, 3) along directions (n, k, 3)."""
        off = start - self.center[:, None]
        a = np.einsum("nki,nki->nk", direction, direction)
        b = np.einsum("nki,nki->nk", direction, off)
        c = np.einsum("nki,nki->nk", off, off) - self.radius**2
        return _all_along((a == 0.0) & (c < 0.0), *_roots(a, b, c))

    @cached_property
    def second_order_cone(self) -> SecondOrderCone:
        """|| y - center || <= radius."""
        zero = np.zeros_like(self.center)
        return _second_order_cone(self.center, np.eye(3), zero, self.radius)


@dataclass(frozen=True)
class Cone:
    """Points seen from `apex` (n, 3) within `half_angle` < pi/2 of the unit `axis` (n, 3).

    Examples:
        >>> cone = Cone(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.pi / 6.0)
        >>> round(cone.inside(np.array([[0.0, 0.0, 2.0]])).item(), 9)
        1.0
    """

    apex: Array
    axis: Array
    half_angle: float

    def __post_init__(self) -> None:
        """Refuse vectors or an angle of no convex cone."""
        check_vectors(apex=self.apex, axis=self.axis)
        check_size("half_angle", self.half_angle, np.pi / 2.0, "from 0 to less than pi/2, rad")

    @cached_property
    def _side(self) -> Array:
        return perpendicular(self.axis)

    def at(self, which: Indices) -> Cone:
        """The cones of some nodes."""
        return Cone(self.apex[which], self.axis[which], self.half_angle)

    def across(self, point: Array) -> Array:
        """Unit vectors of the points' parts across the axis, (n, 3)."""
        return unit(reject(point - self.apex, self.axis), self._side)

    def facets(self, across: Array, half_angle: float) -> Halfspaces:
        """Planes through the apex, `half_angle` off the axis towards the unit vectors `across`."""
        normal = np.cos(half_angle) * across - np.sin(half_angle) * self.axis
        return Halfspaces(normal, np.einsum("ni,ni->n", normal, self.apex))

    def supporting(self, point: Array) -> Halfspaces:
        """Half-spaces that contain the cones and touch them along the ray nearest to each point."""
        return self.facets(self.across(point), self.half_angle)

    def inside(self, point: Array) -> Array:
        """Signed distance of points (n, ..., 3) to the surface, positive inside, (n, ...)."""
        d = point - _for_each(self.apex, point)
        along = np.einsum("n...i,ni->n...", d, self.axis)
        d -= along[..., None] * _for_each(self.axis, point)
        across = np.sqrt(np.einsum("...i,...i->...", d, d))
        return np.asarray(np.sin(self.half_angle) * along - np.cos(self.half_angle) * across)

    def chord(self, start: Array, direction: Array) -> Chord:
        """See `Chord`; from starts (n, k or 1, 3) along directions (n, k, 3).

        cos^2 |d|^2 <= (u'd)^2 holds on both nappes; the sign of u'd says on which a root is.
        """
        off = start - self.apex[:, None]
        along, climb = (np.einsum("nki,ni->nk", part, self.axis) for part in (off, direction))
        cos2 = np.cos(self.half_angle) ** 2
        a = cos2 * np.einsum("nki,nki->nk", direction, direction) - climb**2
        b = cos2 * np.einsum("nki,nki->nk", direction, off) - climb * along
        c = cos2 * np.einsum("nki,nki->nk", off, off) - along**2
        low, high = _roots(a, b, c)
        # Steeper than the cone a line leaves one nappe at the lower root and enters the other above.
        steep = a <= 0.0
        up = climb > 0.0
        first = np.where(steep & ~up, -np.inf, np.where(steep, high, low))
        last = np.where(steep & up, np.inf, np.where(steep, low, high))
        met = (low < np.inf) & (first < last)
        met &= steep | (along + climb * np.where(met, low, 0.0) > 0.0)
        still = (a == 0.0) & (b == 0.0) & (c < 0.0) & (along > 0.0)
        return _all_along(still, np.where(met, first, np.inf), np.where(met, last, np.inf))

    @cached_property
    def second_order_cone(self) -> SecondOrderCone:
        """cos(theta) || (I - u u')(y - apex) || <= sin(theta) u'(y - apex)."""
        across = np.eye(3) - self.axis[:, :, None] * self.axis[:, None, :]
        cos, sin = np.cos(self.half_angle), np.sin(self.half_angle)
        return _second_order_cone(self.apex, cos * across, sin * self.axis, 0.0)


@dataclass(frozen=True)
class Ellipsoid:
    """Points y with || matrix (y - center) || <= radius; centers (n, 3), a matrix (3, 3) of norm one.

    A ball of this radius in the coordinates matrix (y - center).

    Attributes:
        center: one a node.
        matrix: of all nodes.
        radius: in the units of positions.

    Examples:
        >>> egg = Ellipsoid(np.zeros((1, 3)), np.diag([1.0, 0.5, 0.5]), 2.0)
        >>> egg.inside(np.array([[0.0, 4.0, 0.0]])).item()
        0.0
    """

    center: Array
    matrix: Array
    radius: float = 1.0

    def __post_init__(self) -> None:
        """Refuse a center, a matrix or a radius of no ellipsoid."""
        check_vectors(center=self.center, matrix=self.matrix)
        check_size("radius", self.radius)

    @cached_property
    def ball(self) -> Ball:
        """The ball that it is."""
        return Ball(np.zeros_like(self.center), self.radius)

    def seen(self, point: Array) -> Array:
        """Points (n, ..., 3) in the coordinates in which it is a ball."""
        return np.asarray((point - _for_each(self.center, point)) @ self.matrix.T)

    def back(self, planes: Halfspaces) -> Halfspaces:
        """Half-spaces of positions, from half-spaces in those coordinates."""
        normal = planes.normal @ self.matrix
        return Halfspaces(normal, planes.offset + np.einsum("ni,ni->n", normal, self.center))

    def at(self, which: Indices) -> Ellipsoid:
        """The ellipsoids of some nodes."""
        return Ellipsoid(self.center[which], self.matrix, self.radius)

    def supporting(self, point: Array) -> Halfspaces:
        """Half-spaces that contain the ellipsoids and touch them on the rays to points (n, 3)."""
        return self.back(self.ball.supporting(self.seen(point)))

    def inside(self, point: Array) -> Array:
        """Depth of points (n, ..., 3), at most the distance to the surface, (n, ...)."""
        return self.ball.inside(self.seen(point))

    def chord(self, start: Array, direction: Array) -> Chord:
        """See `Chord`; from starts (n, k or 1, 3) along directions (n, k, 3)."""
        return self.ball.chord(self.seen(start), direction @ self.matrix.T)

    @cached_property
    def second_order_cone(self) -> SecondOrderCone:
        """|| matrix (y - center) || <= radius."""
        zero = np.zeros_like(self.center)
        return _second_order_cone(self.center, self.matrix, zero, self.radius)


@dataclass(frozen=True)
class Polytope:
    """Keep-out set of points with a'y <= b for all m faces: unit normals (m, 3), offsets (m,).

    The polytope is the same at all nodes. A keep-in polytope is given as half-spaces instead.

    Attributes:
        normal: a.
        offset: b.

    Examples:
        >>> box = Polytope(np.vstack([np.eye(3), -np.eye(3)]), np.ones(6))
        >>> box.inside(np.array([0.0, 0.75, 0.0])).item()
        0.25
    """

    normal: Array
    offset: Array

    def __post_init__(self) -> None:
        """Refuse normals that are no vectors."""
        check_vectors(normal=self.normal)

    def at(self, which: Indices) -> Polytope:
        """The polytope at some nodes, the same as at all."""
        del which
        return self

    def supporting(self, point: Array) -> Halfspaces:
        """For each point (n, 3), the half-space of the face with the least signed distance."""
        nearest = np.argmin(self.offset - point @ self.normal.T, axis=-1)
        return Halfspaces(self.normal[nearest], self.offset[nearest])

    def inside(self, point: Array) -> Array:
        """Signed distance of points (..., 3) to the nearest or farthest face, positive inside."""
        return np.asarray((self.offset - point @ self.normal.T).min(axis=-1))

    def chord(self, start: Array, direction: Array) -> Chord:
        """See `Chord`; from starts (n, k or 1, 3) along directions (n, k, 3)."""
        n = len(direction)
        chords = [
            Halfspaces(np.tile(a, (n, 1)), np.full(n, b)).chord(start, direction)
            for a, b in zip(self.normal, self.offset, strict=True)
        ]
        low, high = (np.array(ends) for ends in zip(*chords, strict=True))
        first, last = low.max(axis=0), high.min(axis=0)
        met = first < last
        return np.where(met, first, np.inf), np.where(met, last, np.inf)

    @property
    def second_order_cone(self) -> SecondOrderCone:
        """Refuse: a keep-in polytope is as many cones as it has faces.

        Raises:
            ValueError: always.
        """
        raise ValueError("a polytope is kept in face by face, as half-spaces")


Region = Ball | Cone | Halfspaces | Ellipsoid | Polytope


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of a region at n nodes with p uncertain parameters of standard normal law.

    A site whose position is uncertain takes the limits about it along, and so does a body whose spin
    is. To first order in the parameters w a region's apex moves by shift w, and its axes turn by turn w
    about the apex c. Seen from the region, a position r is then at

        r + D(r) w,    D(r) = -(shift + turn x (r - c)),

    and keeps a limit if that point is in the region as it is planned with.

    Attributes:
        apex: that the region turns about, shape (n, 3).
        shift: of the apex with each parameter, shape (n, 3, p).
        turn: rotation vector of the axes with each parameter, rad, shape (n, 3, p).
    """

    apex: Array
    shift: Array
    turn: Array

    def at(self, which: Indices) -> Motion:
        """The motion at some of the nodes."""
        return Motion(self.apex[which], self.shift[which], self.turn[which])

    def seen(self, point: Array) -> Array:
        """D of points (n, 3), shape (n, 3, p)."""
        off = (point - self.apex)[:, :, None]
        return -(self.shift + np.cross(self.turn, off, axis=1))

    def slope(self, normal: Array) -> Array:
        """Derivative of normals' a'D (n, p) by the points, for normals (n, 3): shape (n, 3, p)."""
        return -np.cross(normal[:, :, None], self.turn, axis=1)

    def of_draws(self, point: Array, draws: Array) -> Array:
        """Points (n, m, 3) as seen from the region, for m draws (m, p) of the parameters."""
        shift, turn = (np.einsum("nip,mp->nmi", a, draws) for a in (self.shift, self.turn))
        return np.asarray(point - shift - np.cross(turn, point - self.apex[:, None]))

    def pulled(self, by_seen: Array) -> Array:
        """Derivatives by the points, (n, 3), of functions with derivatives (n, 3, p) by D."""
        return np.asarray(-np.cross(by_seen, self.turn, axis=1).sum(axis=2))


def with_parameters(factor: Array) -> Array:
    """Rows of the position and of the parameters of factors (n, 6 + p, c), shape (n, 3 + p, c)."""
    return factor[:, :3] if factor.shape[1] == 6 else np.delete(factor, (3, 4, 5), axis=1)


def relative(motion: Motion | None, point: Array, factor: Array) -> Array:
    """Factors (n, 3, c) of points (n, 3) relative to a region, from `with_parameters` (n, 3 + p, c)."""
    if motion is None:
        return factor[:, :3]
    return np.asarray(factor[:, :3] + motion.seen(point) @ factor[:, 3:])
