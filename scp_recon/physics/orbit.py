"""The body's way about the Sun where a straight line is not good enough: two-body motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

from scp_recon.environment.catalogue import GM_SUN_KM3_S2

Array = npt.NDArray[np.float64]

NEAREST_KM = 1e7
"""To the Sun's centre, 0.067 au: no known asteroid comes nearer, where the cubics are too long."""
NODE_STEP_S = 3600.0
"""Between nodes the motion is a cubic: off by 1e-7 km at 1 au, and by 0.1 km at `NEAREST_KM`."""


def two_body(
    position_km: npt.ArrayLike, velocity_km_s: npt.ArrayLike, span_s: tuple[float, float]
) -> Callable[[npt.ArrayLike], Array]:
    """Heliocentric motion r'' = -GM r / r^3, by SciPy's DOP853 and cubics between hours.

    Args:
        position_km: at time zero, shape (3,), J2000.
        velocity_km_s: at time zero, shape (3,).
        span_s: first and last time, relative to time zero, that will be asked for.

    Returns:
        Position in km, shape (..., 3), of times in s, shape (...).

    Raises:
        ValueError: if the body comes within `NEAREST_KM` of the Sun's centre.
    """
    start = np.concatenate([np.asarray(position_km, float), np.asarray(velocity_km_s, float)])

    def rate(_: float, y: Array) -> Array:
        return np.concatenate([y[3:], -GM_SUN_KM3_S2 * y[:3] / np.linalg.norm(y[:3]) ** 3])

    def too_near(_: float, y: Array) -> float:
        return float(np.linalg.norm(y[:3])) - NEAREST_KM

    too_near.terminal = True  # type: ignore[attr-defined]
    if too_near(0.0, start) <= 0.0:
        raise ValueError(f"the body is within {NEAREST_KM:g} km of the Sun's centre")
    first, last = min(span_s[0], 0.0) - NODE_STEP_S, max(span_s[1], 0.0) + NODE_STEP_S
    nodes = []
    for end in (first, last):
        times = np.linspace(0.0, end, int(np.ceil(abs(end) / NODE_STEP_S)) + 1)
        flown = solve_ivp(
            rate, (0.0, end), start, "DOP853", t_eval=times, events=too_near, rtol=1e-11, atol=1e-6
        )
        if flown.status != 0:
            raise ValueError(f"the body comes within {NEAREST_KM:g} km of the Sun's centre")
        nodes.append((flown.t, flown.y))
    (before, back), (after, forth) = nodes
    times = np.concatenate([before[:0:-1], after])
    states = np.concatenate([back[:, :0:-1], forth], axis=1).T
    motion = CubicHermiteSpline(times, states[:, :3], states[:, 3:])
    return lambda time_s: motion(np.asarray(time_s, dtype=float))
