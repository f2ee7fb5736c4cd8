"""Gravity of a homogeneous polyhedron in closed form, everywhere outside it.

Werner & Scheeres 1997, Celest. Mech. Dyn. Astron. 65, 313. Body-fixed, in any consistent units.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from formulations.arrays import Array, Indices
from scp_recon.bodies.surface import Mesh, Solid

TERMS_AT_ONCE = 10_000
"""Facets times points of a batch, so that it stays in the processor's cache."""


class _Sums(NamedTuple):
    """Terms of the sums for the acceleration, for n edges and m facets.

    Attributes:
        ends, lengths: corners of edges, (n, 2), and their lengths, (n,).
        edge_terms, facet_terms: dyads, flattened, and under them their products with a point of the
            edge or facet, (12, n) and (12, m).
        volumes, normals: of the tetrahedra over facets, six times, (m,), and twice the facets' areas as
            vectors, (m, 3).
    """

    ends: Indices
    lengths: Array
    edge_terms: Array
    facet_terms: Array
    volumes: Array
    normals: Array


@dataclass(frozen=True, eq=False)
class PolyhedronField:
    """Gravity of a homogeneous solid.

    Attributes:
        gm: gravitational parameter.
        vertices: body-fixed, shape (n, 3).
        facets: their corners, turning outward, closed, shape (m, 3).
    """

    gm: float
    vertices: Array
    facets: Indices

    def in_units(self, length: float, time: float) -> PolyhedronField:
        """The same field measured in units of `length` and `time`."""
        return PolyhedronField(self.gm * time**2 / length**3, self.vertices / length, self.facets)

    def acceleration(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
        """Acceleration at body-fixed positions given by components, real arrays (n,)."""
        ax, ay, az = self.derivatives(np.stack([x, y, z]), 0)
        return ax, ay, az

    def derivatives(self, position: Array, order: int) -> Array:
        """Acceleration at body-fixed positions (3, n), shape (3, n): of order 0, the only one there is.

        With r to any point of a facet or edge it is G rho times the sum of F r w over facets less that
        of E r L over edges. E and F are dyads of normals, w the solid angle of a facet, and
        L = log((a + b + l) / (a + b - l)) of an edge of length l, its ends at distances a and b.
        """
        if order:
            raise ValueError("a polyhedron is flown, not planned with: expected order 0")
        pull = np.empty_like(position)
        step = max(1, TERMS_AT_ONCE // len(self.facets))
        for first in range(0, position.shape[1], step):
            some = slice(first, first + step)
            pull[:, some] = self._pull(position[:, some])
        return pull

    def _pull(self, at: Array) -> Array:
        sums = self._sums
        squares = np.einsum("vi,vi->v", self.vertices, self.vertices)[:, None]
        squares = squares - 2.0 * (self.vertices @ at) + np.einsum("in,in->n", at, at)
        distances = np.sqrt(squares)
        a, b = distances[sums.ends[:, 0]], distances[sums.ends[:, 1]]
        reach = a + b
        length = sums.lengths[:, None]
        found = -(sums.edge_terms @ np.log((reach + length) / (reach - length)))
        found += sums.facet_terms @ self._solid_angles(at, squares, distances)
        dyads = found[:9].reshape(3, 3, -1)
        return np.asarray(self._density * (found[9:] - np.einsum("ijn,jn->in", dyads, at)))

    def _solid_angles(self, at: Array, squares: Array, distances: Array) -> Array:
        """Of the facets, (m, n): van Oosterom & Strackee 1983, from distances and sides alone."""
        a, b, c = distances[self.facets.T]
        aa, bb, cc = squares[self.facets.T]
        opposite_a, opposite_b, opposite_c = self._sides[..., None]
        across = self._sums.volumes[:, None] - self._sums.normals @ at
        along = a * b * c + 0.5 * (
            a * (bb + cc - opposite_a) + b * (cc + aa - opposite_b) + c * (aa + bb - opposite_c)
        )
        return np.asarray(2.0 * np.arctan2(across, along))

    @cached_property
    def _sides(self) -> Array:
        """Squares of the sides of facets, opposite to each corner, shape (3, m)."""
        a, b, c = self.vertices[self.facets.T]
        return np.asarray(np.square([c - b, a - c, b - a]).sum(axis=2))

    @cached_property
    def _density(self) -> float:
        return self.gm / Solid.of(Mesh(self.vertices, self.facets)).volume_m3

    @cached_property
    def _sums(self) -> _Sums:
        a, b, c = self.vertices[self.facets.T]
        volumes, areas = np.einsum("ni,ni->n", a, np.cross(b, c)), np.cross(b - a, c - a)
        normals = areas / np.linalg.norm(areas, axis=1)[:, None]
        facet_dyads = normals[:, :, None] * normals[:, None, :]
        facet_terms = _terms(facet_dyads, a)
        # Each facet gives its sides, in its sense; a side and the same of the neighbour are one edge.
        begin, end = self.facets.T.ravel(), np.roll(self.facets, -1, axis=1).T.ravel()
        sides = self.vertices[end] - self.vertices[begin]
        lengths = np.linalg.norm(sides, axis=1)
        normal = np.tile(normals, (3, 1))
        outward = np.cross(sides / lengths[:, None], normal)
        pairs = np.sort(np.stack([begin, end], 1), axis=1)
        ends, first, edge = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
        dyads = np.zeros((len(ends), 3, 3))
        np.add.at(dyads, edge.ravel(), normal[:, :, None] * outward[:, None, :])
        edge_terms = _terms(dyads, self.vertices[ends[:, 0]])
        return _Sums(ends, lengths[first], edge_terms, facet_terms, volumes, areas)


def _terms(dyads: Array, points: Array) -> Array:
    """Dyads (n, 3, 3) as rows, under their products with points (n, 3), shape (12, n)."""
    return np.vstack([dyads.reshape(-1, 9).T, np.einsum("nij,nj->in", dyads, points)])
