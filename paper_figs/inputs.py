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
from scp_recon.monte_carlo.summary import FILE_NAME as SUMMARY_FILE
from scp_recon.monte_carlo.summary import Summary, read_summary, summarise
from scp_recon.results.read import read_solution
from scp_recon.results.runs import folder_of, resolve_run
from scp_recon.results.solution import FILE_NAME as SOLUTION_FILE
from scp_recon.results.solution import Solution, ballistic_arc, require_whole_flight
from scp_recon.simulation.record import FILE_NAME as FLIGHT_FILE
from scp_recon.simulation.record import Record, read_record

PLAN, SURROGATE, AS_FLOWN = "scp_cold", "ballistic", "as_flown"
TABLE = "observation_table.csv"
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
        fresh: whether the command leaves finished work alone unless it has `--fresh`.
    """

    folder: str
    command: str
    tables: Mapping[str, str] = field(default_factory=dict)
    fresh: bool = False

    def require(self, path: Path, folder: Path) -> Path:
        """Path of an existing file.

        Raises:
            InputError: if it is missing.
        """
        if not path.is_file():
            written = f"written by `{self.command} --out {folder}`"
            raise InputError(str(path), "no such file", written)
        return path

    def unusable(self, path: Path, folder: Path) -> InputError:
        """Error for a damaged file."""
        anew = f"{self.command} --fresh" if self.fresh else self.command
        written = f"written anew by `{anew} --out {folder}`"
        return InputError(str(path), "an unusable file", written)

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
                raise self.unusable(path, folder) from None
            if column not in table or table.empty:
                raise self.unusable(path, folder)
            found.append(table)
        return found

    def check_plan(self, plan_hash: str | None, file: Path, plan_file: Path, folder: Path) -> None:
        """Check that the flights in a file are of the plan in another; older files have no hash.

        Raises:
            InputError: if another plan was flown, or an unknown one.
        """
        if plan_hash != (own := read_solution(plan_file).plan_hash):
            flown = f"plan {plan_hash[:SHOWN]}" if plan_hash else "an unknown plan"
            must = f"must be of the plan {own[:SHOWN]} of {plan_file}"
            again = f"run `{self.command} --out {folder}`"
            raise InputError(str(file), f"flights of {flown}", f"{must}: {again}")


PAPER = Source("paper", "python -m experiments observation_table", {TABLE: "mean_s"}, fresh=True)
SIMULATED = Source("simulation", "python -m scp_recon simulate SOLUTION")
TORQUES = ("thruster_torque_n_m", "wheel_torque_n_m")
"""Arrays of a simulated flight that older files lack."""
FLOWN_PLAN = Source(
    "flown_plan",
    "python -m experiments flown_plan SOLUTION",
    {"flown_plan.csv": "seed"},
    fresh=True,
)


@dataclass(frozen=True)
class FlownPlan:
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
        table: the observation-time table; None for the user's own plan.
    """

    plan: FlownPlan
    reference: FlownPlan
    table: pd.DataFrame | None


def read_runs(folder: Path) -> Runs:
    """Read results of `experiments observation_table`, or a plan; fly missing flights of a plan.

    Raises:
        InputError: if a file is missing or unusable.
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
    return Runs(_flown(folder, PLAN, "plan"), reference, *PAPER.read(folder))


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
    plan = FlownPlan("plan", solution, solution.mission, summary)
    return Runs(plan, FlownPlan("ballistic arc", arc, solution.mission, _fly(arc)), None)


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
        raise PAPER.unusable(file, folder) from None
    PAPER.check_plan(summary.plan_hash, file, plan_file, folder)
    return FlownPlan(label, solution, solution.mission, summary)


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
        written = f"must be of one; written anew by `{FLOWN_PLAN.command} --fresh --out {folder}`"
        raise InputError(str(folder), "flights of different plans", written)
    return records


def _read_flight(source: Source, file: Path, folder: Path) -> Record:
    source.require(file, folder)
    try:
        record = read_record(file)
    except InputError:
        raise source.unusable(file, folder) from None
    if not record.arrays.keys() >= {*TORQUES}:
        raise source.unusable(file, folder)
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
    lines = [] if own or (runs / TABLE).exists() else [(PAPER.command, runs)]
    commands = {source.folder: source.command for source in wanted}
    lines += [
        (line, studies / name) for name, line in commands.items() if not (studies / name).is_dir()
    ]
    for line, out in lines:
        words = [str(plan) if word == SOLUTION else word for word in line.split()]
        tell(" ".join([*words, "--out", str(out)]))
        status = run([sys.executable, *words[1:], "--out", str(out)])
        if status == EMPTY_HANDED:
            tell(f"exit status {status}: left out")
