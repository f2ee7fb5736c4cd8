"""Make the surfaces of the 3-D view: the body, tubes about paths, cones, shells and spheres.

The body is its shape file, or its ellipsoid, or a sphere through the site.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from formulations.arrays import Array, Indices
from formulations.problem.regions import perpendicular
from scp_recon.bodies.files import read_shape
from scp_recon.bodies.surface import Ellipsoid, Mesh
from scp_recon.errors import InputError
from scp_recon.physics.frames import unit
from scp_recon.scenario.schema import Scenario

TURNS = 36
"""Directions about an axis: of a surface of revolution, and of the edge of a field of view."""
RING = 24
"""Points of a tube's cross section."""
FACETS_MAX = 12_000
"""Most facets of a drawn mesh: more would make the file heavy and the view slow."""
HALVINGS = 4
"""Halvings of an octahedron's sides to draw an ellipsoid: 2,048 facets."""
STEPS, BISECTIONS = 48, 30
"""Even steps along a ray until it is below the surface, and bisections after."""
NEIGHBOURS = 3
"""Vertices between which the radius along a direction is averaged."""


@dataclass(frozen=True, eq=False)
class Solid:
    """Triangles: vertices (n, 3) in m, and their corners (m, 3)."""

    vertices_m: Array
    facets: Indices


def _sheet(rows: int, columns: int) -> Indices:
    """Facets of a sheet of points, closed across."""
    number = np.arange(rows * columns).reshape(rows, columns)
    here, there = number, np.roll(number, -1, axis=1)
    lower = np.stack([here[:-1], there[:-1], here[1:]], axis=-1)
    upper = np.stack([there[:-1], there[1:], here[1:]], axis=-1)
    return np.stack([lower, upper], axis=1).reshape(-1, 3)


def tube(path: Array, covariance: Array, sigmas: float) -> Solid:
    """A tube about a path, made of the ellipses of the position's covariance across it.

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
    """Two unit vectors across a path (n, 3), of which the first turns least: shape (n, 2, 3).

    It is the direction that all tangents are farthest from, projected normal to the path.
    """
    along = unit(np.gradient(path, axis=0))
    farthest = np.linalg.svd(along)[2][-1]
    side = unit(farthest - (along @ farthest)[:, None] * along)
    return np.stack([side, np.cross(along, side)], axis=1)


def rim(axes: Array, turns: int = TURNS) -> Array:
    """Unit vectors normal to unit axes (n, 3), evenly around them: shape (n, turns, 3)."""
    side = perpendicular(axes)
    turn = np.arange(turns) * 2.0 * np.pi / turns
    other = np.cross(axes, side)
    return np.cos(turn)[:, None] * side[:, None] + np.sin(turn)[:, None] * other[:, None]


def revolved(profile: Array, axis: Array, apex: Array) -> Solid:
    """A profile of points (along, across) turned about an axis through an apex, m, shape (k, 2)."""
    axis = unit(axis)
    points = profile[:, :1, None] * axis + profile[:, 1:, None] * rim(axis[None])[0]
    return Solid(apex + points.reshape(-1, 3), _sheet(len(profile), TURNS))


def sphere(radius: float) -> Solid:
    """A sphere about the origin, m."""
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


@dataclass(frozen=True, eq=False)
class Shape(Solid):
    """A body's surface, body-fixed, its facets turning outward.

    Attributes:
        description: source of the surface.
        radius: distance from the centre along unit directions, m, (..., 3) to (...); for a mesh
            averaged between the nearest vertices of the file.
    """

    description: str
    radius: Callable[[Array], Array]

    @property
    def size_m(self) -> float:
        """Largest distance from the centre."""
        return float(np.linalg.norm(self.vertices_m, axis=1).max())

    @property
    def normals(self) -> Array:
        """Unit outward normals at the vertices: of the facets around, by their area; shape (n, 3)."""
        a, b, c = np.moveaxis(self.vertices_m[self.facets], 1, 0)
        areas = np.cross(b - a, c - a)
        sums = np.zeros_like(self.vertices_m)
        for corner in self.facets.T:
            np.add.at(sums, corner, areas)
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        return np.where(lengths > 0.0, sums / np.maximum(lengths, 1e-300), unit(self.vertices_m))


def degrees_of(position: Array) -> tuple[Array, Array]:
    """East longitude and planetocentric latitude of positions (..., 3), deg."""
    x, y, z = np.moveaxis(position, -1, 0)
    return np.rad2deg(np.arctan2(y, x)), np.rad2deg(np.arctan2(z, np.hypot(x, y)))


def first_hit(start: Array, ray: Array, shape: Shape) -> Array:
    """First points at which rays meet the surface; NaN where none does.

    Every direction from the centre is assumed to meet the surface once. The search takes even steps
    through the sphere around the surface, and then halves them. Rays are unit vectors (..., 3) that
    start outside.
    """
    size = 1.001 * shape.size_m
    middle = -np.sum(start * ray, axis=-1)
    nearest2 = np.sum(start * start, axis=-1) - middle**2
    half = np.sqrt(np.maximum(size**2 - nearest2, 0.0))

    def above(along: Array) -> Array:
        position = start + along[..., None] * ray
        distance = np.linalg.norm(position, axis=-1)
        return distance - shape.radius(position / np.maximum(distance, 1e-9)[..., None])

    steps = (middle - half)[..., None] + half[..., None] * np.linspace(0.0, 2.0, STEPS)
    under = np.stack([above(steps[..., k]) < 0.0 for k in range(STEPS)], axis=-1)
    first = np.argmax(under, axis=-1)
    hit = under.any(axis=-1) & (nearest2 < size**2)
    high = np.take_along_axis(steps, first[..., None], -1)[..., 0]
    low = np.take_along_axis(steps, np.maximum(first - 1, 0)[..., None], -1)[..., 0]
    for _ in range(BISECTIONS):
        between = 0.5 * (low + high)
        below = above(between) < 0.0
        low, high = np.where(below, low, between), np.where(below, between, high)
    found = start + (0.5 * (low + high))[..., None] * ray
    return np.where(hit[..., None], found, np.nan)


def shape_of(scenario: Scenario) -> Shape:
    """Shape of a scenario's body; the description names a shape file that is missing."""
    body, site = scenario.body, scenario.site
    missing = ""
    if body.shape_file is not None:
        try:
            mesh = read_shape(Path(body.shape_file), body.shape_unit)
        except InputError:
            missing = " (its shape file cannot be read here)"
        else:
            return _of_mesh(mesh)
    if body.radii_m is not None:
        axes = " x ".join(f"{radius:g}" for radius in body.radii_m)
        return ellipsoid(np.array(body.radii_m), f"ellipsoid of semi-axes {axes} m{missing}")
    size = float(np.linalg.norm(site.position_body_m))
    return ellipsoid(np.full(3, size), f"sphere of {size:g} m through the site{missing}")


def ellipsoid(radii_m: Array, description: str) -> Shape:
    """An ellipsoid by its semi-axes along x, y and z, m."""
    mesh = Ellipsoid(radii_m).tessellated(HALVINGS)

    def radius(directions: Array) -> Array:
        return 1.0 / np.linalg.norm(directions / radii_m, axis=-1)

    return Shape(mesh.vertices_m, mesh.facets, description, radius)


def _of_mesh(mesh: Mesh) -> Shape:
    vertices, facets = mesh.vertices_m, mesh.facets
    description = f"shape file of {len(facets)} facets"
    used = vertices[np.unique(facets)]
    sizes = np.linalg.norm(used, axis=1)
    tree = cKDTree(unit(used))

    def radius(directions: Array) -> Array:
        apart, nearest = tree.query(unit(directions), k=min(NEIGHBOURS, len(sizes)))
        weights = 1.0 / np.maximum(apart, 1e-9)
        return np.sum(weights * sizes[nearest], axis=-1) / weights.sum(axis=-1)

    parts = 40
    drawn = vertices, facets
    while len(drawn[1]) > FACETS_MAX and parts > 4:
        drawn = clustered(vertices, facets, parts)
        parts = parts * 9 // 10
    if len(drawn[1]) < len(facets):
        description += f", drawn with {len(drawn[1])}"
    a, b, c = np.moveaxis(drawn[0][drawn[1]], 1, 0)
    inward = np.einsum("ni,ni->", a, np.cross(b, c)) < 0.0  # by the volume about the origin
    return Shape(drawn[0], drawn[1][:, ::-1] if inward else drawn[1], description, radius)


def clustered(vertices: Array, facets: Indices, parts: int) -> tuple[Array, Indices]:
    """A mesh with all vertices of a cell made one: Rossignac and Borrel 1993.

    Vertices (n, 3), facets (m, 3); the longest side has so many parts, each a cell.
    """
    low = vertices.min(axis=0)
    cell = np.floor((vertices - low) / (np.ptp(vertices, axis=0).max() / parts)).astype(np.intp)
    _, which, counts = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(counts), 3))
    np.add.at(sums, which.ravel(), vertices)
    merged = which.ravel()[facets]
    a, b, c = merged.T
    whole = merged[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(whole, axis=1), axis=0, return_index=True)
    return sums / counts[:, None], whole[np.sort(first)]
