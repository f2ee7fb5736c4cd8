"""Regions of the position, balls and circular cones, one per node: distances, planes and chords.

Both are convex, so the complement of either is described by supporting planes: for a point x the
plane a'y = b that touches the region where it is closest to x. With it

    inside(x) = b - a'x

is the signed distance of x to the region's surface, positive inside (for a cone: to the infinite
surface of the plane through the axis, which is the distance wherever the nearest point is not the
apex). Keep-in demands inside(x) >= 0, keep-out demands inside(x) <= 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from formulations.arrays import Array, Booleans, Indices


@dataclass(frozen=True)
class Halfspaces:
    """Half-spaces a'y <= b: unit normals a (n, 3) and offsets b (n,)."""

    normal: Array
    offset: Array

    def slack(self, point: Array) -> Array:
        """Distance b - a'y to the plane from points (n, 3), >= 0 inside."""
        return self.offset - np.einsum("ni,ni->n", self.normal, point)

    def complement(self) -> Halfspaces:
        """The closed half-spaces on the other side of the same planes."""
        return Halfspaces(-self.normal, -self.offset)


@dataclass(frozen=True)
class SecondOrderCone:
    """The set || M (y - origin) || <= c'(y - origin) + d, one per node.

    Attributes:
        matrix: M, shape (n, 3, 3).
        origin: shape (n, 3).
        linear: c, shape (n, 3).
        constant: d, shape (n,).
    """

    matrix: Array
    origin: Array
    linear: Array
    constant: Array


def unit(vector: Array, fallback: Array) -> Array:
    """Unit vectors; where the vector vanishes, `fallback` (a direction is not unique there)."""
    largest = np.abs(vector).max(axis=-1, keepdims=True)
    zero = largest == 0.0
    scaled = vector / np.where(zero, 1.0, largest)  # whose square neither overflows nor vanishes
    norm = np.linalg.norm(scaled, axis=-1, keepdims=True)
    return np.where(zero, fallback, scaled / np.where(zero, 1.0, norm))


def reject(vector: Array, axis: Array) -> Array:
    """Part of each vector across a unit axis, (n, 3); zero where only rounding is left.

    The part along the axis is removed twice: its rounding matters where the part across is small.
    """
    across = vector
    for _ in range(2):
        across = across - np.einsum("ni,ni->n", across, axis)[:, None] * axis
    size = np.linalg.norm(vector, axis=-1, keepdims=True)
    left = np.linalg.norm(across, axis=-1, keepdims=True) > 4.0 * np.finfo(float).eps * size
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
    real = (discriminant > 0.0) | (a < 0.0)
    if not real.all():
        low, high = np.full(b.shape, np.inf), np.full(b.shape, np.inf)
        low[real], high[real] = _roots(*(np.broadcast_to(x, real.shape)[real] for x in (a, b, c)))
        return low, high
    q = -(b + np.copysign(np.sqrt(np.maximum(discriminant, 0.0)), b))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        one, other = q / np.where(a == 0.0, -0.0, a), np.where(q == 0.0, 0.0, c / q)
    return np.minimum(one, other), np.maximum(one, other)


def _all_along(still: Booleans, low: Array, high: Array) -> Chord:
    """Interval of a line without direction: all of it if it starts inside, else unchanged."""
    if not still.any():
        return low, high
    return np.where(still, -np.inf, low), np.where(still, np.inf, high)


@dataclass(frozen=True)
class Ball:
    """Points within `radius` of `center` (n, 3)."""

    center: Array
    radius: float

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
        n = len(self.center)
        return SecondOrderCone(
            np.broadcast_to(np.eye(3), (n, 3, 3)),
            self.center,
            np.zeros((n, 3)),
            np.full(n, self.radius),
        )


@dataclass(frozen=True)
class Cone:
    """Points seen from `apex` (n, 3) within `half_angle` < pi/2 of the unit `axis` (n, 3)."""

    apex: Array
    axis: Array
    half_angle: float

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
        return SecondOrderCone(
            np.cos(self.half_angle) * across,
            self.apex,
            np.sin(self.half_angle) * self.axis,
            np.zeros(len(self.apex)),
        )


Region = Ball | Cone
