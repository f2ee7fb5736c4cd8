"""Plan what is left of a flight: `python -m scp_recon.replan DIR --at T --state ...`."""

from __future__ import annotations

from scp_recon.cli.command import Answer, exit_on_sigint, parse, run_command

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from scp_recon.cli.delivery import add_delivery, delivery_from, joined
from scp_recon.cli.keeping import point_latest, run_folder
from scp_recon.cli.options import add_certify, add_overrides, named_folder
from scp_recon.errors import InputError
from scp_recon.in_flight.parent import FlownPlan
from scp_recon.in_flight.replanning import mission_left, replan
from scp_recon.monte_carlo.certifying import flights_needed
from scp_recon.solution.read import read_solution
from scp_recon.solution.runs import resolve_run
from scp_recon.solve import plan_into


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.replan", description=__doc__)
    p.add_argument(
        "solution",
        type=Path,
        metavar="DIR",
        help="folder with the solution.json that is flown, or the file",
    )
    add_delivery(p)
    add_overrides(p, " for what is left, e.g. schedule.decision_lead_s=900")
    add_certify(p)
    p.add_argument(
        "--out",
        type=named_folder,
        metavar="DIR",
        help="folder for solution.json (default: runs/NAME/UTC with the scenario's name, to which "
        "runs/latest then points); a verified plan there gives way to a verified one only",
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = parse(parser(), joined(sys.argv[1:] if arguments is None else arguments))
    return run_command(lambda console: _replan(options, console), options)


def _replan(options: argparse.Namespace, console: Console) -> Answer:
    home = resolve_run(options.solution)
    solution = read_solution(home)
    delivery = delivery_from(options, solution.scenario.epoch.tdb)
    flown = FlownPlan.of(solution, name=str(home))
    mission = mission_left(flown, delivery, options.overrides)
    exact = mission.scenario.risk.allocation == "exact" and flown.problem == "P2"
    if options.certify is not None and not exact:
        raise InputError("--certify", options.certify, "goes with risk.allocation = exact only")
    certified = exact and options.certify != "no"
    if certified:
        flights_needed(mission.scenario.risk.p_chance)
    with run_folder(options.out, mission.scenario.name) as folder:
        answer = plan_into(
            folder,
            mission,
            lambda seen: replan(
                flown, mission, certified=certified, observe=seen, watch=seen.round
            ),
            console,
        )
    point_latest(options.out, folder, answer.status)
    return answer


if __name__ == "__main__":
    sys.exit(main())
