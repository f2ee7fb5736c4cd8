"""Read the record of a simulated flight for figures, and mark its time axis."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from formulations.arrays import Array
from paper_figs.inputs import Source, check_same_plan, require, unusable
from scp_recon.errors import InputError
from scp_recon.results.pictures import HOUR_S
from scp_recon.results.read import read_solution
from scp_recon.results.solution import FILE_NAME as SOLUTION_FILE
from scp_recon.simulation.record import FILE_NAME, Record, read_record

SOURCE = Source("simulation", "python -m scp_recon simulate SOLUTION")


def read(folder: Path) -> Record:
    """Read the simulation file in a folder.

    Raises:
        InputError: if it is missing or unusable, or of another plan than a solution beside it,
            naming the command that writes it.
    """
    return read_flight(folder / FILE_NAME, folder, SOURCE.command, SOURCE.command)


def read_flight(file: Path, folder: Path, command: str, anew: str) -> Record:
    """Read a flight in a folder, and compare it with the solution there, if any.

    `command` writes a missing file, `anew` a damaged one.

    Raises:
        InputError: if a file is missing or unusable, or another plan was flown.
    """
    require(file, folder, command)
    try:
        record = read_record(file)
    except InputError:
        raise unusable(file, folder, anew) from None
    plan_file = folder / SOLUTION_FILE
    if plan_file.is_file():
        again = f"{command} --out {folder}"
        check_same_plan(record.plan_hash, file, read_solution(plan_file), plan_file, again)
    return record


def bands(values: Array, times: Array, value: int) -> Iterator[tuple[float, float]]:
    """Start and length, h, of every interval in which the samples equal a value."""
    inside = np.concatenate([[False], values == value, [False]])
    edges = np.flatnonzero(inside[1:] != inside[:-1]).reshape(-1, 2)
    end = np.append(times, times[-1]) / HOUR_S
    for first, last in edges.tolist():
        yield float(end[first]), float(end[last] - end[first])


def mark_burns(axes: Axes, record: Record) -> None:
    """Draw a line at every burn that is not zero."""
    for burn in (one for one in record.summary.burns if any(one.planned_m_s)):
        axes.axvline(burn.t_s / HOUR_S, color="0.3", lw=0.8, ls=":")
