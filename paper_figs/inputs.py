"""Read the figures' inputs: a plan with its flights, a simulated flight, tables of studies.

Every message names the command that writes what is missing, damaged or of another plan.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import FILE_NAME as SUMMARY_FILE
from scp_recon.monte_carlo.summary import Summary, read_summary
from scp_recon.results.read import read_solution
from scp_recon.results.runs import folder_of, resolve_run
from scp_recon.results.solution import FILE_NAME as SOLUTION_FILE
from scp_recon.results.solution import Solution, ballistic_arc, require_whole_flight
from scp_recon.simulation.record import FILE_NAME as FLIGHT_FILE
from scp_recon.simulation.record import Record, read_record

PLAN, SURROGATE, AS_FLOWN = "scp_cold", "ballistic", "as_flown"
FLIGHTS = 10_000
"""Flights of a plan that has no flights beside it."""
SHOWN = 16
"""Digits of a plan's hash in messages."""
SOLUTION = "SOLUTION"
"""Placeholder of the plan in a study's command."""
EMPTY_HANDED = 2
"""Exit status of a command that could not begin."""


@dataclass(frozen=True)
class Source:
    """Files that a command writes for a figure.

    Attributes:
        folder: name of its folder among those of the studies.
        command: command that writes it, without its --out.
        tables: its CSV files by name, each with a column that it must have.
    """

    folder: str
    command: str
    tables: Mapping[str, str] = field(default_factory=dict)

    def refused(self, path: Path, given: str, folder: Path, must: str = "") -> InputError:
        """Error for a file, with the command that writes it anew."""
        written = f"{must}written by `{self.command} --out {folder}`"
        return InputError(str(path), given, written)

    def require(self, path: Path, folder: Path) -> Path:
        """Path of an existing file.

        Raises:
            InputError: if it is missing.
        """
        if not path.is_file():
            raise self.refused(path, "no such file", folder)
        return path

    def read(self, folder: Path) -> list[pd.DataFrame]:
        """All tables in a folder.

        Raises:
            InputError: if a file is missing, damaged, empty or lacks its column.
        """
        found = []
        for name, column in self.tables.items():
            path = self.require(folder / name, folder)
            try:
                table = pd.read_csv(path)
            except ValueError:
                table = pd.DataFrame()
            if column not in table or table.empty:
                raise self.refused(path, "an unusable file", folder)
            found.append(table)
        return found

    def check_plan(self, plan_hash: str, file: Path, plan_file: Path, folder: Path) -> None:
        """Check that the flights in a file are of the plan in another.

        Raises:
            InputError: if another plan was flown.
        """
        if plan_hash != (own := read_solution(plan_file).plan_hash):
            flown = f"flights of plan {plan_hash[:SHOWN]}"
            must = f"must be of the plan {own[:SHOWN]} of {plan_file}: "
            raise self.refused(file, flown, folder, must)


PAPER = Source("paper", "python -m experiments observation_table")
SIMULATED = Source("simulation", "python -m scp_recon simulate SOLUTION")
FLOWN_PLAN = Source(
    "flown_plan",
    "python -m experiments flown_plan SOLUTION --fresh",
    {"flown_plan.csv": "seed"},
)


@dataclass(frozen=True)
class FlownPlan:
    """A plan with its name for legends, and the summary of its flights."""

    label: str
    solution: Solution
    summary: Summary

    @property
    def mission(self) -> Mission:
        """The plan's mission."""
        return self.solution.mission


@dataclass(frozen=True)
class Runs:
    """Inputs of the paper's figures.

    Attributes:
        plan: P2 by sequential convex programming from the cold start; or the user's own plan.
        reference: the real flight if its kernel was given, else the ballistic arc.
    """

    plan: FlownPlan
    reference: FlownPlan

    @property
    def plan_hash(self) -> str:
        """Hash of the plan."""
        return self.plan.solution.plan_hash


def read_runs(folder: Path) -> Runs:
    """Read results of `experiments observation_table`, or a plan; fly missing flights of a plan.

    Raises:
        InputError: if a file is missing or unusable.
    """
    home = resolve_run(folder)
    if home.is_file() or (home / SOLUTION_FILE).exists():
        return own_plan(home)
    if (folder / AS_FLOWN / SOLUTION_FILE).exists():
        reference = _flown(folder, AS_FLOWN, "OSIRIS-REx as flown")
    else:
        reference = _flown(folder, SURROGATE, "OSIRIS-REx surrogate (ballistic arc)")
    return Runs(_flown(folder, PLAN, "plan"), reference)


def own_plan(home: Path) -> Runs:
    """Inputs from any plan, with the ballistic arc of its mission as reference.

    Its flights are read if they lie beside it and are of this plan; else they are flown.
    """
    solution = read_solution(home)
    file = folder_of(home) / SUMMARY_FILE
    summary = read_summary(file) if file.is_file() else None
    if summary is None or not summary.is_of(solution):
        summary = _fly(solution)
    arc = ballistic_arc(solution.mission)
    return Runs(FlownPlan("plan", solution, summary), FlownPlan("ballistic arc", arc, _fly(arc)))


def _fly(solution: Solution) -> Summary:
    config = FlightConfig(solution.mission, solution.burns_m_s, policy=solution.corrections)
    return summarise(fly_many(config, samples=FLIGHTS), solution)


def _flown(folder: Path, key: str, label: str) -> FlownPlan:
    plan_file = PAPER.require(folder / key / SOLUTION_FILE, folder)
    file = PAPER.require(folder / key / SUMMARY_FILE, folder)
    solution = read_solution(plan_file)
    try:
        summary = read_summary(file)
    except InputError:
        raise PAPER.refused(file, "an unusable file", folder) from None
    PAPER.check_plan(summary.plan_hash, file, plan_file, folder)
    return FlownPlan(label, solution, summary)


def read_whole_flight(folder: Path) -> Solution:
    """The solution in a folder.

    Raises:
        InputError: if there is none, or it is a plan made in flight.
    """
    solution = read_solution(folder)
    require_whole_flight(solution.scenario, "solution")
    return solution


def read_flight(folder: Path) -> Record:
    """The simulated flight in a folder.

    Raises:
        InputError: if its file is missing or unusable, or of another plan than a solution beside it.
    """
    return _read_flight(SIMULATED, folder / FLIGHT_FILE, folder)


def read_flights(folder: Path) -> list[Record]:
    """The flights of the study `flown_plan`, those that its table names.

    Raises:
        InputError: if a file is missing or unusable, or flights are of different plans or of
            another than a solution beside them.
    """
    (table,) = FLOWN_PLAN.read(folder)
    files = [folder / f"seed_{seed}" / FLIGHT_FILE for seed in table.seed]
    records = [_read_flight(FLOWN_PLAN, file, folder) for file in files]
    if len({record.plan_hash for record in records}) > 1:
        raise FLOWN_PLAN.refused(folder, "flights of different plans", folder, "must be of one: ")
    return records


def _read_flight(source: Source, file: Path, folder: Path) -> Record:
    source.require(file, folder)
    try:
        record = read_record(file)
    except InputError:
        raise source.refused(file, "an unusable file", folder) from None
    plan_file = folder / SOLUTION_FILE
    if plan_file.is_file():
        source.check_plan(record.plan_hash, file, plan_file, folder)
    return record


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
    lines = {} if own or plan.exists() else {runs: PAPER.command}
    folders = {studies / source.folder: source.command for source in wanted}
    lines |= {folder: command for folder, command in folders.items() if not folder.is_dir()}
    for out, line in lines.items():
        words = [str(plan) if word == SOLUTION else word for word in line.split()]
        tell(" ".join([*words, "--out", str(out)]))
        status = run([sys.executable, *words[1:], "--out", str(out)])
        if status == EMPTY_HANDED:
            tell(f"exit status {status}: left out")
