"""Spherical harmonics of a rotating body: the truth that the planner's J2 is held against."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.resources import files
from math import factorial, sqrt

import numpy as np

from formulations.arrays import Array


@dataclass(frozen=True)
class HarmonicField:
    """Gravity of a body in its own frame.

    Attributes:
        gm: gravitational parameter.
        radius: reference radius.
        c, s: unnormalised coefficients, shape (n + 1, n + 1), with c[0, 0] = 1.
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
        """From fully normalised coefficients: rows of degree, order, C, S, up to a degree."""
        c, s = np.zeros((degree + 1, degree + 1)), np.zeros((degree + 1, degree + 1))
        c[0, 0] = 1.0
        for n, m, c_bar, s_bar in rows:
            norm = _normalisation(n, m)
            c[n, m], s[n, m] = norm * c_bar, norm * s_bar
        return cls(gm, radius, c, s)

    def normalised(self) -> tuple[Array, Array]:
        """Fully normalised coefficients, shape (n + 1, n + 1) each."""
        degree = len(self.c)
        norm = np.array(
            [[_normalisation(n, min(m, n)) for m in range(degree)] for n in range(degree)]
        )
        return self.c / norm, self.s / norm

    def acceleration(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
        """Acceleration in the body's frame by Cunningham's recursion.

        Montenbruck & Gill, Satellite Orbits, eqs. 3.29 to 3.33.
        """
        degree = len(self.c) - 1
        v, w = self._solid_harmonics(x, y, z, degree + 1)
        ax, ay, az = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
        for n in range(degree + 1):
            for m in range(n + 1):
                c, s = self.c[n, m], self.s[n, m]
                if c == 0.0 and s == 0.0:
                    continue
                if m == 0:
                    ax -= c * v[n + 1, 1]
                    ay -= c * w[n + 1, 1]
                else:
                    k = (n - m + 2) * (n - m + 1)
                    ax += 0.5 * (
                        -c * v[n + 1, m + 1]
                        - s * w[n + 1, m + 1]
                        + k * (c * v[n + 1, m - 1] + s * w[n + 1, m - 1])
                    )
                    ay += 0.5 * (
                        -c * w[n + 1, m + 1]
                        + s * v[n + 1, m + 1]
                        + k * (-c * w[n + 1, m - 1] + s * v[n + 1, m - 1])
                    )
                az -= (n - m + 1) * (c * v[n + 1, m] + s * w[n + 1, m])
        scale = self.gm / self.radius**2
        return scale * ax, scale * ay, scale * az

    def _solid_harmonics(
        self, x: Array, y: Array, z: Array, degree: int
    ) -> tuple[dict[tuple[int, int], Array], dict[tuple[int, int], Array]]:
        """V_nm and W_nm of Montenbruck & Gill, eqs. 3.29 to 3.31."""
        r2 = x * x + y * y + z * z
        rho = self.radius**2 / r2
        x0, y0, z0 = (self.radius * u / r2 for u in (x, y, z))
        v = {(0, 0): self.radius / np.sqrt(r2)}
        w = {(0, 0): np.zeros_like(r2)}
        for m in range(degree + 1):
            if m > 0:
                v[m, m] = (2 * m - 1) * (x0 * v[m - 1, m - 1] - y0 * w[m - 1, m - 1])
                w[m, m] = (2 * m - 1) * (x0 * w[m - 1, m - 1] + y0 * v[m - 1, m - 1])
            for n in range(m + 1, degree + 1):
                first, second = (2 * n - 1) / (n - m) * z0, (n + m - 1) / (n - m) * rho
                v[n, m] = first * v[n - 1, m]
                w[n, m] = first * w[n - 1, m]
                if n > m + 1:
                    v[n, m] = v[n, m] - second * v[n - 2, m]
                    w[n, m] = w[n, m] - second * w[n - 2, m]
        return v, w


def _normalisation(n: int, m: int) -> float:
    """Factor from a fully normalised coefficient to an unnormalised one."""
    return sqrt((2.0 - (m == 0)) * (2 * n + 1) * factorial(n - m) / factorial(n + m))
