"""Whether flight, limits and spacecraft are those that were meant, and in the units of their keys.

Physics cannot tell a probability, and the axes of the boundary states only where wrong ones
lead into the body's shadow.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from scp_recon.errors import InputError
from scp_recon.mission.checks.given import Given
from scp_recon.mission.states import boundary_state, sun_direction
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.warning import ScenarioWarning

FAR_RADII, FAST_ESCAPES, SLOW_ESCAPES, BURN_ESCAPES = 100.0, 20.0, 0.01, 20.0
"""Boundary distances in reference radii, speeds in escape speeds there; burns, in the largest speed."""
RATIO_MAX = 100.0
"""Between the largest and the least distance from the site."""
ANGLE_MIN_DEG = float(np.pi / 2.0)
"""Every angle of a cone that was given in radians is below it."""
AREA_TO_MASS = (1e-4, 1.0)
"""m^2/kg: from a solid block to a solar sail."""
REFLECTIVITY = (0.5, 2.0)
"""C_R of what is between a mirror that sends the light on and one that sends it back."""
SOLAR_CONSTANT = (1300.0, 1420.0)
"""W/m^2 at 1 au: 1361 and what was once measured of it."""
DURATION_MIN_S = 60.0
"""Of a slew, a heating, a recharge: an hour given in minutes."""


def safety(given: Given) -> Iterator[ScenarioWarning]:
    """The radius that the flight keeps clear of holds the body."""
    least, radius = given.scenario.safety.radius_min_m, given.scenario.body.reference_radius_m
    if least < radius:
        raise InputError(
            "safety.radius_min_m",
            f"{least:g} m",
            f"must be at least the body's reference radius, {radius:g} m: below it is the inside",
        )
    yield from ()


def site_distances(given: Given) -> Iterator[ScenarioWarning]:
    """Distances from the site leave room above the safety radius, and bind."""
    limits = given.scenario.observation
    low, high = limits.site_distance_min_m, limits.site_distance_max_m
    clear = given.scenario.safety.radius_min_m - float(np.linalg.norm(given.site.position_body))
    if high < clear:
        raise InputError(
            "observation.site_distance_max_m",
            f"{high:g} m",
            f"must be at least {clear:g} m: outside the safety radius no point is nearer to the site",
        )
    far = FAR_RADII * given.scenario.body.reference_radius_m
    if low > far:
        yield ScenarioWarning.of(
            "observation.site_distance_min_m",
            f"{low:g} m",
            f"at most {far:g} m, {FAR_RADII:g} reference radii, would be no surprise",
        )
    if high > RATIO_MAX * low:
        yield ScenarioWarning.of(
            "observation.site_distance_min_m",
            f"{low:g} m to {high:g} m",
            f"distances within a factor of {RATIO_MAX:g} would be no surprise; metres both?",
        )


def boundary(given: Given) -> Iterator[ScenarioWarning]:
    """A flight about a body begins and ends near it, at speeds that its gravity knows."""
    states = given.scenario.boundary
    for which in ("initial_", "final_"):
        position = getattr(states, f"{which}position_m")
        velocity = getattr(states, f"{which}velocity_m_s")
        yield from _near(given.scenario, f"boundary.{which}", position, velocity)


def shadow(given: Given) -> Iterator[ScenarioWarning]:
    """A flight begins and ends in the light: swapped axes may lead into the body's shadow.

    That is a cylinder of the reference radius; the planner's forces know of none.
    """
    scenario, radius = given.scenario, given.scenario.body.reference_radius_m
    for which, time_s in (("initial", 0.0), ("final", scenario.duration_s)):
        position = boundary_state(scenario, given.rotation, which)[:3]
        sun = sun_direction(scenario, time_s)
        along, across = float(position @ sun), float(np.linalg.norm(np.cross(position, sun)))
        if along < 0.0 and across < radius:
            yield ScenarioWarning.of(
                f"boundary.{which}_position_m",
                f"a place in the body's shadow, {across:.0f} m off its axis",
                f"one in the light, {radius:g} m and more off it, would be no surprise: the frame and "
                "its axes?",
            )


def in_flight(scenario: Scenario) -> Iterator[ScenarioWarning]:
    """And so it is where it is under way."""
    flight = scenario.in_flight
    if flight is not None:
        yield from _near(scenario, "in_flight.", flight.position_m, flight.velocity_m_s)


def _near(
    scenario: Scenario, table: str, position_m: Sequence[float], velocity_m_s: Sequence[float]
) -> Iterator[ScenarioWarning]:
    body = scenario.body
    far = FAR_RADII * body.reference_radius_m
    distance, speed = math.hypot(*position_m), math.hypot(*velocity_m_s)
    if distance > far:
        yield ScenarioWarning.of(
            f"{table}position_m",
            f"{distance:g} m from the centre",
            f"at most {far:g} m, {FAR_RADII:g} radii, would be no surprise",
        )
    escape = math.sqrt(2.0 * body.gm_m3_s2 / distance)
    if speed > FAST_ESCAPES * escape or 0.0 < speed < SLOW_ESCAPES * escape:
        yield ScenarioWarning.of(
            f"{table}velocity_m_s",
            f"{speed:.3g} m/s",
            f"{SLOW_ESCAPES * escape:.3g} to {FAST_ESCAPES * escape:.3g} m/s would be no surprise: "
            f"escape speed there is {escape:.3g} m/s",
        )


def burn_size(given: Given) -> Iterator[ScenarioWarning]:
    """A limit on the burns is one only where it can bind."""
    scenario = given.scenario
    escape = np.sqrt(2.0 * scenario.body.gm_m3_s2 / scenario.body.reference_radius_m)
    speeds = [
        np.linalg.norm(getattr(scenario.boundary, f"{which}_velocity_m_s"))
        for which in ("initial", "final")
    ]
    most = BURN_ESCAPES * float(max(escape, *speeds))
    if scenario.burns.dv_max_m_s > most:
        yield ScenarioWarning.of(
            "burns.dv_max_m_s",
            f"{scenario.burns.dv_max_m_s:g} m/s",
            f"at most {most:.3g} m/s would be no surprise: more than that turns any flight here round",
        )


def limit_angles(given: Given) -> Iterator[ScenarioWarning]:
    """A limit below 1.6 degrees is hardly a limit, and likely in radians."""
    for table in ("observation", "battery"):
        for entry, value in getattr(given.scenario, table):
            limit = entry.endswith("_deg") and value is not None
            if limit and 0.0 < value < ANGLE_MIN_DEG:
                yield ScenarioWarning.of(
                    f"{table}.{entry}",
                    f"{value:g} deg",
                    f"{ANGLE_MIN_DEG:.2f} deg and more would be no surprise; degrees?",
                )


def spacecraft(given: Given) -> Iterator[ScenarioWarning]:
    """Area and mass belong to one spacecraft, and sunlight to one Sun."""
    craft, constant = given.scenario.spacecraft, given.scenario.sun.solar_constant_w_m2
    ratio = craft.srp_area_m2 / craft.mass_kg
    low, high = AREA_TO_MASS
    if ratio and not low <= ratio <= high:
        yield ScenarioWarning.of(
            "spacecraft.srp_area_m2",
            f"{craft.srp_area_m2:g} m^2 of {craft.mass_kg:g} kg",
            f"{low:g} to {high:g} m^2/kg would be no surprise",
        )
    low, high = REFLECTIVITY
    coefficient = craft.reflectivity_coefficient
    if coefficient and not low <= coefficient <= high:
        yield ScenarioWarning.of(
            "spacecraft.reflectivity_coefficient",
            f"{coefficient:g}",
            f"{low:g} to {high:g} would be no surprise: 1 absorbs, 2 reflects everything",
        )
    low, high = SOLAR_CONSTANT
    if not low <= constant <= high:
        expected = f"{low:g} to {high:g} W/m^2 at 1 au"
        yield ScenarioWarning.of("sun.solar_constant_w_m2", f"{constant:g} W/m^2", expected)


def durations(given: Given) -> Iterator[ScenarioWarning]:
    """What takes no time takes none, and what takes some takes a minute."""
    for entry, value in given.scenario.schedule:
        if 0.0 < value < DURATION_MIN_S:
            yield ScenarioWarning.of(
                f"schedule.{entry}",
                f"{value:g} s",
                f"0, or {DURATION_MIN_S:g} s and more, would be no surprise; seconds?",
            )
