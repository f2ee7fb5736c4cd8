"""The boundary states of a home orbit: those at the beginnings of its spans of phases."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from scp_recon.errors import InputError
from scp_recon.scenario.home import HomeOrbit

KEYS = ("initial_position_m", "initial_velocity_m_s", "final_position_m", "final_velocity_m_s")
TOLERANCE = 1e-6
"""Share of radius and speed within which states that are given are those of the home orbit."""


def resolve_boundary(boundary: dict[str, Any], gm: object) -> None:
    """Enter the states, if there is a home orbit.

    Args:
        boundary: table to enter them in, nothing wrong with it but what is missing.
        gm: of the body, m^3/s^2, if it is known.

    Raises:
        InputError: if states are given that are not its.
    """
    if boundary.get("home") is None or not isinstance(gm, int | float):
        return
    home = HomeOrbit.model_validate_json(json.dumps(boundary["home"]))
    states = [
        home.state(float(np.deg2rad(span[0])), float(gm))
        for span in (home.departure_deg, home.arrival_deg)
    ]
    computed = [part for state in states for part in (state[:3], state[3:])]
    for key, value in zip(KEYS, computed, strict=True):
        given = boundary.setdefault(key, value.tolist())
        if not np.allclose(given, value, rtol=0.0, atol=TOLERANCE * np.linalg.norm(value)):
            raise InputError(
                f"boundary.{key}",
                str(given)[:80],
                "must be left out beside boundary.home, from which it follows",
            )
