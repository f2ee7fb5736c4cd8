"""Verify a solution again: `python -m scp_recon.verify DIR`."""

from __future__ import annotations

from scp_recon.cli.command import NOT_VERIFIED, Answer, exit_on_sigint, parse, run_command

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from scp_recon.cli.documents import plan_document
from scp_recon.cli.view import plan_tables
from scp_recon.mission.mission import Mission
from scp_recon.solution.read import read_solution
from scp_recon.verification.reintegration import verify


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if verified, else 4."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.verify", description=__doc__)
    p.add_argument(
        "solution", type=Path, metavar="DIR", help="folder with a solution.json, or the file"
    )
    options = parse(p, arguments)
    return run_command(lambda console: _verify(options.solution, console), options)


def _verify(path: Path, console: Console) -> Answer:
    solution = read_solution(path)
    mission = Mission.from_scenario(solution.scenario)
    plan_tables.show_mission(console, mission)
    plan_tables.show_solution(console, solution)
    verification = verify(mission, solution)
    plan_tables.show_verification(
        console, mission, verification, [*solution.warnings, *mission.warnings]
    )
    checked = solution.model_copy(update={"verification": verification})
    return Answer(0 if verification.ok else NOT_VERIFIED, plan_document(checked))


if __name__ == "__main__":
    sys.exit(main())
