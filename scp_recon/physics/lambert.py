"""Lambert's problem: the two-body arc between two positions in a given time."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

Array = npt.NDArray[np.float64]


def _stumpff(z: float) -> tuple[float, float]:
    """Stumpff's functions C(z) and S(z)."""
    if z > 1e-6:
        r = np.sqrt(z)
        return (1.0 - np.cos(r)) / z, (r - np.sin(r)) / r**3
    if z < -1e-6:
        r = np.sqrt(-z)
        return (np.cosh(r) - 1.0) / -z, (np.sinh(r) - r) / r**3
    return 0.5 - z / 24.0, 1.0 / 6.0 - z / 120.0


def lambert(start: Array, end: Array, time_s: float, gm: float) -> tuple[Array, Array] | None:
    """Velocities at both ends of the short way, less than half a revolution.

    By universal variables: Bate, Mueller & White 1971, section 5.3.

    Args:
        start: position in m, shape (3,).
        end: position in m, shape (3,).
        time_s: from one to the other.
        gm: of the body in m^3/s^2.

    Returns:
        Both in m/s, shape (3,) each; None if the positions are in line with the centre, or no arc takes
        that time.
    """
    r1, r2 = float(np.linalg.norm(start)), float(np.linalg.norm(end))
    cosine = float(start @ end) / (r1 * r2)
    a = np.sqrt(r1 * r2 * (1.0 + cosine))
    if a < 1e-6 * r1 or 1.0 - cosine < 1e-12:
        return None

    def y(z: float) -> float:
        c, s = _stumpff(z)
        return r1 + r2 - a * (1.0 - z * s) / np.sqrt(c)

    def late(z: float) -> float:
        """How much longer than asked the arc takes; less than no time where there is none."""
        if (height := y(z)) <= 0.0:
            return -time_s
        c, s = _stumpff(z)
        return ((height / c) ** 1.5 * s + a * np.sqrt(height)) / np.sqrt(gm) - time_s

    low, high = -50.0, 4.0 * np.pi**2 * (1.0 - 1e-6)
    while late(low) > 0.0 and low > -1e5:
        low *= 2.0
    if late(low) > 0.0 or late(high) < 0.0:
        return None
    height = y(float(brentq(late, low, high, xtol=1e-12)))
    f, g, g_rate = 1.0 - height / r1, a * np.sqrt(height / gm), 1.0 - height / r2
    return (end - f * start) / g, (g_rate * end - start) / g
