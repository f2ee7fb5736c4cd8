"""A table of states as an initial guess, and as a CSV file."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicHermiteSpline

from formulations.problem.flyby import Iterate
from scp_recon.errors import InputError
from scp_recon.files import read_text
from scp_recon.mission.mission import Mission
from scp_recon.physics.flow import propagate
from scp_recon.planning.initial_guess import nondimensional

Array = npt.NDArray[np.float64]

COLUMNS = {
    "t": "t_s",
    "x": "x_m",
    "y": "y_m",
    "z": "z_m",
    "vx": "vx_m_s",
    "vy": "vy_m_s",
    "vz": "vz_m_s",
}
"""Header of a table of states, short and with units; either is accepted."""

UNITS_RATIO_MAX = 30.0
"""Kilometres are a thousand metres; trajectories of one flight differ by far less than its root."""
TURN_MAX, MOTION_OFF_MAX = 0.3, 0.5
"""Of the velocity: how much it changes between neighbours that are close enough to tell how positions
move, and how far it may be from that."""


def from_table(mission: Mission, path: Path, entry: str = "init") -> Iterate:
    """A table of states: CSV with columns t, x, y, z, vx, vy, vz in SI, J2000, body-centred.

    Burns are what the planner's arcs miss at the firing times, those of the boundary included.

    Raises:
        InputError: if the table cannot be read, is not ascending, does not cover the flight or is
            plainly not in metres and seconds.
    """
    entry = f"{entry} {path}"
    return from_states(mission, read_table(path, entry), entry)


def from_states(mission: Mission, table: Array, entry: str = "init") -> Iterate:
    """A table of times and states as an array, t, x, y, z, vx, vy, vz: as `from_table`.

    Args:
        mission: gives the grid.
        table: s, m and m/s, J2000 and body-centred, shape (n, 7). Two states at the same time are those
            before and after a burn.
        entry: what messages call it.

    Raises:
        InputError: as `from_table`.
    """
    if table.dtype.kind not in "iuf" or table.ndim != 2 or table.shape[1] != len(COLUMNS):
        raise InputError(
            entry,
            f"an array of shape {table.shape} and {table.dtype}",
            f"must be numbers, shape (n, 7): {', '.join(COLUMNS.values())}",
        )
    if not np.all(np.isfinite(table)):
        raise InputError(entry, "an array of numbers that are not finite", "must be finite")
    time, states = table[:, 0], table[:, 1:]
    start, end = mission.times_s[[0, -1]]
    pieces = np.split(table, np.flatnonzero(np.diff(time) == 0.0) + 1)
    if any(len(piece) < 2 for piece in pieces) or np.any(np.diff(time) < 0.0):
        raise InputError(
            entry,
            f"{len(time)} rows",
            "times must be ascending, strictly but for two states at a burn",
        )
    if time[0] > start or time[-1] < end:
        raise InputError(
            entry,
            f"{time[0]:g} to {time[-1]:g} s",
            f"must cover the flight, {start:g} to {end:g} s",
        )
    _check_units(mission, entry, time, states)
    nodes = _interpolated(pieces, mission.times_s)
    durations = np.diff(mission.times_s)
    arrivals = propagate(nodes[:-1], durations, mission.forces, mission.arc_substeps)
    before = np.vstack([mission.initial_state, arrivals])[mission.burn_nodes]
    after = nodes[mission.burn_nodes]
    after[-1] = mission.final_state
    nodes[-1] = mission.final_state
    return nondimensional(mission, after[:, 3:] - before[:, 3:], nodes)


def _interpolated(pieces: Sequence[Array], times: Array) -> Array:
    """States by cubics within each piece of a table, at a burn those after it; shape (n, 6)."""
    index = np.searchsorted([piece[0, 0] for piece in pieces[1:]], times, side="right")
    states = np.empty((len(times), 6))
    for i, piece in enumerate(pieces):
        position = CubicHermiteSpline(piece[:, 0], piece[:, 1:4], piece[:, 4:])
        chosen = times[index == i]
        states[index == i] = np.hstack([position(chosen), position.derivative()(chosen)])
    return states


def _check_units(mission: Mission, entry: str, time: Array, states: Array) -> None:
    """Refuse a table whose magnitudes cannot be those of the flight in metres and seconds.

    Its distances are held against the flight's, and its velocities against its own positions, in
    size and in direction.
    """
    distance = np.median(np.linalg.norm(states[:, :3], axis=1))
    ends = np.linalg.norm([mission.initial_state[:3], mission.final_state[:3]], axis=1)
    if not ends.min() / UNITS_RATIO_MAX <= distance <= ends.max() * UNITS_RATIO_MAX:
        raise InputError(
            entry,
            f"positions about {distance:.3g} from the centre",
            f"must be in metres: the flight is {ends.min():.3g} to {ends.max():.3g} m from it",
        )
    took = np.diff(time)
    moved = (np.diff(states[:, :3], axis=0).T[:, took > 0.0] / took[took > 0.0]).T
    mean = 0.5 * (states[:-1, 3:] + states[1:, 3:])[took > 0.0]
    speed, path_speed = np.median(_lengths(states[:, 3:])), np.median(_lengths(moved))
    if not path_speed / UNITS_RATIO_MAX <= speed <= path_speed * UNITS_RATIO_MAX:
        raise InputError(
            entry,
            f"velocities about {speed:.3g}",
            f"must be in metres per second: the positions move at {path_speed:.3g} m/s",
        )
    turned = np.diff(states[:, 3:], axis=0)[took > 0.0]
    close = _lengths(turned) <= TURN_MAX * _lengths(mean)
    off, pace = _lengths(moved - mean)[close], _lengths(moved)[close]
    if close.any() and not np.median(off) <= MOTION_OFF_MAX * np.median(pace):
        raise InputError(
            entry,
            f"velocities {np.median(off):.3g} m/s from how the positions move",
            "must be the positions' own, along the same axes, which are inertial",
        )


def _lengths(vectors: Array) -> Array:
    """Of vectors of shape (n, 3)."""
    return np.asarray(np.linalg.norm(vectors, axis=1))


def read_table(path: Path, entry: str) -> Array:
    """A table of states as it stands in its file, in the order of `COLUMNS`, shape (n, 7).

    Args:
        path: of a CSV; lines that begin with # are passed over.
        entry: what messages call it.

    Raises:
        InputError: if it cannot be read, or is no table of finite numbers with these columns.
    """
    text = read_text(path, entry, "file")
    try:
        lines = [line for line in text.splitlines() if not line.startswith("#")]
        reader = csv.DictReader(lines)
        given = list(reader.fieldnames or [])
        names = [name for pair in COLUMNS.items() for name in pair if name in given]
        missing = [long for short, long in COLUMNS.items() if (short in given) == (long in given)]
        table = np.array([[float(row[name]) for name in names] for row in reader])
    except (ValueError, TypeError, csv.Error) as error:
        raise InputError(entry, str(error), "must be a table of numbers") from None
    if missing or not len(table) or not np.all(np.isfinite(table)):
        raise InputError(
            entry,
            f"columns {', '.join(names) or 'none that is known'}",
            f"must be a solution file or a CSV of finite numbers with {', '.join(COLUMNS.values())}",
        )
    return table
