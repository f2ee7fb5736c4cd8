"""The command `replan`: plan the rest of a flight from a delivered state, covariance and burns."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
from rich.console import Console

from formulations.arrays import Array
from scp_recon.api.keeping import point_latest, run_folder
from scp_recon.api.planning import checked, finite_figures
from scp_recon.api.replans import left_options, plan_left
from scp_recon.cli.command import Answer
from scp_recon.cli.commands.planning import Shown
from scp_recon.errors import InputError, option
from scp_recon.files import read_text
from scp_recon.replanning.delivery import Delivery
from scp_recon.replanning.flown import FlownPlan
from scp_recon.replanning.remainder import mission_left
from scp_recon.results.read import read_solution
from scp_recon.results.runs import folder_of, resolve_run

BYTES_MAX = 100_000
"""Of a file of 36 numbers with whatever is said of them."""


def replan(options: argparse.Namespace, console: Console) -> Answer:
    """Plan, show and write."""
    home = resolve_run(options.plan)
    if options.out is not None and options.out.resolve() == folder_of(home).resolve():
        given = f"{options.out}, which holds the plan in flight"
        raise InputError(option("out"), given, "must be a folder of its own")
    solution = read_solution(home)
    delivery = delivery_from(options, solution.scenario.epoch.tdb)
    flown = FlownPlan.of(solution, name=str(home))
    mission = mission_left(flown, delivery, options.overrides)
    left_options(flown, mission, certify=options.certify)  # refuses what cannot be, at once
    with run_folder(options.out, mission.scenario.name) as folder:
        shown = Shown(console, folder)
        with shown.planning(mission) as observe, finite_figures():
            plan = plan_left(flown, mission, certify=options.certify, observe=observe)
        answer = shown.answer(checked(plan, folder, shown))
    point_latest(options.out, folder, answer.status)
    return answer


def delivery_from(options: argparse.Namespace, epoch: datetime) -> Delivery:
    """Make a delivery from the options.

    Args:
        options: parsed.
        epoch: of the plan that is flown, TDB.

    Raises:
        InputError: if a number, a date or a file is not valid.
    """
    covariance = None
    if options.covariance is not None:
        rows = _rows(options.covariance, "--covariance")
        if [len(row) for row in rows] != 6 * [6]:
            sizes = " and ".join(sorted({str(len(row)) for row in rows})) or "no"
            raise InputError(
                f"--covariance {options.covariance}",
                f"{len(rows)} rows of {sizes} numbers",
                "must be six rows of six numbers, m and m/s",
            )
        covariance = np.array(rows)
    return Delivery.of(
        at_s=_time(options.at_s, epoch),
        state=_state(options.state),
        frame=options.frame,
        covariance=covariance,
        covariance_frame=options.covariance_frame,
        measured=_burns(options.measured_burns),
    )


def _time(text: str, epoch: datetime) -> float:
    try:
        return float(text)
    except ValueError:
        pass
    try:
        date = datetime.fromisoformat(text)
    except ValueError:
        date = None
    if date is None or date.tzinfo is not None:
        allowed = (
            "must be seconds past the plan's epoch, or a date in TDB such as 2020-01-22T01:16:37"
        )
        raise InputError("--at", repr(text)[:80], allowed)
    return (date - epoch).total_seconds()


def _state(text: str) -> Array:
    """Numbers, or a file of them."""
    try:
        given = _numbers(text)
    except ValueError:
        given = [number for row in _rows(Path(text), "--state") for number in row]
    if len(given) != 6:
        raise InputError(
            "--state", f"{len(given)} numbers", "must be six, m and m/s, or their file"
        )
    return np.array(given)


def _burns(texts: Sequence[str]) -> dict[int, Array]:
    """Burns by their number, each once."""
    found: dict[int, Array] = {}
    for text in texts:
        number, burn = _burn(text)
        if number in found:
            raise InputError("--measured-burn", f"burn {number} twice", "must be given once")
        found[number] = burn
    return found


def _burn(text: str) -> tuple[int, Array]:
    number, separator, burn = text.partition("=")
    try:
        if not (separator and number.strip().isdecimal()):
            raise ValueError
        given = _numbers(burn)
        if len(given) != 3:
            raise ValueError
    except ValueError:
        allowed = "must read N=X,Y,Z: the burn's number and three numbers in m/s"
        raise InputError("--measured-burn", repr(text)[:80], allowed) from None
    return int(number), np.array(given)


def _rows(path: Path, entry: str) -> list[list[float]]:
    """Numbers of a file, line by line; text after a # is ignored."""
    text = read_text(path, f"{entry} {path}", "file of numbers", BYTES_MAX)
    lines = [line.partition("#")[0] for line in text.splitlines()]
    try:
        return [_numbers(line) for line in lines if line.strip()]
    except ValueError as error:
        raise InputError(f"{entry} {path}", str(error)[:80], "must be a file of numbers") from None


def _numbers(text: str) -> list[float]:
    return [float(part) for part in text.replace(",", " ").split()]
