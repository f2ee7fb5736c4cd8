"""Forces on the spacecraft: point mass, J2 and cannonball solar radiation pressure.

The acceleration is written once, over plain arithmetic, so that NumPy arrays (real or complex) and
CasADi symbols pass through it alike. Its first and second derivatives are in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SPEED_OF_LIGHT_M_S = 299_792_458.0
"""Exact by the definition of the metre."""


@dataclass(frozen=True)
class ForceModel:
    """Constants of the translational dynamics in one consistent set of units.

    Attributes:
        gm: gravitational parameter, length^3 / time^2.
        j2_strength: 3/2 gm J2 R^2, length^5 / time^2.
        pole: unit vector of the spin axis in the inertial frame, shape (3,).
        srp: constant acceleration by solar radiation pressure, shape (3,), length / time^2.
    """

    gm: float
    j2_strength: float
    pole: Array
    srp: Array

    def in_units(self, length: float, time: float) -> ForceModel:
        """The same forces measured in units of `length` and `time`."""
        return ForceModel(
            gm=self.gm * time**2 / length**3,
            j2_strength=self.j2_strength * time**2 / length**5,
            pole=self.pole,
            srp=self.srp * time**2 / length,
        )


def cannonball_srp(
    sun_direction: Array,
    area_m2: float,
    reflectivity: float,
    mass_kg: float,
    sun_distance_au: float,
    solar_constant_w_m2: float,
) -> Array:
    """Cannonball acceleration away from the Sun, shape (3,), m/s^2, frame of `sun_direction`.

    a = -(S / c) d^-2 C_R (A / m) s, with s the unit vector to the Sun and d its distance in au.
    """
    pressure = solar_constant_w_m2 / SPEED_OF_LIGHT_M_S / sun_distance_au**2
    return -pressure * reflectivity * area_m2 / mass_kg * sun_direction


def acceleration(x: Any, y: Any, z: Any, forces: ForceModel) -> tuple[Any, Any, Any]:
    """Acceleration at a position given by components (scalars, arrays or symbols alike).

    With u = p . r and k = 3/2 gm J2 R^2 the oblateness part is the gradient of
    -k/3 (3 u^2 / r^5 - 1 / r^3), Montenbruck & Gill, Satellite Orbits, eq. 3.32 for n = 2, m = 0.
    """
    px, py, pz = forces.pole
    r2 = x * x + y * y + z * z
    inverse = 1.0 / r2
    inverse3 = inverse * inverse**0.5
    inverse5 = inverse3 * inverse
    u = px * x + py * y + pz * z
    radial = -forces.gm * inverse3 + forces.j2_strength * inverse5 * (5.0 * u * u * inverse - 1.0)
    polar = -2.0 * forces.j2_strength * inverse5 * u
    sx, sy, sz = forces.srp
    return radial * x + polar * px + sx, radial * y + polar * py + sy, radial * z + polar * pz + sz


def acceleration_derivatives(position: Array, forces: ForceModel) -> tuple[Array, Array, Array]:
    """Acceleration, gravity gradient and its derivative.

    The acceleration has the form f(r) r + g(r) p + const, so its derivatives are those of the two
    scalars f and g: da_i/dx_j = f d_ij + x_i f_j + p_i g_j, and once more.

    Args:
        position: shape (n, 3).
        forces: constants in the same units.

    Returns:
        acceleration (n, 3), gradient G[n, i, j] = da_i/dx_j, and H[n, i, j, k] = d2a_i/dx_j dx_k.
    """
    gm, k, p = forces.gm, forces.j2_strength, forces.pole
    r2 = np.einsum("ni,ni->n", position, position)
    u = position @ p
    i2 = 1.0 / r2
    i3 = i2 * np.sqrt(i2)
    i5, i7 = i3 * i2, i3 * i2**2
    i9, i11 = i7 * i2, i7 * i2**2
    eye = np.eye(3)
    pp = np.outer(p, p)
    xx = position[:, :, None] * position[:, None, :]
    px = p[:, None] * position[:, None, :]
    px_sym = px + px.transpose(0, 2, 1)

    def scale(factor: Array, tensor: Array) -> Array:
        return factor.reshape((-1,) + (1,) * max(tensor.ndim - 1, 1)) * tensor

    f = -gm * i3 + k * (5.0 * u**2 * i7 - i5)
    g = -2.0 * k * u * i5
    along_x = 3.0 * gm * i5 + k * (5.0 * i7 - 35.0 * u**2 * i9)
    f_j = scale(along_x, position) + np.outer(10.0 * k * u * i7, p)
    g_j = np.outer(-2.0 * k * i5, p) + scale(10.0 * k * u * i7, position)
    f_jk = (
        (along_x[:, None, None] * eye)
        + scale(-15.0 * gm * i7 + k * (315.0 * u**2 * i11 - 35.0 * i9), xx)
        + scale(-70.0 * k * u * i9, px_sym)
        + (10.0 * k * i7)[:, None, None] * pp
    )
    g_jk = (
        scale(10.0 * k * i7, px_sym)
        + (10.0 * k * u * i7)[:, None, None] * eye
        + scale(-70.0 * k * u * i9, xx)
    )
    value = scale(f, position) + np.outer(g, p) + forces.srp
    gradient = f[:, None, None] * eye + position[:, :, None] * f_j[:, None, :]
    gradient += p[:, None] * g_j[:, None, :]
    second = position[:, :, None, None] * f_jk[:, None] + p[:, None, None] * g_jk[:, None]
    second += eye[:, :, None] * f_j[:, None, None, :] + eye[:, None, :] * f_j[:, None, :, None]
    return value, gradient, second
