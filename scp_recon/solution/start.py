"""Where planning starts: a name, a plan or its file, or states and their file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from formulations.problem.flyby import Iterate
from scp_recon.errors import InputError, shortened
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess, state_table
from scp_recon.planning.plan import Plan
from scp_recon.solution.read import read_solution
from scp_recon.solution.runs import resolve_run

Array = npt.NDArray[np.float64]


def start_from(mission: Mission, init: Plan | str | Path | Array, entry: str = "init") -> Iterate:
    """The initial guess that a name, a plan, a file or a table of states stands for.

    Args:
        mission: gives the grid and the boundary.
        init: "cold", a straight line; "warm", a ballistic arc; a plan, a solution file or its folder,
            whose burns are flown; a CSV of states, or these as an array t, x, y, z, vx, vy, vz, J2000,
            SI, shape (n, 7).
        entry: what messages call it.

    Raises:
        InputError: if it is none of these, or the file or the table is unusable.
    """
    if isinstance(init, np.ndarray):
        return state_table.from_states(mission, init, entry)
    if isinstance(init, Plan):
        return initial_guess.from_burns(mission, init.burns_m_s, entry)
    if not isinstance(init, str | Path):
        allowed = "must be cold, warm, a file, a plan or an array of shape (n, 7)"
        raise InputError(entry, shortened(init), allowed)
    if init == "cold":
        return initial_guess.cold(mission)
    if init == "warm":
        return initial_guess.ballistic(mission, entry)
    path = Path(init)
    if is_solution(path):
        return initial_guess.from_burns(mission, read_solution(path).burns_m_s, entry)
    return state_table.from_table(mission, path, entry)


def is_solution(path: Path) -> bool:
    """A folder, or a file of JSON under whatever name: a table never begins with a brace."""
    path = resolve_run(path)
    try:
        if path.is_dir() or path.suffix == ".json":
            return True
        if not path.is_file():  # a pipe can be read only once
            return False
        with path.open("rb") as file:
            return file.read(100).lstrip().startswith(b"{")
    except (OSError, ValueError):  # which the reader explains
        return False
