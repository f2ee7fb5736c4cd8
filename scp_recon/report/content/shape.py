"""The body as the report draws it: its shape file, or its ellipsoid, or a sphere through the site."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from scp_recon.environment.shape_file import read_shape
from scp_recon.environment.surface import Mesh
from scp_recon.errors import InputError
from scp_recon.physics.frames import unit
from scp_recon.scenario.schema import Scenario

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

FACETS_MAX = 12_000
"""Of a mesh as it is drawn: more would make the file heavy and the view slow."""
ACROSS, DOWN = 72, 36
"""Parts of an ellipsoid in longitude and latitude."""
NEIGHBOURS = 3
"""Vertices between which the radius along a direction is averaged."""


class Radius(Protocol):
    """How far the surface is from the centre, m, along unit directions: (..., 3) to (...)."""

    def __call__(self, directions: Array) -> Array:
        """Of each."""
        ...


@dataclass(frozen=True, eq=False)
class Shape:
    """A closed surface, body-fixed.

    Attributes:
        told: what it is of.
        vertices_m: shape (n, 3).
        facets: corners by number, turning outward, shape (m, 3).
        radius: of the surface along a direction; of a mesh averaged between the nearest vertices of
            the file.
    """

    told: str
    vertices_m: Array
    facets: Indices
    radius: Radius

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


def shape_of(scenario: Scenario) -> Shape:
    """What is known of the body's shape; a file that is no longer there is said to be missing."""
    body, site = scenario.body, scenario.site
    missing = ""
    if body.shape_file is not None:
        try:
            mesh = read_shape(Path(body.shape_file), body.shape_unit)
        except InputError:
            missing = " (its shape file is not to be read here)"
        else:
            return _of_mesh(mesh)
    if body.radii_m is not None:
        axes = " x ".join(f"{radius:g}" for radius in body.radii_m)
        return ellipsoid(np.array(body.radii_m), f"ellipsoid of semi-axes {axes} m{missing}")
    size = float(np.linalg.norm(site.position_body_m))
    return ellipsoid(np.full(3, size), f"sphere of {size:g} m through the site{missing}")


def ellipsoid(radii_m: Array, told: str) -> Shape:
    """By semi-axes along x, y and z, m."""
    longitude = np.arange(ACROSS) * 2.0 * np.pi / ACROSS
    latitude = (np.arange(1, DOWN) / DOWN - 0.5) * np.pi
    ring = np.stack([np.cos(longitude), np.sin(longitude)], axis=1)
    belts = [np.column_stack([np.cos(b) * ring, np.full(ACROSS, np.sin(b))]) for b in latitude]
    directions = np.vstack([*belts, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]])
    here, there = np.arange(ACROSS), (np.arange(ACROSS) + 1) % ACROSS
    south, north = len(directions) - 2, len(directions) - 1
    top = (DOWN - 2) * ACROSS
    facets = [np.column_stack([np.full(ACROSS, south), there, here])]
    for k in range(DOWN - 2):
        low, high = k * ACROSS, (k + 1) * ACROSS
        facets.append(np.column_stack([low + here, low + there, high + here]))
        facets.append(np.column_stack([low + there, high + there, high + here]))
    facets.append(np.column_stack([np.full(ACROSS, north), top + here, top + there]))

    def radius(directions: Array) -> Array:
        return 1.0 / np.linalg.norm(directions / radii_m, axis=-1)

    return Shape(told, directions * radii_m, np.vstack(facets), radius)


def _of_mesh(mesh: Mesh) -> Shape:
    vertices, facets = mesh.vertices_m, mesh.facets
    told = f"shape file of {len(facets)} facets"
    used = vertices[np.unique(facets)]
    sizes = np.linalg.norm(used, axis=1)
    tree, sizes = cKDTree(unit(used)), sizes

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
        told += f", drawn with {len(drawn[1])}"
    return Shape(told, drawn[0], _outward(*drawn), radius)


def clustered(vertices: Array, facets: Indices, parts: int) -> tuple[Array, Indices]:
    """A mesh with all vertices of a cell made one: Rossignac and Borrel 1993.

    Args:
        vertices: shape (n, 3).
        facets: shape (m, 3).
        parts: cells along the longest side.
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


def _outward(vertices: Array, facets: Indices) -> Indices:
    """With the corners so ordered that the volume about the origin is positive."""
    a, b, c = np.moveaxis(vertices[facets], 1, 0)
    return facets if np.einsum("ni,ni->", a, np.cross(b, c)) >= 0.0 else facets[:, ::-1]
