"""Whether the Sun's position and velocity are those of a small body on its orbit, in km and km/s."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.constants import au

from scp_recon.errors import InputError
from scp_recon.mission.given import Given, between
from scp_recon.scenario.warning import ScenarioWarning

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


def distance(given: Given) -> Iterator[ScenarioWarning]:
    """A body is between 0.1 and 50 au from the Sun."""
    sun = given.scenario.sun
    away = float(np.linalg.norm(sun.body_position_km)) / AU_KM
    text = f"{away * AU_KM:g} km, which is {away:.4g} au from the Sun"
    yield from between(
        "sun.body_position_km", away, text, "in kilometres", DISTANCE_AU, DISTANCE_AU, "au"
    )


def orbit(given: Given) -> Iterator[ScenarioWarning]:
    """Position and velocity make an osculating orbit about the Sun: its size, shape and plane.

    Semi-major axis by the vis-viva equation, eccentricity and plane from the angular momentum; Bate,
    Mueller & White, Fundamentals of Astrodynamics, section 2.4.
    """
    position = np.array(given.scenario.sun.body_position_km)
    velocity = np.array(given.scenario.sun.body_velocity_km_s)
    away, speed = float(np.linalg.norm(position)), float(np.linalg.norm(velocity))
    escape = float(np.sqrt(2.0 * GM_SUN_KM3_S2 / away))
    entry, text = "sun.body_velocity_km_s", f"{speed:.4g} km/s at {away / AU_KM:.3g} au"
    if speed**2 > UNBOUND * escape**2:
        most = np.sqrt(UNBOUND) * escape
        raise InputError(entry, text, f"must be below {most:.3g} km/s: escape takes {escape:.3g}")
    axis = 1.0 / (2.0 / away - speed**2 / GM_SUN_KM3_S2) / AU_KM
    if not AXIS_AU[0] <= axis <= AXIS_AU[1]:
        shown = f"an orbit of semi-major axis {axis:.3g} au" if axis > 0.0 else "no closed orbit"
        rule = f"{AXIS_AU[0]:g} to {AXIS_AU[1]:g} au would be no surprise"
        yield ScenarioWarning.of(entry, f"{text}, {shown}", rule)
    momentum = np.cross(position, velocity)
    eccentricity = float(
        np.linalg.norm(np.cross(velocity, momentum) / GM_SUN_KM3_S2 - position / away)
    )
    if eccentricity > ECCENTRICITY_MAX:
        rule = f"below {ECCENTRICITY_MAX:g} would be no surprise; are the axes in order?"
        yield ScenarioWarning.of(entry, f"{text}, an eccentricity of {eccentricity:.2f}", rule)
    north = np.array([0.0, -np.sin(OBLIQUITY_RAD), np.cos(OBLIQUITY_RAD)])
    size = float(np.linalg.norm(momentum))
    tilt = (
        float(np.rad2deg(np.arccos(np.clip(momentum @ north / size, -1.0, 1.0)))) if size else 0.0
    )
    if tilt > INCLINATION_MAX_DEG:
        rule = f"below {INCLINATION_MAX_DEG:g} deg would be no surprise; J2000, axes in order?"
        yield ScenarioWarning.of(entry, f"an orbit {tilt:.0f} deg off the ecliptic", rule)
