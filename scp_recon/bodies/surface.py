"""Find position and normal on a body's surface, an ellipsoid or a mesh; its volume and inertia.

Vectors are body-fixed, in m. Latitudes are planetocentric: those of the position vector, not of the
normal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array, Indices


def direction_of(latitude_deg: float, longitude_deg: float) -> Array:
    """Unit vector at a planetocentric latitude and an east longitude, shape (3,)."""
    latitude, longitude = np.deg2rad([latitude_deg, longitude_deg])
    across = np.cos(latitude)
    return np.array([across * np.cos(longitude), across * np.sin(longitude), np.sin(latitude)])


def angle_deg(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    """Angle between two vectors, deg."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def coordinates_of(position: Array) -> tuple[float, float]:
    """Planetocentric latitude and east longitude (-180 to 180) of a position, deg."""
    x, y, z = position
    return float(np.rad2deg(np.arctan2(z, np.hypot(x, y)))), float(np.rad2deg(np.arctan2(y, x)))


@dataclass(frozen=True)
class Ellipsoid:
    """Semi-axes along x, y and z, m."""

    radii_m: Array

    def at(self, direction: Array) -> tuple[Array, Array]:
        """Position (m) along a unit direction, and unit outward normal; shape (3,) each."""
        position = direction / np.linalg.norm(direction / self.radii_m)
        gradient = position / self.radii_m**2
        return position, gradient / np.linalg.norm(gradient)

    def tessellated(self, halvings: int) -> Mesh:
        """A mesh of 8 * 4^halvings facets of the same volume: an octahedron whose sides are halved.

        It has the ellipsoid's three planes of symmetry.
        """
        signs = 1.0 - 2.0 * np.array(list(np.ndindex(2, 2, 2)))
        corners = signs[:, :, None] * np.eye(3)
        mirrored = signs.prod(axis=1) < 0.0
        corners[mirrored] = corners[mirrored, ::-1]
        for _ in range(halvings):
            corners = quartered(corners)
            corners /= np.linalg.norm(corners, axis=2, keepdims=True)
        vertices, facets = np.unique(
            corners.reshape(-1, 3).round(12) + 0.0, axis=0, return_inverse=True
        )
        mesh = Mesh(vertices * self.radii_m, facets.reshape(-1, 3))
        full = 4.0 / 3.0 * np.pi * float(self.radii_m.prod())
        return replace(mesh, vertices_m=mesh.vertices_m * np.cbrt(full / Solid.of(mesh).volume_m3))


def quartered(corners: Array) -> Array:
    """Cut each triangle in four at the middles of its sides: shape (n, 3, 3) to (4 n, 3, 3)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    ab, bc, ca = (a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0
    found = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(one, axis=1) for one in found])


class OpenShapeError(ValueError):
    """A direction from the centre meets no facet."""


@dataclass(frozen=True)
class Mesh:
    """A surface of triangles.

    Attributes:
        vertices_m: shape (n, 3).
        facets: indices of their corners, all turning the same way, shape (m, 3).
        normal_radius_m: normals are averaged over facets whose centres are this near; 0 for the
            normal of one facet.
    """

    vertices_m: Array
    facets: Indices
    normal_radius_m: float = 0.0

    @property
    def half_extents_m(self) -> Array:
        """Half of the size along each axis."""
        return np.ptp(self.vertices_m, axis=0) / 2.0

    @property
    def facet_size_m(self) -> float:
        """Root of the mean area of a facet."""
        a, b, c = np.moveaxis(self.vertices_m[self.facets], 1, 0)
        return float(np.sqrt(np.linalg.norm(np.cross(b - a, c - a), axis=1).mean() / 2.0))

    def at(self, direction: Array) -> tuple[Array, Array]:
        """Outermost position (m) along a unit direction, and unit outward normal; shape (3,) each.

        By intersection with the facets: Moeller & Trumbore 1997, the ray from the origin.

        Raises:
            OpenShapeError: if no facet lies in that direction.
        """
        a, b, c = np.moveaxis(self.vertices_m[self.facets], 1, 0)
        along_b, along_c = b - a, c - a
        across = np.cross(direction, along_c)
        volume = np.einsum("ni,ni->n", along_b, across)
        hit = np.flatnonzero(np.abs(volume) > 1e-14 * np.abs(volume).max())
        with np.errstate(over="ignore"):
            u = -np.einsum("ni,ni->n", a[hit], across[hit]) / volume[hit]
            turned = np.cross(-a[hit], along_b[hit])
            v = turned @ direction / volume[hit]
            distance = np.einsum("ni,ni->n", along_c[hit], turned) / volume[hit]
        inside = (u >= -EDGE) & (v >= -EDGE) & (u + v <= 1.0 + EDGE) & (distance > 0.0)
        if not inside.any():
            raise OpenShapeError("no facet in this direction from the centre")
        nearest = np.argmax(np.where(inside, distance, -np.inf))
        position = distance[nearest] * direction
        # The length of a cross product is twice the facet's area: sums of them are weighted by area.
        areas = np.cross(along_b, along_c)
        outward = np.sign(areas[hit[nearest]] @ direction)
        near = np.linalg.norm((a + b + c) / 3.0 - position, axis=1) <= self.normal_radius_m
        near[hit[nearest]] = True
        normal = outward * areas[near].sum(axis=0)
        return position, normal / np.linalg.norm(normal)


EDGE = 1e-9
"""Relative margin by which facets are widened: rounding lets a ray along an edge miss both sides."""
Surface = Ellipsoid | Mesh
"""A closed surface about the centre of mass."""


@dataclass(frozen=True)
class Solid:
    """The homogeneous solid inside a closed mesh.

    Attributes:
        volume_m3: negative where the facets turn inward, as a mirror makes them.
        centre_m: body-fixed, shape (3,).
        inertia_m2: about the centre, over the mass; symmetric, shape (3, 3).
    """

    volume_m3: float
    centre_m: Array
    inertia_m2: Array

    @classmethod
    def of(cls, mesh: Mesh) -> Solid:
        """Solid of a mesh, by sums over tetrahedra from the origin: Tonon 2004, J. Math. Stat. 1 (1).

        Raises:
            ValueError: if the mesh has no volume.
        """
        corners = mesh.vertices_m[mesh.facets]
        volumes = np.linalg.det(corners) / 6.0
        volume = float(volumes.sum())
        if abs(volume) <= 1e-9 * float(np.ptp(mesh.vertices_m, axis=0).prod()):
            raise ValueError("no volume")
        sums = corners.sum(axis=1)
        centre = volumes @ sums / (4.0 * volume)
        # Of a tetrahedron with a corner in the origin: the integral of x x' is V / 20 times this.
        products = np.einsum("nki,nkj->nij", corners, corners) + np.einsum("ni,nj->nij", sums, sums)
        second = np.tensordot(volumes, products, 1) / (20.0 * volume) - np.outer(centre, centre)
        return cls(volume, centre, np.trace(second) * np.eye(3) - second)

    @property
    def radius_m(self) -> float:
        """Radius of the sphere of the same volume."""
        return float(np.cbrt(3.0 * abs(self.volume_m3) / (4.0 * np.pi)))
