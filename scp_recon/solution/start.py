"""Where planning starts: a name, a file of a plan or of states, or states themselves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from formulations.problem.flyby import Iterate
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.solution.file import read_solution

Array = npt.NDArray[np.float64]


def start_from(mission: Mission, init: str | Path | Array) -> Iterate:
    """The initial guess that a name, a file or a table of states stands for.

    Args:
        mission: gives the grid and the boundary.
        init: "cold", a straight line; "warm", a ballistic arc; a solution file or its folder, or a CSV
            of states; or states as an array t, x, y, z, vx, vy, vz, J2000, SI, shape (n, 7).

    Raises:
        InputError: if the file or the table is unusable.
    """
    if isinstance(init, np.ndarray):
        return initial_guess.from_states(mission, init)
    if init == "cold":
        return initial_guess.cold(mission)
    if init == "warm":
        return initial_guess.ballistic(mission)
    path = Path(init)
    if is_solution(path):
        return initial_guess.from_burns(mission, read_solution(path).burns_m_s)
    return initial_guess.from_table(mission, path)


def is_solution(path: Path) -> bool:
    """A folder, or a file of JSON under whatever name: a table never begins with a brace."""
    try:
        if path.is_dir() or path.suffix == ".json":
            return True
        if not path.is_file():  # a pipe can be read only once
            return False
        with path.open("rb") as file:
            return file.read(100).lstrip().startswith(b"{")
    except (OSError, ValueError):  # which the reader explains
        return False
