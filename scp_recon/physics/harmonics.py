"""Gravity of spherical harmonics, with derivatives of the acceleration, and of a polyhedron.

Either may turn with the body. A homogeneous polyhedron's is in closed form, everywhere outside it:
Werner & Scheeres 1997, Celest. Mech. Dyn. Astron. 65, 313. Body-fixed, in any consistent units.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.resources import files
from math import factorial, sqrt
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array, Indices
from scp_recon.bodies.surface import Mesh, Solid
from scp_recon.physics.frames import Rotation

Coefficients = npt.NDArray[np.complex128]
"""C - i S of functions that are sums of Re[(C - i S)(V + i W)], shape (..., n + 1, n + 1)."""


@dataclass(frozen=True, eq=False)
class HarmonicField:
    """Gravity of a body in its body-fixed frame, in any consistent units.

    Attributes:
        gm: gravitational parameter.
        radius: reference radius.
        c, s: unnormalised coefficients, shape (n + 1, n + 1); c[0, 0] = 1 is the point mass.
    """

    gm: float
    radius: float
    c: Array
    s: Array

    @classmethod
    def bennu(cls, gm: float, degree: int) -> HarmonicField:
        """Flight field of Bennu to a degree of at most 10."""
        text = (files("scp_recon") / "data" / "gravity" / "bennu.toml").read_text(encoding="utf-8")
        data = tomllib.loads(text)
        rows = [(n, m, c, s) for n, m, c, s in data["coefficients"] if n <= degree]
        return cls.of_rows(gm, data["reference_radius_m"], degree, rows)

    @classmethod
    def of_rows(
        cls, gm: float, radius: float, degree: int, rows: Iterable[tuple[int, int, float, float]]
    ) -> HarmonicField:
        """Field of fully normalised coefficients up to a degree; rows are degree, order, C, S."""
        c, s = np.zeros((degree + 1, degree + 1)), np.zeros((degree + 1, degree + 1))
        c[0, 0] = 1.0
        for n, m, c_bar, s_bar in rows:
            norm = _normalisation(n, m)
            c[n, m], s[n, m] = norm * c_bar, norm * s_bar
        return cls(gm, radius, c, s)

    @classmethod
    def zonal(cls, gm: float, radius: float, j2: float) -> HarmonicField:
        """Point mass and J2."""
        return cls.of_rows(gm, radius, 2, [(2, 0, -j2 / sqrt(5.0), 0.0)])

    @classmethod
    def of_solid(cls, mesh: Mesh, gm: float, radius: float, degree: int) -> HarmonicField:
        """Field of a homogeneous solid, outside the sphere about it.

        A solid harmonic of degree n is homogeneous: over the tetrahedron from the origin to a facet its
        mean is 3 / (n + 3) of that over the facet, which Gauss's rule gives exactly.
        """
        corners = mesh.vertices_m[mesh.facets] / radius
        volumes = np.linalg.det(corners)
        nodes, weights = np.polynomial.legendre.leggauss((degree + 3) // 2)
        u, v = np.meshgrid(0.5 + 0.5 * nodes, 0.5 + 0.5 * nodes, indexing="ij")
        weight = (0.5 * np.outer(weights, weights) * u).ravel()
        shares = np.stack([1.0 - u, u * (1.0 - v), u * v], axis=-1).reshape(-1, 3)
        x, y, z = np.einsum("qk,fki->iqf", shares, corners)
        rho = x * x + y * y + z * z
        c, s = np.zeros((2, degree + 1, degree + 1))
        sectoral = np.ones_like(x + 1j * y)
        for m in range(degree + 1):
            below, this = np.zeros_like(sectoral), sectoral
            for n in range(m, degree + 1):
                mean = 3.0 / (n + 3) * (weight @ this) @ volumes / volumes.sum()
                mean *= (2.0 - (m == 0)) * factorial(n - m) / factorial(n + m)
                c[n, m], s[n, m] = mean.real, mean.imag
                above = (2 * n + 1) * z * this - (n + m) * rho * below
                below, this = this, above / (n + 1 - m)
            sectoral = (2 * m + 1) * (x + 1j * y) * sectoral
        return cls(gm, radius, c, s)

    def normalised(self) -> tuple[Array, Array]:
        """Fully normalised coefficients, shape (n + 1, n + 1) each."""
        degree = len(self.c)
        norm = np.array(
            [[_normalisation(n, min(m, n)) for m in range(degree)] for n in range(degree)]
        )
        return self.c / norm, self.s / norm

    def in_units(self, length: float, time: float) -> HarmonicField:
        """The same field measured in units of `length` and `time`."""
        return replace(self, gm=self.gm * time**2 / length**3, radius=self.radius / length)

    @property
    def j2(self) -> float:
        """Unnormalised J2 at the reference radius; zero of a field of degree 1 or less."""
        return -float(self.c[2, 0]) if len(self.c) > 2 else 0.0

    def up_to(self, degree: int) -> HarmonicField:
        """The field up to a degree."""
        kept = slice(degree + 1), slice(degree + 1)
        return replace(self, c=self.c[kept], s=self.s[kept])

    def beside(self, *degrees: int) -> HarmonicField:
        """The field without the zonals of some degrees, which have closed forms of their own."""
        c = self.c.copy()
        c[list(degrees), 0] = 0.0
        return replace(self, c=c)

    def acceleration(self, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
        """Acceleration at a body-fixed position, in the body's frame; arrays or symbols alike."""
        slopes = self._derivatives[0]
        zonal, turned = self._solid_harmonics(x, y, z, slopes.shape[-1])
        ax, ay, az = (
            sum(
                zonal[n, m] * (k.real * turned[m][0] - k.imag * turned[m][1])
                for n, m in np.argwhere(own).tolist()
                for k in (complex(own[n, m]),)
            )
            for own in slopes
        )
        return ax, ay, az

    def derivatives(self, position: Array, order: int) -> Array:
        """Derivatives of the acceleration at body-fixed positions (3, n): of order 0 itself, (3, n).

        First derivatives have shape (3, 3, n), second ones (3, 3, 3, n); both are symmetric.
        """
        coefficients, (x, y, z) = self._derivatives[order], position
        zonal, turned = self._solid_harmonics(x, y, z, coefficients.shape[-1])
        n, m = np.array(list(zonal)).T
        own, size = coefficients[..., n, m], np.stack(list(zonal.values()))
        about = np.array(turned)[m]
        return np.asarray(own.real @ (size * about[:, 0]) - own.imag @ (size * about[:, 1]))

    @cached_property
    def _derivatives(self) -> tuple[Coefficients, ...]:
        """Coefficients of the acceleration and its first and second derivatives."""
        potential = (self.gm / self.radius * (self.c - 1j * self.s)).astype(np.complex128)
        first = _gradient(potential, self.radius)
        second = _gradient(first, self.radius)
        return first, second, _gradient(second, self.radius)

    def _solid_harmonics(
        self, x: Any, y: Any, z: Any, count: int
    ) -> tuple[dict[tuple[int, int], Any], list[tuple[Any, Any]]]:
        """H_nm in V_nm + i W_nm = H_nm (x + iy)^m (R / r^2)^m for all n < count, and its factor.

        The recursions are those of Montenbruck & Gill, eqs. 3.29 to 3.31, of which all but the powers
        of x + iy is real.
        """
        inverse = 1.0 / (x * x + y * y + z * z)
        x0, y0, z0 = (self.radius * u * inverse for u in (x, y, z))
        rho, sectoral = self.radius**2 * inverse, self.radius * inverse**0.5
        turned = [(1.0 + 0.0 * x, 0.0 * x)]
        found = {}
        for m in range(count):
            found[m, m] = sectoral
            sectoral = (2 * m + 1) * sectoral
            for n in range(m + 1, count):
                found[n, m] = (2 * n - 1) / (n - m) * z0 * found[n - 1, m]
                if n > m + 1:
                    found[n, m] = found[n, m] - (n + m - 1) / (n - m) * rho * found[n - 2, m]
            c, s = turned[m]
            turned.append((x0 * c - y0 * s, x0 * s + y0 * c))
        return found, turned[:count]


def _gradient(of: Coefficients, radius: float) -> Coefficients:
    """Coefficients (..., 3, n + 2, n + 2) of the gradients of functions (..., n + 1, n + 1).

    With Z = V + i W, Montenbruck & Gill, eq. 3.33, say of every harmonic (Cunningham 1970)

        R dZ_nm/dz = -(n - m + 1) Z_n+1,m
        R (d/dx + i d/dy) Z_nm = -Z_n+1,m+1
        R (d/dx - i d/dy) Z_nm = (n - m + 2) (n - m + 1) Z_n+1,m-1,  -conj Z_n+1,1 for m = 0.
    """
    count = of.shape[-1]
    found = np.zeros((*of.shape[:-2], 3, count + 1, count + 1), dtype=np.complex128)
    for n in range(count):
        for m in range(n + 1):
            k = of[..., n, m] / radius if m else of[..., n, m].real / radius
            outer = -0.5 * k if m else -1.0 * k
            found[..., 0, n + 1, m + 1] += outer
            found[..., 1, n + 1, m + 1] += -1j * outer
            if m:
                inner = 0.5 * (n - m + 2) * (n - m + 1) * k
                found[..., 0, n + 1, m - 1] += inner
                found[..., 1, n + 1, m - 1] += 1j * inner
            found[..., 2, n + 1, m] -= (n - m + 1) * k
    return found


@dataclass(frozen=True, eq=False)
class TurningField:
    """A field that turns with its body, in the inertial frame.

    Attributes:
        field: of the body, in its own axes.
        rotation: of the body.
        strength: factor of the field, a number or one for each position.
    """

    field: HarmonicField | PolyhedronField
    rotation: Rotation
    strength: Any = 1.0

    def in_units(self, length: float, time: float) -> TurningField:
        """The same measured in units of `length` and `time`."""
        own = self.field.in_units(length, time), self.rotation.in_units(time)
        return TurningField(*own, self.strength)

    def acceleration(self, x: Any, y: Any, z: Any, axes: Any) -> tuple[Any, Any, Any]:
        """Acceleration at a position given by components, arrays or symbols alike.

        The rows of `axes` are the body's three axes in the inertial frame.
        """
        own = self.field.acceleration(*(e[0] * x + e[1] * y + e[2] * z for e in axes))
        ax, ay, az = (sum(a * e[i] for a, e in zip(own, axes, strict=True)) for i in range(3))
        return ax, ay, az

    def derivatives(self, position: Array, axes: Array, order: int) -> Array:
        """Derivatives of the acceleration at positions (3, n), shape (3, .., n).

        Axes as `acceleration` takes them, shape (3, 3), or (3, 3, n) of each position.
        """
        axes = np.broadcast_to(axes.reshape(3, 3, -1), (3, *position.shape))
        found = self.field.derivatives(np.einsum("bin,in->bn", axes, position), order)
        for _ in range(order + 1):
            # Turn the first index, and put it behind the others: after all the order is as it was.
            found = np.einsum("b...n,bin->...in", found, axes)
        return np.asarray(self.strength * found)


def _normalisation(n: int, m: int) -> float:
    """Factor from a fully normalised coefficient to an unnormalised one."""
    return sqrt((2.0 - (m == 0)) * (2 * n + 1) * factorial(n - m) / factorial(n + m))


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
        """Solid angles of facets, (m, n), from distances and sides: van Oosterom & Strackee 1983."""
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
