"""Regions that move with uncertain parameters, as motions of the position relative to them.

A site whose position is uncertain takes the limits about it along, and so does a body whose spin is.
To first order in the parameters w a region's apex moves by shift w, and its axes turn by turn w about
the apex c. Seen from the region, a position r is then at

    r + D(r) w,    D(r) = -(shift + turn x (r - c)),

and keeps a limit if that point is in the region as it is planned with.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array, Indices


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of a region at n nodes with p uncertain parameters of standard normal law.

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
