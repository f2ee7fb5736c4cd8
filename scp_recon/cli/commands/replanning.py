"""The command `replan`: what is left of a flight, from a state, a covariance and burns as delivered."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
from rich.console import Console

from formulations.arrays import Array
from scp_recon.api.keeping import point_latest, run_folder
from scp_recon.api.replans import left_options, plan_left
from scp_recon.cli.command import (
    Answer,
    Command,
)
from scp_recon.cli.commands.planning import plan_into
from scp_recon.cli.options import (
    add_certify,
    add_out,
    add_overrides,
    add_plan,
)
from scp_recon.errors import InputError
from scp_recon.files import read_text
from scp_recon.replanning.delivery import FRAMES, Delivery
from scp_recon.replanning.flown import FlownPlan
from scp_recon.replanning.remainder import mission_left
from scp_recon.results.read import read_solution
from scp_recon.results.runs import resolve_run

BYTES_MAX = 100_000
"""Of a file of 36 numbers with whatever is said of them."""
LISTS = {"--state": 6, "--measured-burn": 3}
"""Options whose value is so many numbers, which may be negative and stand apart."""


def _add_replan(p: argparse.ArgumentParser) -> None:
    add_plan(p)
    add_delivery(p)
    add_overrides(p, " for what is left, e.g. schedule.decision_lead_s=900")
    add_certify(p)
    add_out(p)


def _replan(options: argparse.Namespace, console: Console) -> Answer:
    home = resolve_run(options.plan)
    solution = read_solution(home)
    delivery = delivery_from(options, solution.scenario.epoch.tdb)
    flown = FlownPlan.of(solution, name=str(home))
    mission = mission_left(flown, delivery, options.overrides)
    left_options(flown, mission, certify=options.certify)  # refuses what cannot be, at once
    with run_folder(options.out, mission.scenario.name) as folder:
        answer = plan_into(
            folder,
            mission,
            lambda seen: plan_left(flown, mission, certify=options.certify, observe=seen),
            console,
        )
    point_latest(options.out, folder, answer.status)
    return answer


def add_delivery(p: argparse.ArgumentParser) -> None:
    """Time, state, covariance and burns as they were."""
    p.add_argument(
        "--at",
        dest="at_s",
        required=True,
        metavar="T",
        help="time of the state: s past the plan's epoch, or a date in TDB; burns until then are flown",
    )
    p.add_argument(
        "--state",
        required=True,
        metavar="STATE",
        help="x y z in m and vx vy vz in m/s at that time, after burns flown, or a file of these six",
    )
    p.add_argument(
        "--frame",
        default="j2000",
        metavar="NAME",
        help=f"axes of state and measured burns: {', '.join(FRAMES)}, at the epoch (default: j2000)",
    )
    p.add_argument(
        "--covariance",
        type=Path,
        metavar="FILE",
        help="six rows of six numbers, m and m/s (default: the scenario's initial covariance)",
    )
    p.add_argument(
        "--covariance-frame",
        metavar="NAME",
        help=f"its axes: {', '.join(FRAMES)}, rtn (default: that of --frame)",
    )
    p.add_argument(
        "--measured-burn",
        dest="measured_burns",
        action="append",
        default=[],
        metavar="N=X,Y,Z",
        help="a flown burn as telemetry saw it, m/s, by its number in the flight; may be repeated",
    )


def joined(arguments: Sequence[str]) -> list[str]:
    """Arguments in which each list of numbers is one: a leading minus makes no option of it.

    A list takes numbers alone, and no more than it is to have: what follows is of another argument.
    """
    found: list[str] = []
    for argument in arguments:
        name, separator, value = found[-1].partition("=") if found else ("", "", "")
        if name in LISTS and _goes_on(name, value if separator else None, argument):
            found[-1] += f" {argument}" if separator else f"={argument}"
        else:
            found.append(argument)
    return found


def _goes_on(name: str, value: str | None, argument: str) -> bool:
    """Whether an argument belongs to a list's value so far, None before it has begun."""
    more = _count(argument)
    if value is None:
        return more is not None or not argument.startswith("-")
    so_far = _count(value.partition("=")[2] if name == "--measured-burn" else value)
    return so_far is not None and more is not None and so_far + more <= LISTS[name]


def _count(text: str) -> int | None:
    """How many numbers a text is; None if it is anything else."""
    try:
        return len(_numbers(text))
    except ValueError:
        return None


def delivery_from(options: argparse.Namespace, epoch: datetime) -> Delivery:
    """What the options say.

    Args:
        options: parsed.
        epoch: of the plan that is flown, TDB.

    Raises:
        InputError: if a number, a date or a file is none.
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
    """Numbers of a file, line by line; what stands behind a # is passed over."""
    text = read_text(path, f"{entry} {path}", "file of numbers", BYTES_MAX)
    lines = [line.partition("#")[0] for line in text.splitlines()]
    try:
        return [_numbers(line) for line in lines if line.strip()]
    except ValueError as error:
        raise InputError(f"{entry} {path}", str(error)[:80], "must be a file of numbers") from None


def _numbers(text: str) -> list[float]:
    return [float(part) for part in text.replace(",", " ").split()]


replan = Command("replan", "Plan what is left of a flight.", _add_replan, _replan, joined)
