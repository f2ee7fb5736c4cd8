"""Whether the entries of a scenario, each within its own bounds, make sense together."""

from __future__ import annotations

import math

from scp_recon.errors import InputError
from scp_recon.mission.grid import RK4_STEP_MAX_S
from scp_recon.scenario.schema import Scenario

NODES_MAX = 3000
"""Beyond it a plan would take minutes and gigabytes."""


def check_plausible(scenario: Scenario) -> None:
    """Refuse what would never end, or end in figures that are not finite.

    Raises:
        InputError: if the grid has too many nodes, the body's straight line could lead to the Sun, or
            the flight begins or ends inside the body or turns about it faster than the planner's steps.
    """
    duration, step = scenario.duration_s, scenario.grid.step_max_s
    if max(scenario.grid.nodes_s, default=0.0) > duration:
        raise InputError(
            "grid.nodes_s",
            f"{max(scenario.grid.nodes_s):g} s",
            f"must be inside the flight of {duration:g} s",
        )
    if duration / step > NODES_MAX:
        raise InputError(
            "grid.step_max_s",
            f"{step:g} s",
            f"must leave at most {NODES_MAX} nodes in the flight of {duration:g} s",
        )
    away = math.hypot(*scenario.sun.body_position_km)
    speed = math.hypot(*scenario.sun.body_velocity_km_s)
    if speed * duration > 0.5 * away:
        raise InputError(
            "sun.body_velocity_km_s",
            f"{speed:g} km/s",
            f"must carry the body less than half its {away:g} km from the Sun in the flight",
        )
    radius, gm = scenario.body.reference_radius_m, scenario.body.gm_m3_s2
    positions = {
        "boundary.initial_position_m": scenario.boundary.initial_position_m,
        "boundary.final_position_m": scenario.boundary.final_position_m,
    }
    if scenario.boundary.home is not None:  # both are on its circle
        positions = {"boundary.home.radius_m": scenario.boundary.initial_position_m}
    flown = "in_flight.position_m"
    if scenario.in_flight is not None:
        positions[flown] = scenario.in_flight.position_m
    for entry, position in positions.items():
        distance = math.hypot(*position)
        if distance <= radius:
            raise InputError(
                entry,
                f"{distance:g} m from the centre",
                f"must be outside the body, whose reference radius is {radius:g} m",
            )
        if gm * RK4_STEP_MAX_S**2 > distance**3:
            if entry == flown:  # of a body about which a flight was planned
                raise InputError(
                    entry,
                    f"{distance:g} m from the centre",
                    f"must be above {(gm * RK4_STEP_MAX_S**2) ** (1.0 / 3.0):g} m, where a flight "
                    f"turns no faster than the planner's steps of {RK4_STEP_MAX_S:g} s follow",
                )
            raise InputError(
                "body.gm_m3_s2",
                f"{gm:g}",
                f"must be below {distance**3 / RK4_STEP_MAX_S**2:g}: {entry} is "
                f"{distance:g} m from the centre, and the planner's steps are {RK4_STEP_MAX_S:g} s",
            )
