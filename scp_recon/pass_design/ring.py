"""The home orbit as a ring of states, in which a phase stands for a place and its velocity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp
from scipy.interpolate import PchipInterpolator

from scp_recon.errors import InputError
from scp_recon.physics.forces import ForceModel, acceleration
from scp_recon.scenario.home import HomeOrbit

Array = npt.NDArray[np.float64]

TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Ring:
    """States by phase, whose waiting spacecraft may be at any of them at any time.

    Attributes:
        state: of a phase in [0, 2 pi), rad: position and velocity, J2000, body-centred, m and m/s,
            shape (6,).
    """

    state: Callable[[float], Array]

    def __call__(self, phase_rad: float) -> Array:
        """The state at a phase of any turn."""
        return self.state(float(np.mod(phase_rad, TURN)))


def home_ring(home: HomeOrbit, gm: float, axes: Array) -> Ring:
    """The home orbit of a scenario.

    Args:
        home: circle.
        gm: of the body, m^3/s^2.
        axes: from boundary.frame to J2000, shape (3, 3).
    """

    def state(phase: float) -> Array:
        position, velocity = home.state(phase, gm).reshape(2, 3)
        return np.concatenate([axes @ position, axes @ velocity])

    return Ring(state)


def flown_ring(home: HomeOrbit, forces: ForceModel, axes: Array) -> Ring:
    """One revolution under a mission's forces, from the circle's state at phase zero on.

    Phases are angles about the circle's normal, as on the circle; the ends of the revolution meet at
    phase zero only nearly.

    Args:
        home: circle.
        forces: of the mission at its epoch.
        axes: from boundary.frame to J2000, shape (3, 3).

    Raises:
        InputError: if it does not come round within three of the circle's revolutions.
    """
    start, normal = home_ring(home, forces.gm, axes)(0.0), axes @ np.array(home.normal)
    sense = 1.0 if home.sense == "right_handed" else -1.0
    first = start[:3] / np.linalg.norm(start[:3])
    second = np.cross(normal / np.linalg.norm(normal), first)
    period = TURN * np.sqrt(home.radius_m**3 / forces.gm)

    def rate(_: float, y: Array) -> Array:
        return np.array([*y[3:], *acceleration(y[0], y[1], y[2], forces)])

    flown = solve_ivp(
        rate, (0.0, LONGEST * period), start, "DOP853", dense_output=True, rtol=1e-10, atol=1e-6
    )
    times = np.linspace(0.0, LONGEST * period, SAMPLES)
    track = flown.sol
    assert track is not None  # of a dense output
    places = track(times)[:3]
    angle = sense * np.unwrap(np.arctan2(second @ places, first @ places))
    once = int(np.argmax(angle >= TURN)) + 1
    if not flown.success or once == 1 or np.any(np.diff(angle[:once]) <= 0.0):
        raise InputError(
            "boundary.home.flown",
            f"a circle of {home.radius_m:g} m",
            f"must come round under the mission's forces within {LONGEST:g} of its revolutions",
        )
    when = PchipInterpolator(angle[:once], times[:once])

    def state(phase: float) -> Array:
        return np.asarray(track(float(when(np.mod(sense * phase, TURN)))))

    return Ring(state)


LONGEST, SAMPLES = 3.0, 3001
"""Revolutions of the circle in which the flown one has to come round, and looks at it."""
