"""Where the Sun is: from kernels, or from the mean elements of a packaged body."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scp_recon.environment.catalogue import DAY_S, PackagedBody
from scp_recon.environment.kernels import read_heliocentric
from scp_recon.errors import InputError
from scp_recon.scenario.resolution.agreement import angle_deg, check, fill, has, lacks

STATE = ("body_position_km", "body_velocity_km_s")
DIRECTION_TOLERANCE_DEG, DISTANCE_TOLERANCE, VELOCITY_TOLERANCE_KM_S = 0.1, 0.01, 0.5
"""Within these, a Sun that is given agrees with the one that is computed."""


def resolve_sun(
    sun: dict[str, Any], body: dict[str, Any], known: PackagedBody | None, days: float | None
) -> None:
    """Enter the body's heliocentric position and velocity at the epoch.

    Args:
        sun: table to enter them in.
        body: for its name and number.
        known: the packaged body of that name.
        days: TDB past J2000 of the epoch, None if unknown.

    Raises:
        InputError: if kernels cannot be used, the epoch is outside the packaged elements' span and no
            Sun is given, or the one that is given does not agree.
    """
    if days is None:
        return
    if has(sun, "spk_files"):
        if not has(body, "naif_id"):
            raise InputError(
                "body.naif_id", "nothing", "must be NAIF's number of the body in spk_files"
            )
        paths = [Path(name) for name in sun["spk_files"]]
        state, source = read_heliocentric(paths, body["naif_id"], days * DAY_S), "sun.spk_files"
    elif known is not None and (known.covers(days) or lacks(sun, *STATE)):
        position, velocity = known.heliocentric(days)
        state = position.tolist(), velocity.tolist()
        source = f"the packaged elements of {known.entries['name']}"
    else:
        return
    fill(sun, dict(zip(STATE, state, strict=True)))
    _check(sun, np.array(state[0]), np.array(state[1]), source)


def _check(sun: dict[str, Any], position: Any, velocity: Any, source: str) -> None:
    given = np.array(sun[STATE[0]], dtype=float)
    distance = float(np.linalg.norm(position))
    near = bool(
        angle_deg(given, position) <= DIRECTION_TOLERANCE_DEG
        and abs(np.linalg.norm(given) - distance) <= DISTANCE_TOLERANCE * distance
    )
    within = f"to {DIRECTION_TOLERANCE_DEG:g} deg and {DISTANCE_TOLERANCE:g} of the distance"
    check(f"sun.{STATE[0]}", given, near, position, f"by {source}, {within} (or be left out)")
    moving = np.array(sun[STATE[1]], dtype=float)
    slow = float(np.linalg.norm(moving - velocity)) <= VELOCITY_TOLERANCE_KM_S
    within = f"to {VELOCITY_TOLERANCE_KM_S:g} km/s"
    check(f"sun.{STATE[1]}", moving, slow, velocity, f"by {source}, {within} (or be left out)")
