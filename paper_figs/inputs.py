"""Read the figures' inputs: a plan with its flights, and tables of studies.

Every message names the command that writes what is missing, damaged or of another plan.
"""

from __future__ import annotations

from dataclasses import dataclass
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

PLAN, SURROGATE = "scp_cold", "ballistic"
PAPER = "python -m experiments observation_table"
FLIGHTS = 10_000
"""Flights of a plan that has no flights beside it."""
SHOWN = 16
"""Digits of a plan's hash in messages."""


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
        reference: the ballistic arc.
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
    plan_file, file = folder / key / SOLUTION_FILE, folder / key / SUMMARY_FILE
    for path in (plan_file, file):
        if not path.is_file():
            raise _refused(path, "no such file", PAPER)
    solution = read_solution(plan_file)
    try:
        summary = read_summary(file)
    except InputError:
        raise _refused(file, "an unusable file", PAPER) from None
    if not summary.is_of(solution):
        flown = f"flights of plan {summary.plan_hash[:SHOWN]}"
        must = f"must be of the plan {solution.plan_hash[:SHOWN]} of {plan_file}: "
        raise _refused(file, flown, PAPER, must)
    return FlownPlan(label, solution, summary)


def read_whole_flight(folder: Path) -> Solution:
    """The solution in a folder.

    Raises:
        InputError: if there is none, or it is a plan made in flight.
    """
    solution = read_solution(folder)
    require_whole_flight(solution.scenario, "solution")
    return solution


def read_tables(folder: Path, command: str, columns: dict[str, str]) -> list[pd.DataFrame]:
    """Tables of a study by name, each with a column that it must have.

    Raises:
        InputError: if a file is missing, damaged, empty or lacks its column.
    """
    found = []
    for name, column in columns.items():
        path = folder / f"{name}.csv"
        if not path.is_file():
            raise _refused(path, "no such file", command)
        try:
            table = pd.read_csv(path)
        except ValueError:
            table = pd.DataFrame()
        if column not in table or table.empty:
            raise _refused(path, "an unusable file", command)
        found.append(table)
    return found


def _refused(path: Path, given: str, command: str, must: str = "") -> InputError:
    """Error for a file, with the command that writes it anew."""
    home = path.parent.parent if command is PAPER else path.parent
    return InputError(str(path), given, f"{must}written by `{command} --out {home}`")
