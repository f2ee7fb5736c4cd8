"""Write the attitudes of a body that turns freely, as `body.attitude_file` takes them.

A body in short-axis mode is given by its principal moments, the direction of its angular momentum, and
two periods: of the long axis about the angular momentum (precession), and of the angular velocity in
the body (rotation). Its phases are not: it begins with the long axis farthest from the plane across
the angular momentum, over that plane's node on J2000's equator. With the name of a file it writes
Apophis' ten days from 2028-10-01 on, as they are packaged.
"""

from __future__ import annotations

import sys
from datetime import datetime
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from scp_recon.bodies.catalogue import J2000_TDB, OBLIQUITY
from scp_recon.bodies.surface import direction_of

MOMENTS = np.array([0.64, 0.97, 1.0])
"""Of Apophis, over the largest; with the rest from Lee et al. 2022, A&A 661, L3, abstract."""
PRECESSION_H, ROTATION_H = 27.38547, 264.178
MOMENTUM_ECLIPTIC = -85.0, 275.0
"""Latitude and longitude of the angular momentum, deg."""
START, DAYS, STEP_S = datetime(2028, 10, 1), 10.0, 1800.0


def motion(tilt: float, times: np.ndarray) -> np.ndarray:
    """Angular velocity and quaternion, scalar last, by Euler's equations for |L| = 1; shape (n, 7).

    At first the long axis is off the plane across L = z by `tilt`, rad, at azimuth zero.
    """
    start = Rotation.from_euler("y", -tilt)
    spin = start.inv().apply([0.0, 0.0, 1.0]) / MOMENTS

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        w, q = y[:3], y[3:]
        turning = 0.5 * np.r_[q[3] * w + np.cross(q[:3], w), -q[:3] @ w]
        return np.r_[np.cross(MOMENTS * w, w) / MOMENTS, turning]

    begin = np.r_[spin, start.as_quat()]
    found = solve_ivp(rate, (0.0, times[-1]), begin, "DOP853", times, rtol=1e-11, atol=1e-12)
    return np.asarray(found.y.T)


def periods(tilt: float) -> tuple[float, float]:
    """Periods of precession and rotation for |L| = 1."""
    times = np.linspace(0.0, 300.0, 6001)
    found = motion(tilt, times)
    # The angular velocity begins in the plane of the first and third axes, and is there again
    # after half a period.
    crossings = np.flatnonzero(found[1:-1, 1] * found[2:, 1] < 0.0) + 1
    w = found[:, 1]
    zero = [times[k] - w[k] * (times[k + 1] - times[k]) / (w[k + 1] - w[k]) for k in crossings[:2]]
    long_axis = Rotation.from_quat(found[:, 3:]).apply([1.0, 0.0, 0.0])
    azimuth = np.unwrap(np.arctan2(long_axis[:, 1], long_axis[:, 0]))
    turned = float(np.interp(zero[1], times, azimuth))
    return 2.0 * np.pi * zero[1] / turned, float(zero[1])


def tilt_and_second() -> tuple[float, float]:
    """The tilt, rad, whose two periods have the given ratio, and seconds in a unit of time."""

    def off(tilt: float) -> float:
        precession, rotation = periods(tilt)
        return rotation / precession - ROTATION_H / PRECESSION_H

    # Beyond the last it turns about its long axis, or tumbles over: s^2 (1 / I1 - 1) = 1 / I2 - 1.
    most = np.arcsin(np.sqrt((1.0 / MOMENTS[1] - 1.0) / (1.0 / MOMENTS[0] - 1.0)))
    tilt = float(brentq(off, 0.02, 0.99 * most, xtol=1e-10))
    return tilt, 3600.0 * PRECESSION_H / periods(tilt)[0]


def table() -> tuple[np.ndarray, np.ndarray]:
    """Times, TDB past J2000, and quaternions from the body to J2000, scalar first, (n,) and (n, 4)."""
    tilt, unit_s = tilt_and_second()
    times = np.arange(0.0, DAYS * 86_400.0 + STEP_S, STEP_S)
    about = Rotation.from_quat(motion(tilt, times / unit_s)[:, 3:])
    z = Rotation.from_euler("x", OBLIQUITY).apply(direction_of(*MOMENTUM_ECLIPTIC))
    node = np.array([-z[1], z[0], 0.0]) / np.hypot(z[0], z[1])
    to_j2000 = Rotation.from_matrix(np.column_stack([node, np.cross(z, node), z]))
    seconds = (START - J2000_TDB).total_seconds() + times
    return seconds, (to_j2000 * about).as_quat(scalar_first=True)


def main(path: Path) -> None:
    """Write the table."""
    rows = "\n".join(
        f"{t:.0f},{','.join(f'{x:.8f}' for x in q)}" for t, q in zip(*table(), strict=True)
    )
    text = "# Apophis, turning freely; phases are assumed: examples/tumbling.py\n"
    path.write_text(f"{text}tdb_s,qw,qx,qy,qz\n{rows}\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
