"""Verify a solution again: `python -m scp_recon.verify DIR`."""

from __future__ import annotations

from scp_recon.command import NOT_VERIFIED, guarded, starting

if __name__ == "__main__":
    starting()

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from scp_recon import report
from scp_recon.mission import Mission
from scp_recon.solution import read_solution
from scp_recon.verification import verify


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if verified, else 4."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.verify", description=__doc__)
    p.add_argument(
        "solution", type=Path, metavar="DIR", help="folder with a solution.json, or the file"
    )
    options = p.parse_args(arguments)
    return guarded(lambda console: _verify(options.solution, console))


def _verify(path: Path, console: Console) -> int:
    solution = read_solution(path)
    mission = Mission.from_scenario(solution.scenario)
    report.show_solution(console, solution)
    verification = verify(mission, solution)
    report.show_verification(console, mission, verification)
    return 0 if verification.ok else NOT_VERIFIED


if __name__ == "__main__":
    sys.exit(main())
