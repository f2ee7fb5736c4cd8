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


def directions(home: HomeOrbit, axes: Array) -> tuple[Array, Array, float]:
    """Unit vectors of phase zero and of a quarter turn, J2000, and 1 or -1: the way it is flown."""
    first, second = (
        axes @ home.state(phase, 1.0)[:3] / home.radius_m for phase in (0.0, 0.25 * TURN)
    )
    return first, second, 1.0 if home.sense == "right_handed" else -1.0


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
    start = home_ring(home, forces.gm, axes)(0.0)
    first, second, sense = directions(home, axes)
    period = TURN * np.sqrt(home.radius_m**3 / forces.gm)

    def rate(_: float, y: Array) -> Array:
        return np.array([*y[3:], *acceleration(y[0], y[1], y[2], forces)])

    flown = solve_ivp(
        rate, (0.0, LONGEST * period), start, "DOP853", dense_output=True, rtol=1e-10, atol=1e-6
    )
    track = flown.sol
    assert track is not None  # of a dense output
    times, last = np.linspace(0.0, LONGEST * period, SAMPLES), float(flown.t[-1])
    ring = ring_of(track, times[times <= last], first, second, sense)
    if ring is None:
        raise InputError(
            "boundary.home.flown",
            f"a circle of {home.radius_m:g} m",
            f"must come round under the mission's forces within {LONGEST:g} of its revolutions",
        )
    return ring


def ring_of(
    track: Callable[[Array], Array], times_s: Array, first: Array, second: Array, sense: float
) -> Ring | None:
    """The first revolution of a track, if it goes round in one sense.

    Args:
        track: states (6, n) at times (n,); a single one at a time.
        times_s: at which to look, ascending, near to each other.
        first: unit vector of phase zero.
        second: of a quarter of a turn.
        sense: 1 towards growing phases, -1 the other way.
    """
    places = track(times_s)[:3]
    angle = sense * np.unwrap(np.arctan2(second @ places, first @ places))
    begin = angle[0]
    once = int(np.argmax(angle - begin >= TURN)) + 1
    if once == 1 or np.any(np.diff(angle[:once]) <= 0.0):
        return None
    when = PchipInterpolator(angle[:once], times_s[:once])

    def state(phase: float) -> Array:
        ahead = np.mod(sense * phase - begin, TURN)
        return np.asarray(track(when(begin + ahead)))

    return Ring(state)


LONGEST, SAMPLES = 3.0, 3001
"""Revolutions of the circle in which the flown one has to come round, and looks at it."""
