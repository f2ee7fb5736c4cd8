"""What the figures are drawn from: rows of the observation-time table, as experiments left them."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import FILE_NAME as SUMMARY_FILE
from scp_recon.monte_carlo.summary import Summary, read_summary
from scp_recon.solution.evaluated import ballistic_arc
from scp_recon.solution.file import FILE_NAME as SOLUTION_FILE
from scp_recon.solution.file import Solution
from scp_recon.solution.read import read_solution
from scp_recon.solution.runs import folder_of, resolve_run

PLAN, SURROGATE, AS_FLOWN = "scp_cold", "ballistic", "as_flown"
TABLE = "observation_table.csv"
COMMAND = "python -m experiments.observation_table"
FLIGHTS = 10_000
"""Of a plan that was not flown before."""
SHOWN = 16
"""Digits of a plan's hash in messages."""


@dataclass(frozen=True)
class Flown:
    """Burns and what many flights of them showed.

    Attributes:
        label: for legends.
        solution: burns and nodes.
        mission: the solution's scenario resolved.
        summary: of the flights, which are of this very plan.
    """

    label: str
    solution: Solution
    mission: Mission
    summary: Summary


@dataclass(frozen=True)
class Runs:
    """Everything that the figures need.

    Attributes:
        plan: P2 by sequential convex programming from the cold start; or a plan of one's own.
        reference: the flight itself where its kernel was given, else the ballistic arc.
        table: the observation-time table, a dictionary per row; none of a plan of one's own.
    """

    plan: Flown
    reference: Flown
    table: list[dict[str, str]]


def read_runs(folder: Path) -> Runs:
    """Read what `experiments.observation_table` left in a folder; or a plan, and fly what is wanting.

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
    return Runs(_flown(folder, PLAN, "plan"), reference, _table(folder))


def own_plan(home: Path) -> Runs:
    """Any plan beside the ballistic arc of its mission.

    Flights that lie beside it are taken if they are of this plan; others are flown.
    """
    solution = read_solution(home)
    mission = Mission.from_scenario(solution.scenario)
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
    return summarise(fly_many(FlightConfig(mission, solution.burns_m_s), samples=FLIGHTS), solution)


def _flown(folder: Path, key: str, label: str) -> Flown:
    plan_file = _require(folder / key / SOLUTION_FILE, folder)
    summary_file = _require(folder / key / SUMMARY_FILE, folder)
    solution = read_solution(plan_file)
    try:
        summary = read_summary(summary_file)
    except InputError:
        raise _unusable(summary_file, folder) from None
    check_same_plan(
        summary.plan_hash, summary_file, solution, plan_file, f"{COMMAND} --out {folder}"
    )
    return Flown(label, solution, Mission.from_scenario(solution.scenario), summary)


def check_same_plan(
    plan_hash: str | None, file: Path, solution: Solution, plan_file: Path, command: str
) -> None:
    """Hold what was flown against the solution that stands beside it.

    Args:
        plan_hash: of the plan flown; none in files of earlier versions.
        file: of the flights.
        solution: beside it.
        plan_file: from which it was read.
        command: that flies it again.

    Raises:
        InputError: if another plan was flown, or an unknown one.
    """
    if plan_hash != solution.plan_hash:
        flown = (
            f"flights of plan {plan_hash[:SHOWN]}" if plan_hash else "flights of an unknown plan"
        )
        beside = f"the plan {solution.plan_hash[:SHOWN]} of {plan_file}"
        raise InputError(str(file), flown, f"must be of {beside}: run `{command}`")


def _table(folder: Path) -> list[dict[str, str]]:
    _require(folder / TABLE, folder)
    return read_csv(folder, TABLE, "mean_s", f"{COMMAND} --fresh")


def read_csv(folder: Path, name: str, column: str, command: str) -> list[dict[str, str]]:
    """A table that a command of `experiments` left in a folder, a dictionary per row.

    Raises:
        InputError: if the file is missing or lacks a column, naming the command that writes it.
    """
    path = _require(folder / name, folder, command)
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows or column not in rows[0]:
        raise _unusable(path, folder, command)
    return rows


def _require(path: Path, folder: Path, command: str = COMMAND) -> Path:
    if not path.is_file():
        raise InputError(str(path), "no such file", f"written by `{command} --out {folder}`")
    return path


def _unusable(path: Path, folder: Path, command: str = f"{COMMAND} --fresh") -> InputError:
    written = f"written anew by `{command} --out {folder}`"
    return InputError(str(path), "an unusable file", written)
