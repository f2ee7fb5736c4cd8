"""Give the home orbit's state by phase: a circle, a revolution under forces, or an ephemeris.

An ephemeris is a table of states, a CCSDS OEM or SPICE kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from formulations.arrays import Array
from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.bodies.kernels import read_states
from scp_recon.display import digits, exact
from scp_recon.errors import InputError
from scp_recon.interop.ccsds import oem_track, plain_name
from scp_recon.interop.tracks import csv_track
from scp_recon.mission.firing import TURN, Ring
from scp_recon.physics.forces import ForceModel, acceleration
from scp_recon.scenario.body import HomeOrbit
from scp_recon.scenario.fields import unit_hint
from scp_recon.scenario.schema import Scenario

LONGEST, SAMPLES = 3.0, 3001
"""Revolutions of the circle within which the flown one must close, and samples of it."""
ENTRY = "boundary.home.ephemeris_file"
LONG, STATES = 1.25, 2001
"""Circle's revolutions that are read from kernels, and states."""
APART = np.deg2rad(15.0)
"""Angle between neighbouring states, at most: cubics err by less than 2e-5 of the radius there."""
WITHIN = 2.0
"""Largest factor between the ephemeris's distances and radius_m."""
LOOKS = 8
"""Between neighbouring states."""


def home_ring(home: HomeOrbit, gm: float, axes: Array) -> Ring:
    """A scenario's circular home orbit by phase; axes (3, 3) rotate from boundary.frame to J2000."""
    # A state is a turn of those at phase zero and a quarter turn later.
    first, ahead = (np.kron(np.eye(2), axes) @ home.state(at, gm) for at in (0.0, 0.25 * TURN))
    return lambda phase_rad: np.cos(phase_rad) * first + np.sin(phase_rad) * ahead


def angles(home: HomeOrbit, axes: Array, places: Array) -> Array:
    """Phases in the sense of flight, unwrapped, rad, shape (n,), of positions (3, n) along a track."""
    first, second = (axes @ home.state(phase, 1.0)[:3] for phase in (0.0, 0.25 * TURN))
    return _sense(home) * np.unwrap(np.arctan2(second @ places, first @ places))


def _sense(home: HomeOrbit) -> float:
    """1 towards growing phases, -1 the other way."""
    return 1.0 if home.sense == "right_handed" else -1.0


def flown_ring(home: HomeOrbit, forces: ForceModel, axes: Array) -> Ring:
    """One revolution under a mission's forces, from the circle's state at phase zero on.

    Forces that depend on time are left out, as the spacecraft may leave at any time. Phases are
    angles about the circle's normal; the ends of the revolution meet only approximately. Axes (3, 3)
    rotate from boundary.frame to J2000.

    Raises:
        InputError: if the orbit does not close within three periods of the circle.
    """
    start = home_ring(home, forces.gm, axes)(0.0)
    period, forces = TURN * np.sqrt(home.radius_m**3 / forces.gm), forces.autonomous

    def rate(_: float, y: Array) -> Array:
        return np.array([*y[3:], *acceleration(y[0], y[1], y[2], forces)])

    flown = solve_ivp(
        rate, (0.0, LONGEST * period), start, "DOP853", dense_output=True, rtol=1e-10, atol=1e-6
    )
    track = flown.sol
    assert track is not None  # of a dense output
    times, last = np.linspace(0.0, LONGEST * period, SAMPLES), float(flown.t[-1])
    ring = ring_of(track, times[times <= last], home, axes)
    if ring is None:
        must = f"must come round under the mission's forces within {LONGEST:g} of its revolutions"
        raise InputError("boundary.home.flown", f"a circle of {exact(home.radius_m)} m", must)
    return ring


def ring_of(
    track: Callable[[Array], Array], times_s: Array, home: HomeOrbit, axes: Array
) -> Ring | None:
    """The first revolution of a track, if the track keeps the orbit's sense of rotation.

    Args:
        track: states (6, n) at times (n,), or (6,) at one time.
        times_s: ascending times at which to sample it, close to each other.
        home: the orbit.
        axes: shape (3, 3), from boundary.frame to J2000.
    """
    angle = angles(home, axes, track(times_s)[:3])
    begin, sense = angle[0], _sense(home)
    once = int(np.argmax(angle - begin >= TURN)) + 1
    if once == 1 or np.any(np.diff(angle[:once]) <= 0.0):
        return None
    when = PchipInterpolator(angle[:once], times_s[:once])

    def state(phase_rad: float) -> Array:
        ahead = np.mod(sense * phase_rad - begin, TURN)
        return np.asarray(track(when(begin + ahead)))

    return state


def ephemeris_ring(scenario: Scenario, home: HomeOrbit, axes: Array) -> Ring:
    """The first revolution of an ephemeris; axes (3, 3) rotate from boundary.frame to J2000.

    Raises:
        InputError: if the file cannot be read, is of another frame or centre, has no whole revolution
            without a burn, or does not follow the scenario's circle.
    """
    path = Path(home.ephemeris_file or "")
    times, states = _states(scenario, home, path)
    distances = np.linalg.norm(states[:, :3], axis=1)
    low, high = float(distances.min()), float(distances.max())
    if not home.radius_m / WITHIN <= low <= high <= home.radius_m * WITHIN:
        unit, metres = ("m", 1.0) if path.suffix.lower() == ".csv" else ("km", 1e3)
        ends = home.radius_m / WITHIN / metres, home.radius_m * WITHIN / metres
        given = f"{digits(low / metres)} to {digits(high / metres)} {unit} from the centre"
        near = f"within a factor of {WITHIN:g} of boundary.home.radius_m, {digits(home.radius_m)} m"
        hint = unit_hint(unit, low / metres, *ends)
        raise InputError(ENTRY, f"{path.name}, {given}", f"must be {near}{hint}")
    angle = angles(home, axes, states[:, :3].T)
    turned, steps = angle - angle[0], np.diff(angle)
    once = int(np.argmax(turned >= TURN)) + 1 if np.any(turned >= TURN) else 0
    ring = None
    if once and np.all(np.diff(times[:once]) > 0.0) and steps[: once - 1].max() <= APART:
        place = CubicHermiteSpline(times[:once], states[:once, :3], states[:once, 3:])
        fine_s = np.interp(np.arange(LOOKS * (once - 1) + 1) / LOOKS, np.arange(once), times[:once])
        ring = ring_of(lambda t: np.r_[place(t).T, place(t, 1).T], fine_s, home, axes)
    if ring is None:
        about = "about boundary.home.normal the way that boundary.home.sense says"
        given = f"{np.rad2deg(turned[-1]):.0f} deg {about}, in {len(times)} states"
        step = f"at most {np.rad2deg(APART):g} deg between states"
        must = f"must go round once without a burn, by {step}"
        raise InputError(ENTRY, f"{path.name}, {given}", must)
    return ring


def _states(scenario: Scenario, home: HomeOrbit, path: Path) -> tuple[Array, Array]:
    """Times in s past some epoch, and states, J2000, m and m/s, of a file."""
    body, kind = scenario.body, path.suffix.lower()
    if kind in (".csv", ".oem"):
        if home.spacecraft_id is not None:
            must = f"must be left out: {path.name} is no kernel"
            raise InputError("boundary.home.spacecraft_id", str(home.spacecraft_id), must)
        try:
            if kind == ".csv":
                track = csv_track(path, scenario.epoch.tdb)
            else:
                track = oem_track(path, plain_name(body.name))
        except InputError as error:
            raise InputError(ENTRY, f"{path.name}, {error.given}", error.allowed) from None
        return track.times_s, track.states
    if home.spacecraft_id is None or body.naif_id is None:
        lacking = "boundary.home.spacecraft_id" if home.spacecraft_id is None else "body.naif_id"
        raise InputError(lacking, "nothing", f"must be given for kernels, as {path.name} is")
    begin = (scenario.epoch.tdb - J2000_TDB).total_seconds()
    times = np.linspace(0.0, LONG * TURN * float(np.sqrt(home.radius_m**3 / body.gm_m3_s2)), STATES)
    return times, read_states([path], home.spacecraft_id, body.naif_id, begin + times, ENTRY)
