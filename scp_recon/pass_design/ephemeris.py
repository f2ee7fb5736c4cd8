"""The home orbit as one revolution of an ephemeris: a table of states, a CCSDS OEM, SPICE kernels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicHermiteSpline

from scp_recon.environment.kernels import read_states
from scp_recon.errors import InputError
from scp_recon.exchange.ccsds import plain_name
from scp_recon.exchange.tracks import csv_track, oem_track
from scp_recon.pass_design.ring import TURN, Ring, directions, ring_of
from scp_recon.physics.frames import J2000_TDB
from scp_recon.scenario.home import HomeOrbit
from scp_recon.scenario.schema import Scenario

Array = npt.NDArray[np.float64]

ENTRY = "boundary.home.ephemeris_file"
LONG, STATES = 1.25, 2001
"""Circle's revolutions that are read from kernels, and states."""
APART = np.deg2rad(15.0)
"""Angle between neighbouring states, at most: cubics err by less than 2e-5 of the radius there."""
WITHIN = 2.0
"""Factor of the radius that is said."""
LOOKS = 8
"""Between neighbouring states."""


def ephemeris_ring(scenario: Scenario, home: HomeOrbit, axes: Array) -> Ring:
    """The first revolution of a file.

    Args:
        scenario: of body and epoch.
        home: with a file.
        axes: from boundary.frame to J2000, shape (3, 3).

    Raises:
        InputError: if the file cannot be read, is of another frame or centre, has no whole revolution
            without a burn, or does not go about the circle that is said.
    """
    path = Path(home.ephemeris_file or "")
    times, states = _states(scenario, home, path)
    distances = np.linalg.norm(states[:, :3], axis=1)
    low, high = float(distances.min()), float(distances.max())
    if not home.radius_m / WITHIN <= low <= high <= home.radius_m * WITHIN:
        raise InputError(
            "boundary.home.radius_m",
            f"{home.radius_m:g} m",
            f"must be within a factor of {WITHIN:g} of {low:.4g} to {high:.4g} m in {path.name}",
        )
    first, second, sense = directions(home, axes)
    angle = sense * np.unwrap(np.arctan2(second @ states[:, :3].T, first @ states[:, :3].T))
    turned, steps = angle - angle[0], np.diff(angle)
    once = int(np.argmax(turned >= TURN)) + 1 if np.any(turned >= TURN) else 0
    ring = None
    if once and np.all(np.diff(times[:once]) > 0.0) and steps[: once - 1].max() <= APART:
        track = Track(times[:once], states[:once])
        looks = np.interp(np.arange(LOOKS * (once - 1) + 1) / LOOKS, np.arange(once), times[:once])
        ring = ring_of(track, looks, first, second, sense)
    if ring is None:
        raise InputError(
            ENTRY,
            f"{path.name}, {np.rad2deg(turned[-1]):.0f} deg about boundary.home.normal the way that "
            f"boundary.home.sense says, in {len(times)} states",
            f"must go round once without a burn, by at most {np.rad2deg(APART):g} deg between states",
        )
    return ring


class Track:
    """Cubics between states whose velocities are their slopes.

    Args:
        times_s: ascending, shape (n,).
        states: shape (n, 6).
    """

    def __init__(self, times_s: Array, states: Array) -> None:
        self._place = CubicHermiteSpline(times_s, states[:, :3], states[:, 3:])
        self._speed = self._place.derivative()

    def __call__(self, time_s: Array) -> Array:
        """States (6, n) at times (n,), or one."""
        return np.concatenate([self._place(time_s).T, self._speed(time_s).T])


def _states(scenario: Scenario, home: HomeOrbit, path: Path) -> tuple[Array, Array]:
    """Times in s past any epoch, and states in J2000, m and m/s."""
    body, kind = scenario.body, path.suffix.lower()
    if kind in (".csv", ".oem"):
        if home.spacecraft_id is not None:
            raise InputError(
                "boundary.home.spacecraft_id",
                str(home.spacecraft_id),
                f"must be left out: {path.name} is no kernel",
            )
        try:
            track = (
                csv_track(path, scenario.epoch.tdb)
                if kind == ".csv"
                else oem_track(path, plain_name(body.name))
            )
        except InputError as error:
            raise InputError(ENTRY, f"{path.name}, {error.given}", error.allowed) from None
        return track.times_s, track.states
    if home.spacecraft_id is None or body.naif_id is None:
        lacking = "boundary.home.spacecraft_id" if home.spacecraft_id is None else "body.naif_id"
        raise InputError(lacking, "nothing", f"must be given for kernels, as {path.name} is")
    begin = (scenario.epoch.tdb - J2000_TDB).total_seconds()
    times = np.linspace(0.0, LONG * TURN * float(np.sqrt(home.radius_m**3 / body.gm_m3_s2)), STATES)
    return times, read_states([path], home.spacecraft_id, body.naif_id, begin + times, ENTRY)
