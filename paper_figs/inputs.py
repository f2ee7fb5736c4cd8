"""Read the figures' inputs: a plan with its flights, and tables of studies; run missing studies."""

from __future__ import annotations

import csv
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from formulations.arrays import Array
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.summary import FILE_NAME as SUMMARY_FILE
from scp_recon.monte_carlo.summary import Summary, read_summary, summarise
from scp_recon.results.read import read_solution
from scp_recon.results.runs import folder_of, resolve_run
from scp_recon.results.solution import FILE_NAME as SOLUTION_FILE
from scp_recon.results.solution import Solution, ballistic_arc

PLAN, SURROGATE, AS_FLOWN = "scp_cold", "ballistic", "as_flown"
TABLE = "observation_table.csv"
COMMAND = "python -m experiments observation_table"
FLIGHTS = 10_000
"""Of a plan that was not flown before."""
SHOWN = 16
"""Digits of a plan's hash in messages."""

SOLUTION = "SOLUTION"
"""In a study's command, what stands for the plan."""
EMPTY_HANDED = 2
"""Exit status of a command that could not begin."""

Row = dict[str, str]
"""Of a table, as it stands in the file."""
Tables = Sequence[list[Row]]
"""Of a study, in its source's order."""


def numbers(rows: Iterable[Row], column: str) -> Array:
    """A column's figures, shape (rows,)."""
    return np.array([float(row[column]) for row in rows])


@dataclass(frozen=True)
class Source:
    """Files that a command writes for a figure.

    Attributes:
        folder: name of its folder among those of the studies.
        command: command that writes it.
        tables: its CSV files by name, each with a column that it must have.
    """

    folder: str
    command: str
    tables: Mapping[str, str] = field(default_factory=dict)

    def read(self, place: Path) -> list[list[Row]]:
        """All tables in a folder, a dictionary for each row.

        Raises:
            InputError: if a file is missing or lacks its column, naming the command that writes it.
        """
        found = []
        for name, column in self.tables.items():
            path = require(place / name, place, self.command)
            with path.open(encoding="utf-8", newline="") as file:
                rows = list(csv.DictReader(file))
            if not rows or column not in rows[0]:
                raise unusable(path, place, self.command)
            found.append(rows)
        return found

    def rows(self, place: Path) -> list[Row]:
        """Rows of the first table; see `read`."""
        return self.read(place)[0]


@dataclass(frozen=True)
class Flown:
    """A plan with its name for legends, its mission, and the summary of its flights."""

    label: str
    solution: Solution
    mission: Mission
    summary: Summary


@dataclass(frozen=True)
class Runs:
    """Inputs of the paper's figures.

    Attributes:
        plan: P2 by sequential convex programming from the cold start; or the user's own plan.
        reference: the real flight if its kernel was given, else the ballistic arc.
        table: the observation-time table, a dictionary per row; empty for the user's own plan.
    """

    plan: Flown
    reference: Flown
    table: list[Row]


def read_runs(folder: Path) -> Runs:
    """Read results of `experiments observation_table`, or a plan; fly missing flights of a plan.

    Raises:
        InputError: if a file is missing or unusable, naming the command that writes it.
    """
    home = resolve_run(folder)
    if home.is_file() or (home / SOLUTION_FILE).exists():
        return own_plan(home)
    flown = (folder / AS_FLOWN / SOLUTION_FILE).exists()
    reference = (
        _flown(folder, AS_FLOWN, "OSIRIS-REx as flown")
        if flown
        else _flown(folder, SURROGATE, "OSIRIS-REx surrogate (ballistic arc)")
    )
    require(folder / TABLE, folder)
    table = Source("paper", f"{COMMAND} --fresh", {TABLE: "mean_s"}).rows(folder)
    return Runs(_flown(folder, PLAN, "plan"), reference, table)


def own_plan(home: Path) -> Runs:
    """Inputs from any plan, with the ballistic arc of its mission as reference.

    Its flights are read if they lie beside it and are of this plan; else they are flown.
    """
    solution = read_solution(home)
    mission = solution.mission
    file = folder_of(home) / SUMMARY_FILE
    summary = read_summary(file) if file.is_file() else None
    if summary is None or not summary.is_of(solution):
        summary = _fly(mission, solution)
    arc = ballistic_arc(mission)
    return Runs(
        Flown("plan", solution, mission, summary),
        Flown("ballistic arc", arc, mission, _fly(mission, arc)),
        [],
    )


def _fly(mission: Mission, solution: Solution) -> Summary:
    config = FlightConfig(mission, solution.burns_m_s, policy=solution.corrections)
    return summarise(fly_many(config, samples=FLIGHTS), solution)


def _flown(folder: Path, key: str, label: str) -> Flown:
    plan_file = require(folder / key / SOLUTION_FILE, folder)
    summary_file = require(folder / key / SUMMARY_FILE, folder)
    solution = read_solution(plan_file)
    try:
        summary = read_summary(summary_file)
    except InputError:
        raise unusable(summary_file, folder) from None
    check_same_plan(
        summary.plan_hash, summary_file, solution, plan_file, f"{COMMAND} --out {folder}"
    )
    return Flown(label, solution, solution.mission, summary)


def check_same_plan(
    plan_hash: str | None, file: Path, solution: Solution, plan_file: Path, command: str
) -> None:
    """Check that the plan flown is that of the solution beside the flights' file.

    Files of earlier versions have no hash; `command` flies the plan again.

    Raises:
        InputError: if another plan was flown, or an unknown one.
    """
    if plan_hash != solution.plan_hash:
        flown = (
            f"flights of plan {plan_hash[:SHOWN]}" if plan_hash else "flights of an unknown plan"
        )
        beside = f"the plan {solution.plan_hash[:SHOWN]} of {plan_file}"
        raise InputError(str(file), flown, f"must be of {beside}: run `{command}`")


def require(path: Path, folder: Path, command: str = COMMAND) -> Path:
    """Path of an existing file.

    Raises:
        InputError: if it is missing, naming the command that writes it.
    """
    if not path.is_file():
        raise InputError(str(path), "no such file", f"written by `{command} --out {folder}`")
    return path


def unusable(path: Path, folder: Path, command: str = f"{COMMAND} --fresh") -> InputError:
    """Error for a damaged file, naming the command that writes it anew."""
    written = f"written anew by `{command} --out {folder}`"
    return InputError(str(path), "an unusable file", written)


def run_missing(
    runs: Path,
    studies: Path,
    wanted: Iterable[Source],
    tell: Callable[[str], None],
    run: Callable[[list[str]], int] = lambda words: subprocess.run(words, check=False).returncode,
) -> None:
    """Run the studies without results; one that lacks an extra is reported and skipped.

    `runs` is the folder of the observation-time table, or a plan; `studies` has the studies' folders.
    """
    own = runs.is_file() or (runs / SOLUTION_FILE).exists()
    plan = runs if own else runs / PLAN
    lines = [] if own or (runs / TABLE).exists() else [(COMMAND, runs)]
    places = {source.folder: source.command for source in wanted}
    lines += [
        (line, studies / name) for name, line in places.items() if not (studies / name).is_dir()
    ]
    for line, out in lines:
        words = [str(plan) if word == SOLUTION else word for word in line.split()]
        tell(" ".join([*words, "--out", str(out)]))
        status = run([sys.executable, *words[1:], "--out", str(out)])
        if status == EMPTY_HANDED:
            tell(f"exit status {status}: left out")
