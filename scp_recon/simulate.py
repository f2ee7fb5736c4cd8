"""Fly a plan with the spacecraft in the loop: `python -m scp_recon.simulate SOLUTION`."""

from __future__ import annotations

from scp_recon.cli.command import (
    NOT_VERIFIED,
    Answer,
    exit_on_sigint,
    parse,
    progress_console,
    run_command,
    show_written,
)

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TimeRemainingColumn

from scp_recon.cli.keeping import check_holds
from scp_recon.cli.options import SEED
from scp_recon.cli.tables import plain_table
from scp_recon.cli.warnings import show_verdict, show_warnings
from scp_recon.files import check_writable, unwritable
from scp_recon.solution.file import Solution
from scp_recon.solution.parent import require_whole_flight
from scp_recon.solution.read import read_solution
from scp_recon.solution.runs import folder_of, only_run_in, resolve_run
from scp_recon.spacecraft.basilisk.optional import needing_basilisk
from scp_recon.spacecraft.flight import Flight
from scp_recon.spacecraft.record import FILE_NAME, make_record, write_record
from scp_recon.spacecraft.summary import Angles, FlightSummary
from scp_recon.spacecraft.vehicle import Vehicle, load_vehicle
from scp_recon.spacecraft.verdict import check_vehicle, shortfalls


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.simulate", description=__doc__)
    p.add_argument(
        "solution", type=Path, metavar="SOLUTION", help="folder with a solution.json, or the file"
    )
    p.add_argument("--seed", type=SEED, default=0, metavar="N", help="of all errors (default: 0)")
    p.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder for simulation.npz (default: the solution's)",
    )
    p.add_argument(
        "--vehicle", type=Path, metavar="FILE", help="vehicle as TOML (default: the packaged DARE)"
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0, 2 after bad input or without Basilisk, 4 if less than asked is kept."""
    options = parse(parser(), arguments)
    return run_command(lambda console: _simulate(options, console), options)


def _simulate(options: argparse.Namespace, console: Console) -> Answer:
    with needing_basilisk("python -m scp_recon.simulate"):
        import scp_recon.spacecraft.basilisk.simulation  # noqa: F401 -- whether it is there
    home = resolve_run(options.solution)
    solution, vehicle = read_solution(home), load_vehicle(options.vehicle)
    require_whole_flight(solution.scenario, "solution")
    folder = options.out or folder_of(home)
    check_writable(folder, FILE_NAME, "--out")
    check_holds(folder, solution, "--out")
    with only_run_in(folder, "--out"):
        flight = _flight(options, solution, vehicle, console)
        record = make_record(flight, solution, options.seed)
        try:
            path = write_record(record, folder)
        except OSError as error:
            raise unwritable(folder, "--out", error) from None
    show(console, record.summary)
    other = check_vehicle(vehicle, solution.scenario)
    show_warnings(console, [*solution.warnings, *flight.plan.mission.warnings, *other])
    failed = shortfalls(record.summary, solution)
    show_verdict(console, "as asked", failed)
    show_written(console, path)
    document = {"failed": failed, "files": [str(path)], "summary": record.summary.entries()}
    return Answer(NOT_VERIFIED if failed else 0, document)


def _flight(
    options: argparse.Namespace, solution: Solution, vehicle: Vehicle, console: Console
) -> Flight:
    """Fly, with a bar that grows."""
    from scp_recon.spacecraft.basilisk.simulation import simulate

    columns = ("flight", BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=progress_console(console)) as bar:
        task = bar.add_task("flight", total=solution.scenario.duration_s)
        return simulate(
            solution, vehicle, options.seed, progress=lambda time: bar.update(task, completed=time)
        )


def show(console: Console, summary: FlightSummary) -> None:
    """The figures that matter."""
    table = plain_table("mode", "from s", "for s", "at least s", "steady after s")
    for leg in summary.legs:
        mark = "" if leg.ok else " too short"
        mark += "" if leg.settled_in_time else " not steady in time"
        settled = "never" if leg.settled_s is None else f"{leg.settled_s:.0f}"
        numbers = (leg.start_s, leg.duration_s, leg.required_s)
        table.add_row(leg.mode + mark, *(f"{x:.0f}" for x in numbers), settled)
    console.print(table)
    headings = ("burn at s", "planned m/s", "executed m/s", "off at start deg", "executed deg")
    table = plain_table(*headings, names=0)
    for burn in summary.burns:
        sizes = (math.hypot(*velocity) for velocity in (burn.planned_m_s, burn.executed_m_s))
        angles = (burn.pointing_deg, burn.executed_pointing_deg)
        row = (f"{burn.t_s:.0f}", *(f"{x:.5f}" for x in sizes), *(f"{x:.3f}" for x in angles))
        table.add_row(*row)
    console.print(table)
    lines = [
        f"{name:22} {_spread(angles)} deg"
        for name, angles in (
            ("camera against command", summary.window_pointing_deg.camera),
            ("camera against site", summary.window_pointing_deg.site),
            ("estimated attitude", summary.estimate_deg),
        )
    ]
    miss = summary.terminal_miss
    lines += [
        f"least state of charge  {summary.least_charge:.3f} (floor {summary.floor_charge:.2f})",
        f"energy ledger error    {summary.ledger_error:.1e} of what is generated",
        f"momentum dumps         {summary.dumps}",
        f"final state            {miss.position_m:.1f} m and {miss.velocity_m_s:.4f} m/s "
        "from the planned mean",
        f"within 3 sigma         at {100 * summary.within_3_sigma:.1f} % of the nodes, "
        f"at most {summary.largest_sigma_distance:.2f} sigma",
    ]
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _spread(angles: Angles) -> str:
    named = angles.model_dump(by_alias=True)
    return ", ".join(f"{key} {value:.3f}" for key, value in named.items())


if __name__ == "__main__":
    sys.exit(main())
