"""Surfaces that the 3-D view draws: tubes about paths, and solids of revolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from formulations.problem.regions import perpendicular
from scp_recon.physics.frames import unit

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

TURNS = 36
"""Parts of a full turn."""
RING = 14
"""Points of a tube's cross section."""


@dataclass(frozen=True, eq=False)
class Solid:
    """Triangles: vertices (n, 3) in m, and their corners (m, 3)."""

    vertices_m: Array
    facets: Indices

    @classmethod
    def joined(cls, solids: list[Solid]) -> Solid:
        """Several as one."""
        starts = np.cumsum([0, *(len(solid.vertices_m) for solid in solids[:-1])])
        return cls(
            np.vstack([solid.vertices_m for solid in solids]),
            np.vstack([s.facets + start for s, start in zip(solids, starts, strict=True)]),
        )


def _sheet(rows: int, columns: int) -> Indices:
    """Facets of a sheet of points, closed across."""
    here = np.arange(columns)
    there = (here + 1) % columns
    facets = []
    for k in range(rows - 1):
        low, high = k * columns, (k + 1) * columns
        facets.append(np.column_stack([low + here, low + there, high + here]))
        facets.append(np.column_stack([low + there, high + there, high + here]))
    return np.vstack(facets)


def tube(path: Array, covariance: Array, sigmas: float) -> Solid:
    """Around a path, the ellipses of the position's covariance across it.

    Args:
        path: m, shape (n, 3), of points apart from each other.
        covariance: of the position in the same axes, m^2, shape (n, 3, 3).
        sigmas: semi-axes over standard deviations.
    """
    plane = planes_along(path)
    across = plane @ covariance @ np.swapaxes(plane, 1, 2)
    values, vectors = np.linalg.eigh(across)
    # The symmetric root: it turns no faster than the covariance does, so that rings do not twist.
    sizes = np.sqrt(np.maximum(values, 0.0))[:, None]
    root = (vectors * sizes) @ np.swapaxes(vectors, 1, 2)
    turn = np.arange(RING) * 2.0 * np.pi / RING
    circle = np.stack([np.cos(turn), np.sin(turn)])
    rings = sigmas * np.einsum("nij,jk,nil->nkl", root, circle, plane)
    return Solid((path[:, None] + rings).reshape(-1, 3), _sheet(len(path), RING))


def planes_along(path: Array) -> Array:
    """Two unit vectors across a path (n, 3), carried along it without a turn: shape (n, 2, 3).

    Each pair is the one before, less what of it lies along the path there.
    """
    along = unit(np.gradient(path, axis=0))
    planes = []
    side = perpendicular(along[:1])[0]
    for direction in along:
        left = side - (side @ direction) * direction
        side = left / np.linalg.norm(left)
        planes.append(np.stack([side, np.cross(direction, side)]))
    return np.array(planes)


def revolved(profile: Array, axis: Array, apex: Array) -> Solid:
    """A profile of points (along, across) turned about an axis through an apex, m, shape (k, 2)."""
    axis = unit(axis)
    side = perpendicular(axis[None])[0]
    turn = np.arange(TURNS) * 2.0 * np.pi / TURNS
    rim = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side)
    points = profile[:, :1, None] * axis + profile[:, 1:, None] * rim
    return Solid(apex + points.reshape(-1, 3), _sheet(len(profile), TURNS))


def sphere(radius: float) -> Solid:
    """About the origin, m."""
    angle = np.linspace(0.0, np.pi, TURNS // 2 + 1)
    profile = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    return revolved(profile, np.array([0.0, 0.0, 1.0]), np.zeros(3))


def cone(axis: Array, apex: Array, half_angle: float, length: float) -> Solid:
    """The lateral surface of a cone; its edge is at `length` from the apex, m."""
    edge = length * np.array([np.cos(half_angle), np.sin(half_angle)])
    return revolved(np.array([[0.0, 0.0], edge]), axis, apex)


def shell(
    axis: Array, apex: Array, distances: tuple[float, float], angles: tuple[float, float]
) -> Solid:
    """All points at distances and at angles from the axis, seen from the apex: m and rad."""
    (near, far), (narrow, wide) = distances, angles
    sweep = np.linspace(narrow, wide, 9)
    arc = np.column_stack([np.cos(sweep), np.sin(sweep)])
    profile = np.vstack([near * arc, far * arc[::-1], near * arc[:1]])
    return revolved(profile, axis, apex)
