"""What each source of uncertainty does to the flight: `python -m experiments.uncertainty_sources`.

Every source of the vehicle's errors alone and all together. Those that act on the path directly are
flown in the planner's dynamics, many times; those that act by way of the attitude, and all of them, in
the simulation of the whole spacecraft (extra [sim]), a few times each. How far flights end from the
one without errors goes to OUT/uncertainty_sources.csv and .md, with a verdict on planning the path
without the attitude, and their quantiles to uncertainty_quantiles.csv. Simulated flights are taken up
again.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint, parse

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from experiments.observation_table.rows import rows
from experiments.studies import add_out, run, to_csv
from experiments.uncertainty_sources.flights import (
    NO_ERRORS,
    SETS,
    TRANSLATION,
    Logbook,
    fly_all,
)
from experiments.uncertainty_sources.report import (
    ORDER,
    measure_flights,
    measure_paths,
    quantiles,
    record,
    sigmas,
    to_markdown,
    verdicts,
)
from scp_recon.cli.options import int_between
from scp_recon.files import write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.scenario.load import load_scenario
from scp_recon.solution.file import Solution
from scp_recon.solution.read import read_solution
from scp_recon.spacecraft.vehicle import load_vehicle

NAME = "uncertainty_sources"
QUANTILES = "uncertainty_quantiles.csv"
DEFAULT_OUT = Path("runs") / NAME
PATHS, FLIGHTS = 10_000, 8


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog=f"python -m experiments.{NAME}", description=__doc__)
    add_out(p, DEFAULT_OUT)
    p.add_argument(
        "--paths",
        type=int_between(20, 10_000_000),
        default=PATHS,
        metavar="N",
        help=f"flights in the planner's dynamics for each set of sources (default: {PATHS})",
    )
    p.add_argument(
        "--flights",
        type=int_between(0, 100_000),
        default=FLIGHTS,
        metavar="N",
        help=f"simulated flights for each set, about a minute each; 0 for none (default: {FLIGHTS})",
    )
    p.add_argument(
        "--workers", type=int_between(1, 256), default=1, metavar="N", help="processes (default: 1)"
    )
    p.add_argument(
        "--seed", type=int_between(0, 2**32 - 1), default=0, metavar="N", help="of all errors"
    )
    p.add_argument(
        "--solution",
        type=Path,
        metavar="DIR",
        help="plan to fly (default: the default scenario's from a cold start)",
    )
    p.add_argument(
        "--vehicle", type=Path, metavar="FILE", help="vehicle file (default: the packaged DARE)"
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if everything was written, 2 for bad input."""
    return run(_run, parse(parser(), arguments))


def _run(options: argparse.Namespace) -> int:
    vehicle, solution = load_vehicle(options.vehicle), _plan(options.solution)
    # Seed by seed, so that an interrupted study has as many flights of every set.
    jobs = [
        (error_sources, options.seed + k)
        for k in range(options.flights)
        for error_sources in SETS
        if error_sources not in TRANSLATION and (error_sources != NO_ERRORS or k == 0)
    ]
    columns = (TextColumn("flights"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=len(jobs))
        flown = fly_all(
            Logbook(options.out, solution, vehicle),
            solution,
            vehicle,
            jobs,
            workers=options.workers,
            tell=lambda: progress.advance(task),
        )
    found = measure_flights(flown, solution)
    found |= measure_paths(solution, vehicle, options.paths, options.seed)
    entries = [found[error_sources] for error_sources in ORDER if error_sources in found]
    words = sigmas(vehicle.errors)
    files = {
        f"{NAME}.csv": to_csv([record(entry, words[entry.error_sources]) for entry in entries]),
        f"{NAME}.md": to_markdown(entries, words, solution),
        QUANTILES: to_csv(quantiles(entries)),
    }
    options.out.mkdir(parents=True, exist_ok=True)
    written = [write_atomically(options.out / name, text) for name, text in files.items()]
    for line in verdicts(entries, solution):
        print(line)
    for path in written:
        print(f"written: {path}")
    return 0


def _plan(folder: Path | None) -> Solution:
    if folder is not None:
        return read_solution(folder)
    design = next(row.design for row in rows(ipopt=False) if row.key == "scp_cold")
    return design(Mission.from_scenario(load_scenario()))


if __name__ == "__main__":
    sys.exit(main())
