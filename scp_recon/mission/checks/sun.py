"""Checks of the Sun's position and velocity: the orbit they make, and that of a packaged body."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array
from scp_recon.bodies.catalogue import (
    AU_KM,
    DAY_S,
    GM_SUN_KM3_S2,
    J2000_TDB,
    packaged_body,
)
from scp_recon.mission.scene import Scene
from scp_recon.physics.frames import unit
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.resolution.agreement import angle_deg

SAME_AXIS, SAME_PLANE_DEG, SAME_ECCENTRICITY = 0.01, 0.2, 0.02
"""How far a known body's orbit may be off: room for what the planets do to it in some years."""
SAME_PLACE_DEG = 0.5
"""How far along it, for each year outside the elements' span: mean motions change by 4e-4 deg/day."""


@dataclass(frozen=True)
class Orbit:
    """Osculating orbit about the Sun."""

    axis_au: float
    """Semi-major axis, negative of what leaves the Solar System."""
    eccentricity: Array
    """Vector to the perihelion as long as the eccentricity, shape (3,), J2000."""
    normal: Array
    """Unit vector of the angular momentum, shape (3,), J2000; zero of a straight fall."""

    @classmethod
    def of_body(cls, scene: Scene) -> Orbit:
        """That of a scene's body at the epoch."""
        return cls.of(scene.scenario.sun.body_position_km, scene.scenario.sun.body_velocity_km_s)

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


def known_orbit(scene: Scene) -> Iterator[ScenarioWarning]:
    """Warn of a packaged body on another orbit than its own, or at another place on it.

    That is 1 % in size, 0.2 deg in plane, 0.02 in eccentricity; 0.5 deg in place, and as much again for
    each year outside its elements.
    """
    scenario = scene.scenario
    body, sun, packaged = scenario.body, scenario.sun, packaged_body(scenario.body.name)
    if packaged is None:
        return
    days = (scenario.epoch.tdb - J2000_TDB).total_seconds() / DAY_S
    found = Orbit.of_body(scene)
    known = Orbit.of(*packaged.heliocentric(float(np.clip(days, *packaged.span))))
    tilt = angle_deg(found.normal, known.normal)
    off = float(np.linalg.norm(found.eccentricity - known.eccentricity))
    same = abs(found.axis_au / known.axis_au - 1.0) <= SAME_AXIS
    if not same or tilt > SAME_PLANE_DEG or off > SAME_ECCENTRICITY:
        yield ScenarioWarning.of(
            "sun.body_position_km",
            f"with the velocity an orbit of {found.axis_au:.3f} au, its plane {tilt:.2f} deg and "
            f"its eccentricity vector {off:.3f} off that of {body.name}",
            f"expected {known.axis_au:.3f} au, within {SAME_PLANE_DEG:g} deg and "
            f"{SAME_ECCENTRICITY:g}",
        )
        return
    place = unit(packaged.extrapolated(days)[0])
    ahead = angle_deg(sun.body_position_km, place)
    days_beyond = max(packaged.span[0] - days, days - packaged.span[1])
    most = SAME_PLACE_DEG * max(1.0, days_beyond / 365.25)
    if ahead > most:
        first, last = packaged.years
        yield ScenarioWarning.of(
            "sun.body_position_km",
            f"{ahead:.1f} deg from where {body.name} would be at {scenario.epoch.tdb:%Y-%m-%d} on its "
            f"orbit of {first if days < packaged.span[0] else last}",
            f"expected at most {most:.1f} deg; is it that of the epoch?",
        )
