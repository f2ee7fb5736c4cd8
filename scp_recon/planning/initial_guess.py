"""Make initial guesses: cold start, ballistic arc, turns, bent lines, given burns, tables of states."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.display import exact
from scp_recon.errors import InputError
from scp_recon.files import read_text
from scp_recon.mission.mission import Mission
from scp_recon.physics.flow import propagate
from scp_recon.physics.forces import acceleration
from scp_recon.planning.plan import Plan

COLD_BURN_M_S = 1e-10
"""Every component of every burn: Echigo et al., section VI."""

COLUMNS = {"t": "t_s", "x": "x_m", "y": "y_m", "z": "z_m"}
COLUMNS |= {"vx": "vx_m_s", "vy": "vy_m_s", "vz": "vz_m_s"}
"""Header of a table of states, short and with units; either is accepted."""

UNITS_RATIO_MAX = 30.0
"""Kilometres are a thousand metres; trajectories of one flight differ by far less than its root."""

TURN_MAX, MOTION_OFF_MAX = 0.3, 0.5
"""Of the velocity: how much it changes between neighbours that are close enough to tell how positions
move, and how far it may be from that."""


def cold(mission: Mission) -> Iterate:
    """The cold start: the straight line from the initial to the final state, burns nearly zero."""
    way = np.outer(_fraction(mission), mission.final_state - mission.initial_state)
    burns = np.full((len(mission.burn_nodes), 3), COLD_BURN_M_S)
    return nondimensional(mission, burns, mission.initial_state + way)


def _fraction(mission: Mission) -> Array:
    """Fraction of the time from the first node to the last, shape (n,)."""
    times = mission.times_s
    return (times - times[0]) / (times[-1] - times[0])


def ballistic(mission: Mission, entry: str = "init") -> Iterate:
    """Two impulses, at the first and the last burn, joined by the arc of least total delta-v.

    A flight that is under way coasts to its first burn. Both ways round the body are tried; each is a
    boundary-value problem for point mass, J2 and sunlight, started from a circular sweep of the
    direction. A surrogate for a flown trajectory.

    Raises:
        InputError: if neither boundary-value problem can be solved, or there are not two burns.
    """
    between = "between the boundary positions; use cold"
    if len(mission.burn_nodes) < 2:
        raise InputError(entry, "warm", f"needs two burns {between}")
    arcs = [arc for way in (1.0, -1.0) if (arc := _two_impulses(mission, way))]
    if not arcs:
        raise InputError(entry, "warm", f"found no ballistic arc {between}")
    return min(arcs, key=lambda arc: arc.total_dv)


def circular(mission: Mission, way: float) -> Iterate:
    """A steady turn from the initial to the final position, burns nearly zero.

    Unlike a straight line the path never comes nearer to the body than its ends. `way` is 1 for the
    shorter way round the body, -1 for the longer: between equal directions none and a whole turn.
    """
    ends = mission.initial_state, mission.final_state
    position = _circular_positions(mission, ends, way, _fraction(mission)).T
    velocity = np.gradient(position, mission.times_s, axis=0)
    burns = np.full((len(mission.burn_nodes), 3), COLD_BURN_M_S)
    return nondimensional(mission, burns, np.hstack([position, velocity]))


def _circular_positions(
    mission: Mission, ends: tuple[Array, Array], way: float, fraction: Array
) -> Array:
    """A steady turn about the body and change of radius, shape (3, n), at fractions of it (n,)."""
    radii = [float(np.linalg.norm(state[:3])) for state in ends]
    first, last = (state[:3] / radius for state, radius in zip(ends, radii, strict=True))
    normal = way * np.cross(first, last)
    parallel = np.linalg.norm(normal) < 1e-9
    if parallel:  # any plane will do, take one with the pole
        normal = way * np.cross(first, mission.forces.pole)
    across = np.cross(normal / np.linalg.norm(normal), first)
    sweep = np.arctan2(last @ across, last @ first) % (2.0 * np.pi)
    if parallel and last @ first > 0.0:  # rounding must not choose between none and a whole turn
        sweep = np.pi * (1.0 - way)
    turned = np.outer(first, np.cos(sweep * fraction)) + np.outer(across, np.sin(sweep * fraction))
    return np.interp(fraction, [0, 1], radii) * turned


def _two_impulses(mission: Mission, way: float) -> Iterate | None:
    from scipy.integrate import solve_bvp  # what is not begun at this arc needs no integrators

    first, times = mission.burn_nodes[0], mission.times_s
    coast = [mission.problem.initial_state]
    for arc in range(first):
        coast.append(mission.flow.propagate(coast[-1], arc))
    states = np.array(coast) * mission.units.state
    start, end = states[-1], mission.final_state
    # Point mass and J2 are near enough for a guess, and far faster than all harmonics.
    duration, forces = times[-1] - times[first], mission.forces.autonomous
    mesh = np.linspace(0.0, 1.0, 41)
    position = _circular_positions(mission, (start, end), way, mesh)
    length, time = mission.units.length_m, duration
    scaled = forces.in_units(length, time)
    guess = np.vstack([position / length, np.gradient(position / length, mesh, axis=1)])

    def rate(_: Array, y: Array) -> Array:
        return np.vstack([y[3:], np.stack(acceleration(y[0], y[1], y[2], scaled))])

    def boundary(ya: Array, yb: Array) -> Array:
        return np.concatenate([ya[:3] - start[:3] / length, yb[:3] - end[:3] / length])

    solution = solve_bvp(rate, boundary, mesh, guess, tol=1e-8, max_nodes=20_000)
    if not solution.success:
        return None
    arc_states = solution.sol((times[first:] - times[first]) / duration).T
    states = np.vstack([states[:-1], arc_states * np.repeat([length, length / time], 3)])
    burns = np.zeros((len(mission.burn_nodes), 3))
    burns[0] = states[first, 3:] - start[3:]
    burns[-1] = end[3:] - states[-1, 3:]
    burns[1:-1] = COLD_BURN_M_S
    states[-1, 3:] = end[3:]
    return nondimensional(mission, burns, states)


def random(mission: Mission, seed: int) -> Iterate:
    """A random guess: the straight line bent by three random sines, and random burns.

    Amplitudes of 600 m, 300 m and 200 m and burns of 5 cm/s in every component, 1 sigma: the path may
    lead through the body, and its velocities are those of the bent line.
    """
    return bent(mission, np.random.default_rng(seed), bend_m=600.0, burn_m_s=0.05)


def bent(mission: Mission, rng: np.random.Generator, bend_m: float, burn_m_s: float) -> Iterate:
    """The straight line bent by three random sines, and random burns.

    The bend is drawn first, then the burns. Amplitudes of the first sine (m; the next have a half and
    a third of it) and of the burns (m/s) are one sigma of every component.
    """
    fraction = _fraction(mission)
    phase = np.pi * fraction[:, None] * np.arange(1, 4)
    bend = rng.normal(scale=bend_m, size=(3, 3)) / np.arange(1, 4)[:, None]
    position = mission.initial_state[:3] + np.outer(
        fraction, mission.final_state[:3] - mission.initial_state[:3]
    )
    position += np.sin(phase) @ bend
    velocity = np.gradient(position, mission.times_s, axis=0)
    velocity[-1] = mission.final_state[3:]
    burns = rng.normal(scale=burn_m_s, size=(len(mission.burn_nodes), 3))
    return nondimensional(mission, burns, np.hstack([position, velocity]))


def from_burns(mission: Mission, burns_m_s: Array, entry: str = "init") -> Iterate:
    """Roll given burns out, shape (m, 3) in m/s.

    Raises:
        InputError: if there are not as many as the scenario has firing times.
    """
    if burns_m_s.shape != (len(mission.burn_nodes), 3):
        must = f"must have {len(mission.burn_nodes)} as the scenario has to plan"
        raise InputError(entry, f"{len(burns_m_s)} burns", must)
    burns = burns_m_s / mission.units.speed_m_s
    return Iterate(burns, mission.dynamics.rollout(mission.problem.initial_state, burns))


def start_from(mission: Mission, last: Plan) -> Iterate | Plan:
    """The guess from a plan: the plan itself if SCP gave it gains, else its burns."""
    corrected = last.provenance.method == "scp" and last.final.result.lin.iterate.gains.any()
    return last if corrected else from_burns(mission, last.burns_m_s)


def nondimensional(mission: Mission, burns_m_s: Array, states: Array) -> Iterate:
    """An iterate from burns (m, 3) and states (n, 6) in SI."""
    return Iterate(burns_m_s / mission.units.speed_m_s, states / mission.units.state)


def from_table(mission: Mission, path: Path, entry: str = "init") -> Iterate:
    """A guess from a CSV of states with columns t, x, y, z, vx, vy, vz in SI, J2000, body-centred.

    Burns are the velocity defects of the planner's arcs at the firing times, the boundary's included.

    Raises:
        InputError: if the table cannot be read, is not ascending, does not cover the flight or is
            plainly not in metres and seconds.
    """
    entry = f"{entry} {path}"
    return from_states(mission, read_table(path, entry), entry)


def from_states(mission: Mission, table: Array, entry: str = "init") -> Iterate:
    """A guess from an array of t, x, y, z, vx, vy, vz, shape (n, 7), as `from_table`.

    In s, m and m/s, J2000 and body-centred. Two states at the same time are those before and after a
    burn.

    Raises:
        InputError: as `from_table`.
    """
    if table.dtype.kind not in "iuf" or table.ndim != 2 or table.shape[1] != len(COLUMNS):
        must = f"must be numbers, shape (n, 7): {', '.join(COLUMNS.values())}"
        raise InputError(entry, f"an array of shape {table.shape} and {table.dtype}", must)
    if not np.all(np.isfinite(table)):
        raise InputError(entry, "an array of numbers that are not finite", "must be finite")
    time, states = table[:, 0], table[:, 1:]
    start, end = mission.times_s[[0, -1]]
    pieces = np.split(table, np.flatnonzero(np.diff(time) == 0.0) + 1)
    if any(len(piece) < 2 for piece in pieces) or np.any(np.diff(time) < 0.0):
        must = "times must be ascending, strictly but for two states at a burn"
        raise InputError(entry, f"{len(time)} rows", must)
    if time[0] > start or time[-1] < end:
        given = f"{exact(time[0])} to {exact(time[-1])} s"
        must = f"must cover the flight, {exact(start)} to {exact(end)} s"
        raise InputError(entry, given, must)
    _check_units(mission, entry, time, states)
    nodes = _interpolated(pieces, mission.times_s)
    begin, durations = mission.times_s[:-1], np.diff(mission.times_s)
    arrivals = propagate(nodes[:-1], durations, mission.forces, mission.arc_substeps, begin)
    before = np.vstack([mission.initial_state, arrivals])[mission.burn_nodes]
    after = nodes[mission.burn_nodes]
    after[-1] = mission.final_state
    nodes[-1] = mission.final_state
    return nondimensional(mission, after[:, 3:] - before[:, 3:], nodes)


def _interpolated(pieces: Sequence[Array], times: Array) -> Array:
    """States by cubics within each piece of a table, at a burn those after it; shape (n, 6)."""
    from scipy.interpolate import CubicHermiteSpline  # only a table is interpolated

    index = np.searchsorted([piece[0, 0] for piece in pieces[1:]], times, side="right")
    states = np.empty((len(times), 6))
    for i, piece in enumerate(pieces):
        position = CubicHermiteSpline(piece[:, 0], piece[:, 1:4], piece[:, 4:])
        chosen = times[index == i]
        states[index == i] = np.hstack([position(chosen), position.derivative()(chosen)])
    return states


def _check_units(mission: Mission, entry: str, time: Array, states: Array) -> None:
    """Refuse a table whose magnitudes cannot be those of the flight in metres and seconds.

    Its distances are compared with the flight's, and its velocities with its own positions, in size
    and in direction.
    """
    distance = np.median(np.linalg.norm(states[:, :3], axis=1))
    ends = np.linalg.norm([mission.initial_state[:3], mission.final_state[:3]], axis=1)
    if not ends.min() / UNITS_RATIO_MAX <= distance <= ends.max() * UNITS_RATIO_MAX:
        must = f"must be in metres: the flight is {ends.min():.3g} to {ends.max():.3g} m from it"
        raise InputError(entry, f"positions about {distance:.3g} from the centre", must)
    took = np.diff(time)

    def lengths(vectors: Array) -> Array:
        return np.asarray(np.linalg.norm(vectors, axis=1))

    moved = (np.diff(states[:, :3], axis=0).T[:, took > 0.0] / took[took > 0.0]).T
    mean = 0.5 * (states[:-1, 3:] + states[1:, 3:])[took > 0.0]
    speed, pace = np.median(lengths(states[:, 3:])), np.median(lengths(moved))
    if not pace / UNITS_RATIO_MAX <= speed <= pace * UNITS_RATIO_MAX:
        must = f"must be in metres per second: the positions move at {pace:.3g} m/s"
        raise InputError(entry, f"velocities about {speed:.3g}", must)
    turned = np.diff(states[:, 3:], axis=0)[took > 0.0]
    close = lengths(turned) <= TURN_MAX * lengths(mean)
    if not close.any():
        return
    off, pace = np.median(lengths(moved - mean)[close]), np.median(lengths(moved)[close])
    if not off <= MOTION_OFF_MAX * pace:
        must = "must be the positions' own, along the same axes, which are inertial"
        raise InputError(entry, f"velocities {off:.3g} m/s from how the positions move", must)


def read_table(path: Path, entry: str) -> Array:
    """Read a table of states from a CSV, in the order of `COLUMNS`, shape (n, 7).

    Lines that begin with # are ignored.

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
        found = f"columns {', '.join(names)}" if names else "no known columns"
        every = ", ".join(COLUMNS.values())
        must = f"must be a solution file or a CSV of finite numbers with {every}"
        raise InputError(entry, found, must)
    return table
