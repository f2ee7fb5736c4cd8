"""Spherical harmonics of a rotating body: the true gravity against which the planner's J2 is tested."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.resources import files
from math import factorial, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array


@dataclass(frozen=True)
class HarmonicField:
    """Gravity of a body in its body-fixed frame, in any consistent units.

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
        """Field of fully normalised coefficients up to a degree; rows are degree, order, C, S."""
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
        """Acceleration at a body-fixed position, in the body's frame, by Cunningham's recursion.

        Montenbruck & Gill, Satellite Orbits, eq. 3.33, with the harmonics as V + i W and the
        coefficients as C - i S.
        """
        harmonics = self._solid_harmonics(x, y, z, len(self.c))
        across, up = np.zeros_like(x, dtype=complex), np.zeros_like(x)
        for n, m in np.argwhere((self.c != 0.0) | (self.s != 0.0)).tolist():
            k = complex(self.c[n, m], -self.s[n, m])
            outer = k * harmonics[n + 1, m + 1]
            if m == 0:
                across -= outer
            else:
                inner = k * harmonics[n + 1, m - 1]
                across += 0.5 * ((n - m + 2) * (n - m + 1) * inner.conj() - outer)
            up -= (n - m + 1) * (k * harmonics[n + 1, m]).real
        scale = self.gm / self.radius**2
        return scale * across.real, scale * across.imag, scale * up

    def _solid_harmonics(
        self, x: Array, y: Array, z: Array, degree: int
    ) -> dict[tuple[int, int], npt.NDArray[Any]]:
        """V_nm + i W_nm of Montenbruck & Gill, eqs. 3.29 to 3.31."""
        r2 = x * x + y * y + z * z
        rho = self.radius**2 / r2
        x0, y0, z0 = (self.radius * u / r2 for u in (x, y, z))
        found = {(0, 0): self.radius / np.sqrt(r2) + 0j}
        for m in range(degree + 1):
            if m > 0:
                found[m, m] = (2 * m - 1) * (x0 + 1j * y0) * found[m - 1, m - 1]
            for n in range(m + 1, degree + 1):
                found[n, m] = (2 * n - 1) / (n - m) * z0 * found[n - 1, m]
                if n > m + 1:
                    found[n, m] -= (n + m - 1) / (n - m) * rho * found[n - 2, m]
        return found


def _normalisation(n: int, m: int) -> float:
    """Factor from a fully normalised coefficient to an unnormalised one."""
    return sqrt((2.0 - (m == 0)) * (2 * n + 1) * factorial(n - m) / factorial(n + m))
