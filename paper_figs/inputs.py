"""Read the figures' inputs: a plan with its flights, and tables of studies.

Every message names the command that writes what is missing, damaged or of another plan.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from scp_recon.errors import InputError
from scp_recon.monte_carlo.flights import fly_many
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import FILE_NAME as SUMMARY_FILE
from scp_recon.monte_carlo.summary import Summary, read_summary
from scp_recon.results.read import folder_of, read_solution, resolve_run
from scp_recon.results.solution import FILE_NAME as SOLUTION_FILE
from scp_recon.results.solution import Solution, ballistic_arc

PLAN, SURROGATE = "scp_cold", "ballistic"
PAPER = "python -m experiments observation_table"
FLIGHTS = 10_000
"""Flights of a plan that has no flights beside it."""
SHOWN = 16
"""Digits of a plan's hash in messages."""


class FlownPlan(NamedTuple):
    """A plan with its name for legends, and the summary of its flights."""

    label: str
    solution: Solution
    summary: Summary


class Runs(NamedTuple):
    """Inputs of the paper's figures: P2 from the cold start, or the user's plan; the ballistic arc."""

    plan: FlownPlan
    reference: FlownPlan


def read_runs(folder: Path) -> Runs:
    """Read results of `experiments observation_table`, or a plan; fly missing flights of a plan.

    The reference of a plan is the ballistic arc of its mission.

    Raises:
        InputError: if a file is missing or unusable.
    """
    home = resolve_run(folder)
    if not (home.is_file() or (home / SOLUTION_FILE).exists()):
        reference = _flown(folder, SURROGATE, "OSIRIS-REx surrogate\n(ballistic arc)")
        return Runs(_flown(folder, PLAN, "plan"), reference)
    solution, file = read_solution(home), folder_of(home) / SUMMARY_FILE
    summary = read_summary(file) if file.is_file() else None
    if summary is None or not summary.is_of(solution):
        summary = _fly(solution)
    arc = ballistic_arc(solution.mission)
    return Runs(FlownPlan("plan", solution, summary), FlownPlan("ballistic arc", arc, _fly(arc)))


def _fly(solution: Solution) -> Summary:
    config = Flyer(solution.mission, solution.burns_m_s, policy=solution.corrections)
    return summarise(fly_many(config, samples=FLIGHTS), solution)


def _flown(folder: Path, key: str, label: str) -> FlownPlan:
    plan_file, file = folder / key / SOLUTION_FILE, folder / key / SUMMARY_FILE
    for path in (plan_file, file):
        if not path.is_file():
            raise _refused(path, "no such file", PAPER, folder)
    solution = read_solution(plan_file)
    try:
        summary = read_summary(file)
    except InputError:
        raise _refused(file, "an unusable file", PAPER, folder) from None
    if not summary.is_of(solution):
        flown = f"flights of plan {summary.plan_hash[:SHOWN]}"
        must = f"must be of the plan {solution.plan_hash[:SHOWN]} of {plan_file}: "
        raise _refused(file, flown, PAPER, folder, must)
    return FlownPlan(label, solution, summary)


def read_tables(folder: Path, command: str, columns: Mapping[str, str]) -> list[pd.DataFrame]:
    """Tables of a study by name, each with a column that it must have.

    Raises:
        InputError: if a file is missing, damaged, empty or lacks its column.
    """
    found = []
    for name, column in columns.items():
        path = folder / f"{name}.csv"
        if not path.is_file():
            raise _refused(path, "no such file", command, folder)
        try:
            table = pd.read_csv(path)
        except ValueError:
            table = pd.DataFrame()
        if column not in table or table.empty:
            raise _refused(path, "an unusable file", command, folder)
        found.append(table)
    return found


def _refused(path: Path, given: str, command: str, out: Path, must: str = "") -> InputError:
    """Error for a file, with the command that writes it anew."""
    return InputError(str(path), given, f"{must}written by `{command} --out {out}`")
