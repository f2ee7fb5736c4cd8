"""Whether the Sun's position and velocity are those of a small body on its orbit, in km and km/s."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.constants import au

from scp_recon.environment.catalogue import DAY_S, J2000_TDB, packaged_body
from scp_recon.errors import InputError
from scp_recon.mission.checks.given import Given, angle_deg, between
from scp_recon.physics.frames import unit
from scp_recon.scenario.warning import ScenarioWarning

Array = npt.NDArray[np.float64]

GM_SUN_KM3_S2 = 1.32712440018e11
"""IERS Conventions 2010, table 1.1."""
AU_KM = au / 1000.0
OBLIQUITY_RAD = np.deg2rad(84381.406 / 3600.0)
"""Of the ecliptic at J2000; IAU 2006."""
DISTANCE_AU, AXIS_AU = (0.1, 50.0), (0.5, 6.0)
"""Of a body from the Sun, beyond which it is refused; and the semi-major axes of what is flown to."""
UNBOUND = 2.0
"""Square of the speed over that of escape, beyond which nothing in the Solar System moves."""
ECCENTRICITY_MAX, INCLINATION_MAX_DEG = 0.9, 50.0
"""Few asteroids are beyond either; a Sun whose axes are swapped often is."""
SAME_AXIS, SAME_PLANE_DEG, SAME_ECCENTRICITY = 0.01, 0.2, 0.02
"""How far a known body's orbit may be off: room for what the planets do to it in some years."""
SAME_PLACE_DEG = 0.5
"""How far along it, for each year outside the elements' span: mean motions change by 4e-4 deg/day."""


def distance(given: Given) -> Iterator[ScenarioWarning]:
    """A body is between 0.1 and 50 au from the Sun."""
    sun = given.scenario.sun
    away = float(np.linalg.norm(sun.body_position_km)) / AU_KM
    text = f"{away * AU_KM:g} km, which is {away:.4g} au from the Sun"
    yield from between(
        "sun.body_position_km", away, text, "in kilometres", DISTANCE_AU, DISTANCE_AU, "au"
    )


@dataclass(frozen=True)
class Orbit:
    """Osculating orbit about the Sun.

    Attributes:
        axis_au: semi-major axis, negative of what leaves the Solar System.
        eccentricity: vector to the perihelion as long as the eccentricity, shape (3,), J2000.
        normal: unit vector of the angular momentum, shape (3,), J2000; zero of a straight fall.
    """

    axis_au: float
    eccentricity: Array
    normal: Array

    @classmethod
    def of(cls, position_km: npt.ArrayLike, velocity_km_s: npt.ArrayLike) -> Orbit:
        """From a heliocentric state: Bate, Mueller & White, Fundamentals of Astrodynamics, 2.4."""
        position, velocity = (np.asarray(x, dtype=float) for x in (position_km, velocity_km_s))
        away = np.linalg.norm(position)
        momentum = np.cross(position, velocity)
        size = np.linalg.norm(momentum)
        energy = 2.0 / away - velocity @ velocity / GM_SUN_KM3_S2
        return cls(
            axis_au=float(1.0 / energy / AU_KM) if energy else np.inf,
            eccentricity=np.cross(velocity, momentum) / GM_SUN_KM3_S2 - position / away,
            normal=momentum / size if size else momentum,
        )


def orbit(given: Given) -> Iterator[ScenarioWarning]:
    """Position and velocity make an osculating orbit about the Sun: its size, shape and plane.

    Components along the axes of the ecliptic, which many tables have, make the inclination the angle
    off the equator. Below 11.7 deg, half the obliquity, this is told, and never of what is right.
    """
    sun = given.scenario.sun
    away = float(np.linalg.norm(sun.body_position_km))
    speed = float(np.linalg.norm(sun.body_velocity_km_s))
    escape = float(np.sqrt(2.0 * GM_SUN_KM3_S2 / away))
    entry, text = "sun.body_velocity_km_s", f"{speed:.4g} km/s at {away / AU_KM:.3g} au"
    if speed**2 > UNBOUND * escape**2:
        most = np.sqrt(UNBOUND) * escape
        raise InputError(entry, text, f"must be below {most:.3g} km/s: escape takes {escape:.3g}")
    found = Orbit.of(sun.body_position_km, sun.body_velocity_km_s)
    if not AXIS_AU[0] <= found.axis_au <= AXIS_AU[1]:
        closed = 0.0 < found.axis_au < np.inf
        shown = (
            f"an orbit of semi-major axis {found.axis_au:.3g} au" if closed else "no closed orbit"
        )
        rule = f"{AXIS_AU[0]:g} to {AXIS_AU[1]:g} au would be no surprise"
        yield ScenarioWarning.of(entry, f"{text}, {shown}", rule)
    if (eccentricity := float(np.linalg.norm(found.eccentricity))) > ECCENTRICITY_MAX:
        rule = f"below {ECCENTRICITY_MAX:g} would be no surprise; are the axes in order?"
        yield ScenarioWarning.of(entry, f"{text}, an eccentricity of {eccentricity:.2f}", rule)
    north = np.array([0.0, -np.sin(OBLIQUITY_RAD), np.cos(OBLIQUITY_RAD)])
    if (tilt := angle_deg(found.normal, north)) > INCLINATION_MAX_DEG:
        rule = f"below {INCLINATION_MAX_DEG:g} deg would be no surprise; J2000, axes in order?"
        yield ScenarioWarning.of(entry, f"an orbit {tilt:.1f} deg off the ecliptic", rule)
    if (equatorial := angle_deg(found.normal, np.array([0.0, 0.0, 1.0]))) < tilt:
        yield ScenarioWarning.of(
            entry,
            f"an orbit {tilt:.1f} deg off the ecliptic and {equatorial:.1f} deg off Earth's equator",
            "nearer to the ecliptic would be no surprise; along the axes of the equator, not of the "
            "ecliptic?",
        )


def known_orbit(given: Given) -> Iterator[ScenarioWarning]:
    """A packaged body is on its orbit, and about where on it: at epochs without elements, too."""
    scenario = given.scenario
    body, sun, packaged = scenario.body, scenario.sun, packaged_body(scenario.body.name)
    if packaged is None:
        return
    days = (scenario.epoch.tdb - J2000_TDB).total_seconds() / DAY_S
    found = Orbit.of(sun.body_position_km, sun.body_velocity_km_s)
    known = Orbit.of(*packaged.heliocentric(float(np.clip(days, *packaged.span))))
    tilt = angle_deg(found.normal, known.normal)
    off = float(np.linalg.norm(found.eccentricity - known.eccentricity))
    same = abs(found.axis_au / known.axis_au - 1.0) <= SAME_AXIS
    if not same or tilt > SAME_PLANE_DEG or off > SAME_ECCENTRICITY:
        yield ScenarioWarning.of(
            "sun.body_position_km",
            f"with the velocity an orbit of {found.axis_au:.3f} au, its plane {tilt:.2f} deg and "
            f"its eccentricity vector {off:.3f} off that of {body.name}",
            f"{known.axis_au:.3f} au, and within {SAME_PLANE_DEG:g} deg and {SAME_ECCENTRICITY:g}",
        )
        return
    place = unit(packaged.extrapolated(days)[0])
    ahead = angle_deg(np.array(sun.body_position_km), place)
    most = SAME_PLACE_DEG * max(1.0, packaged.years_beyond(days))
    if ahead > most:
        first, last = packaged.years
        yield ScenarioWarning.of(
            "sun.body_position_km",
            f"{ahead:.1f} deg from where {body.name} would be at {scenario.epoch.tdb:%Y-%m-%d} on its "
            f"orbit of {first if days < packaged.span[0] else last}",
            f"at most {most:.1f} deg would be no surprise; is it that of the epoch?",
        )
