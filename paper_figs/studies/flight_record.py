"""Shared by the figures of a simulated flight: the file they are drawn from, and its time axis."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from formulations.arrays import Array
from paper_figs.inputs import Source, check_same_plan
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
    file, written = folder / FILE_NAME, f"written by `{SOURCE.command} --out {folder}`"
    if not file.is_file():
        raise InputError(str(file), "no such file", written)
    try:
        record = read_record(file)
    except InputError:
        raise InputError(str(file), "an unusable file", written) from None
    check_beside(record, file, folder, f"{SOURCE.command} --out {folder}")
    return record


def check_beside(record: Record, file: Path, folder: Path, command: str) -> None:
    """Hold a flight against the solution in a folder, where there is one.

    Raises:
        InputError: if the solution is unusable, or another plan was flown.
    """
    plan_file = folder / SOLUTION_FILE
    if plan_file.is_file():
        check_same_plan(record.plan_hash, file, read_solution(plan_file), plan_file, command)


def bands(values: Array, times: Array, value: int) -> Iterator[tuple[float, float]]:
    """Start and length, h, of every stretch in which the samples have a value."""
    inside = np.concatenate([[False], values == value, [False]])
    edges = np.flatnonzero(inside[1:] != inside[:-1]).reshape(-1, 2)
    end = np.append(times, times[-1]) / HOUR_S
    for first, last in edges.tolist():
        yield float(end[first]), float(end[last] - end[first])


def mark_burns(axes: Axes, record: Record) -> None:
    """A line at every burn."""
    for burn in record.summary.burns:
        axes.axvline(burn.t_s / HOUR_S, color="0.3", lw=0.8, ls=":")
