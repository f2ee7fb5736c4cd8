"""The flight itself: states from the user's SPK, impulses that follow them, and a start from them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from formulations.problem.flyby import Iterate
from scp_recon.errors import InputError
from scp_recon.files import write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.physics.frames import J2000_TDB
from scp_recon.planning import state_table

Array = npt.NDArray[np.float64]

OSIRIS_REX_ID, BENNU_ID = -64, 2101955
"""NAIF codes in the kernels of the mission."""


def as_flown_burns(mission: Mission, kernel: Path, table: Path) -> tuple[Array, float]:
    """Impulses at the firing times that follow the kernel, and how closely.

    The states at the nodes are written to `table`, a CSV that `--init` takes as well. Burns as
    `state_table.from_table` reads them off the table would miss what was fired away from the
    scenario's firing times, and the flight's forces are not quite the planner's; so all but the last
    burn are fitted to the positions by least squares. The last one meets the final velocity.

    Returns:
        Burns in m/s, shape (m, 3), and the largest distance from the kernel in the window, m.

    Raises:
        InputError: if spiceypy is missing, or the kernel does not cover the flight.
    """
    states = read_states(mission, kernel)
    start = _tabulated(mission, states, table)
    scale = mission.units.length_m
    target = states[:-1, :3] / scale

    def flight(free: Array) -> Array:
        """Node states with the free burns and no last one."""
        burns = np.vstack([free.reshape(-1, 3), np.zeros(3)])
        return mission.dynamics.rollout(mission.problem.initial_state, burns)

    def miss(free: Array) -> Array:
        return (flight(free)[:-1, :3] - target).ravel()

    free = least_squares(miss, start.burns[:-1].ravel(), x_scale="jac", method="lm").x
    flown = flight(free)
    last = mission.problem.final_state[3:] - flown[-1, 3:]
    window = mission.window_nodes
    off = np.linalg.norm(flown[window, :3] - target[window], axis=1) * scale
    burns = np.vstack([free.reshape(-1, 3), last]) * mission.units.speed_m_s
    return burns, float(off.max())


def flown_guess(kernel: Path, table: Path, mission: Mission) -> Iterate:
    """The flight as an initial guess: the paper's warm start.

    It is the one that `--init` makes of `table`, which is written.

    Raises:
        InputError: if spiceypy is missing, or the kernel does not cover the flight.
    """
    return _tabulated(mission, read_states(mission, kernel), table)


def _tabulated(mission: Mission, states: Array, table: Path) -> Iterate:
    _write_table(table, mission.times_s, states)
    return state_table.from_table(mission, table)


def read_states(mission: Mission, kernel: Path) -> Array:
    """States of OSIRIS-REx about Bennu at the mission's nodes, J2000, m and m/s, shape (n, 6).

    Raises:
        InputError: if spiceypy is missing, or the kernel does not cover the flight.
    """
    spice = _spiceypy()
    epoch = (mission.scenario.epoch.tdb - J2000_TDB).total_seconds()
    try:
        spice.furnsh(str(kernel))
    except spice.SpiceyError as error:
        raise _unusable(kernel, error, "must be a readable SPK or meta-kernel") from None
    try:
        states = [
            spice.spkgeo(OSIRIS_REX_ID, epoch + time, "J2000", BENNU_ID)[0]
            for time in mission.times_s.tolist()
        ]
    except spice.SpiceyError as error:
        allowed = (
            f"must give {OSIRIS_REX_ID} about {BENNU_ID} from {mission.scenario.epoch.tdb} TDB "
            f"for {mission.times_s[-1]:g} s"
        )
        raise _unusable(kernel, error, allowed) from None
    finally:
        spice.unload(str(kernel))
    return 1000.0 * np.array(states)


def _spiceypy() -> Any:
    try:
        import spiceypy
    except ImportError:
        raise InputError(
            "--as-flown", "no spiceypy to read it with", "needs the extra [spice]"
        ) from None
    return spiceypy


def _unusable(kernel: Path, error: Exception, allowed: str) -> InputError:
    """SPICE's short message, without its traceback."""
    short = getattr(error, "short", "") or str(error).strip().splitlines()[0]
    return InputError(f"--as-flown {kernel}", short, allowed)


def _write_table(path: Path, times_s: Array, states: Array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [",".join(state_table.COLUMNS.values())]
    lines += [
        ",".join(repr(float(x)) for x in (time, *state))
        for time, state in zip(times_s, states, strict=True)
    ]
    write_atomically(path, "\n".join(lines) + "\n")
