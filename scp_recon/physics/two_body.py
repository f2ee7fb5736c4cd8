"""Solve two-body motion: osculating and heliocentric orbits, a companion's orbit, Lambert's arc."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from formulations.arrays import Array
from scp_recon.bodies.catalogue import GM_SUN_KM3_S2, eccentric_anomaly
from scp_recon.physics.frames import Rotation
from scp_recon.scenario import body

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

NEAREST_KM = 1e7
"""Least distance from the Sun's centre, 0.067 au: no known asteroid comes nearer; cubics fail there."""
NODE_STEP_S = 3600.0
"""Between nodes the motion is a cubic: off by 1e-7 km at 1 au, and by 0.1 km at `NEAREST_KM`."""


@dataclass(frozen=True)
class Orbit:
    """Osculating orbit."""

    axis: float
    """Semi-major axis in the position's unit: negative of a hyperbola, infinite of a parabola."""
    eccentricity: Array
    """Vector to the pericentre as long as the eccentricity, shape (3,)."""
    normal: Array
    """Unit vector of the angular momentum, shape (3,); zero of a straight fall."""

    @classmethod
    def of(cls, position: npt.ArrayLike, velocity: npt.ArrayLike, gm: float) -> Orbit:
        """Orbit of a state in any units: Bate, Mueller & White, Fundamentals of Astrodynamics, 2.4."""
        position, velocity = (np.asarray(x, dtype=float) for x in (position, velocity))
        away = np.linalg.norm(position)
        momentum = np.cross(position, velocity)
        size = np.linalg.norm(momentum)
        energy = 2.0 / away - velocity @ velocity / gm
        return cls(
            axis=float(1.0 / energy) if energy else np.inf,
            eccentricity=np.cross(velocity, momentum) / gm - position / away,
            normal=momentum / size if size else momentum,
        )

    def angles(self, position: Array) -> tuple[float, float, float, float]:
        """Inclination, node, argument of the pericentre, true anomaly of a position on it; rad.

        The node of an orbit in the plane of x and y is x; the pericentre of a circle is at the node.
        """
        x, y, z = self.normal
        node = np.array([-y, x, 0.0]) if np.hypot(x, y) > 1e-12 else np.array([1.0, 0.0, 0.0])
        round_one = np.linalg.norm(self.eccentricity) <= 1e-12
        nearest = node if round_one else self.eccentricity

        def turn(a: Array, b: Array) -> float:
            return float(np.arctan2(self.normal @ np.cross(a, b), a @ b) % (2.0 * np.pi))

        inclination = float(np.arctan2(np.hypot(x, y), z))
        ascending = float(np.arctan2(node[1], node[0]) % (2.0 * np.pi))
        return inclination, ascending, turn(node, nearest), turn(nearest, position)


def two_body(
    position_km: npt.ArrayLike, velocity_km_s: npt.ArrayLike, span_s: tuple[float, float]
) -> CubicHermiteSpline:
    """Heliocentric motion r'' = -GM r / r^3, by SciPy's DOP853 and cubics between hours.

    Starts from the state at time zero, J2000. Returns a function of times in s within the span, shape
    (...), that gives positions in km, shape (..., 3), or with the second argument 1 velocities in km/s.

    Raises:
        ValueError: if the body comes within `NEAREST_KM` of the Sun's centre.
    """
    from scipy.interpolate import CubicHermiteSpline  # of one scenario in many

    start = np.concatenate([np.asarray(position_km, float), np.asarray(velocity_km_s, float)])

    def rate(_: float, y: Array) -> Array:
        return np.concatenate([y[3:], -GM_SUN_KM3_S2 * y[:3] / np.linalg.norm(y[:3]) ** 3])

    def too_near(_: float, y: Array) -> float:
        return float(np.linalg.norm(y[:3])) - NEAREST_KM

    too_near.terminal = True  # type: ignore[attr-defined]
    if too_near(0.0, start) <= 0.0:
        raise ValueError(f"the body is within {NEAREST_KM:g} km of the Sun's centre")
    first, last = min(*span_s, 0.0) - NODE_STEP_S, max(*span_s, 0.0) + NODE_STEP_S
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
    return CubicHermiteSpline(times, states[:, :3], states[:, 3:])


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
    """Velocities at both ends of the arc of less than half a revolution; SI, shape (3,) each.

    By universal variables: Bate, Mueller & White 1971, section 5.3. None if the positions are in line
    with the centre, or no arc takes that time.
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
        """Time of the arc less the required one; of no time at all where there is no arc."""
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


@dataclass(frozen=True, eq=False)
class Companion:
    """A second body, in any consistent units; time zero is the epoch.

    Attributes:
        gm: gravitational parameter.
        semi_major_axis: of its orbit about the first body's centre.
        eccentricity: of that orbit.
        mean_anomaly: at `t = 0`, rad.
        rate: mean motion, rad per time.
        axes: unit vectors to the periapsis and a quarter turn ahead, inertial, shape (2, 3).
    """

    gm: float
    semi_major_axis: float
    eccentricity: float
    mean_anomaly: float
    rate: float
    axes: Array

    @classmethod
    def of(cls, given: body.Companion, tdb: datetime) -> Companion:
        """The companion of a scenario's table at `tdb`, SI."""
        rate = 2.0 * np.pi / (3600.0 * given.period_h)
        passed = rate * (tdb - given.epoch_tdb).total_seconds()
        ra, dec, periapsis, anomaly = np.deg2rad(
            [given.pole_ra_deg, given.pole_dec_deg, given.periapsis_deg, given.mean_anomaly_deg]
        )
        plane = Rotation(ra, dec, periapsis, 0.0, 0.0).body_to_j2000(0.0)[:, :2].T.copy()
        anomaly = float((anomaly + passed) % (2.0 * np.pi))
        size = given.semi_major_axis_m
        return cls(given.gm_m3_s2, size, given.eccentricity, anomaly, rate, plane)

    def position(self, time: npt.ArrayLike) -> Array:
        """Position of its centre from that of the first body at times, shape (..., 3)."""
        mean = self.mean_anomaly + self.rate * np.asarray(time, dtype=float)
        e = self.eccentricity
        anomaly = eccentric_anomaly(mean, e)
        along = np.stack([np.cos(anomaly) - e, np.sqrt(1.0 - e * e) * np.sin(anomaly)], axis=-1)
        return np.asarray(self.semi_major_axis * along @ self.axes)

    def in_units(self, length: float, time: float) -> Companion:
        """The same measured in units of `length` and `time`."""
        return replace(
            self,
            gm=self.gm * time**2 / length**3,
            semi_major_axis=self.semi_major_axis / length,
            rate=self.rate * time,
        )
