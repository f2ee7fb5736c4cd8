"""Fly a plan many times: `python -m scp_recon.montecarlo DIR --samples 10000`."""

from __future__ import annotations

from scp_recon.cli.command import (
    NOT_VERIFIED,
    Answer,
    exit_on_sigint,
    parse,
    progress_console,
    run_command,
    show_line,
    show_written,
)

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from scp_recon.cli.interrupts import asked_to_stop
from scp_recon.cli.keeping import check_holds
from scp_recon.cli.options import SEED, int_between
from scp_recon.cli.view.flight_tables import show_summary
from scp_recon.cli.warnings import show_verdict, show_warnings
from scp_recon.files import check_writable, unwritable
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.checkpoint import forget_flights, keep_flights, kept_flights
from scp_recon.monte_carlo.flights import (
    SAMPLES_MAX,
    SAMPLES_MIN,
    WORKERS_MAX,
    FlightConfig,
    FlightTally,
    fly_many,
)
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import FILE_NAME
from scp_recon.monte_carlo.verdict import probability_asked, shortfalls, too_wide
from scp_recon.scp.status import Status
from scp_recon.solution.file import Solution
from scp_recon.solution.read import read_solution
from scp_recon.solution.runs import folder_of, only_run_in, resolve_run


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.montecarlo", description=__doc__)
    p.add_argument("solution", type=Path, metavar="DIR", help="folder with a solution.json")
    p.add_argument(
        "--samples",
        type=int_between(SAMPLES_MIN, SAMPLES_MAX, "20 to 1e9"),
        default=10_000,
        metavar="N",
        help="flights, at most with --until (default: 10000)",
    )
    p.add_argument(
        "--until",
        type=_width,
        metavar="P%",
        help="stop when every joint probability's interval is this narrow, e.g. 0.5%%",
    )
    p.add_argument(
        "--truth",
        choices=("planner", "harmonics"),
        default="planner",
        help="point mass with J2, or harmonics turning with the body: of body.gravity_file, or "
        "degree 8 of a packaged field (default: planner)",
    )
    p.add_argument(
        "--errors",
        choices=("componentwise", "gates"),
        help="of the burns: by component, or magnitude and pointing (default: the scenario's)",
    )
    p.add_argument(
        "--seed",
        type=SEED,
        default=0,
        metavar="S",
        help="default: 0",
    )
    where = p.add_mutually_exclusive_group()
    where.add_argument(
        "--workers",
        type=int_between(1, WORKERS_MAX),
        default=1,
        metavar="N",
        help="processes (default: 1)",
    )
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="fly on the Dask cluster of this scheduler, e.g. tcp://127.0.0.1:8786; needs [cluster]",
    )
    return p


def _width(text: str) -> float:
    try:
        width = float(text.removesuffix("%")) / 100.0
    except ValueError:
        width = 0.0
    if not text.endswith("%") or not 0.0 < width < 1.0:
        raise argparse.ArgumentTypeError(f"got {text!r}; must be a percentage such as 0.5%")
    return width


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 4 where what was asked is not met."""
    options = parse(parser(), arguments)
    return run_command(lambda console: _fly(options, console), options)


def _fly(options: argparse.Namespace, console: Console) -> Answer:
    home = resolve_run(options.solution)
    solution, folder = read_solution(home), folder_of(home)
    mission = Mission.from_scenario(solution.scenario)
    config = FlightConfig(mission, solution.burns_m_s, options.seed, options.truth, options.errors)
    check_writable(folder, FILE_NAME, "folder")
    check_holds(folder, solution, "folder")
    with asked_to_stop() as stop, only_run_in(folder, "folder"):
        begun = kept_flights(config, solution, folder)
        if begun is not None and begun.samples > options.samples:
            begun = None
        if begun is not None:
            show_line(console, f"continued after {begun.samples} flights that were stopped")
        flown = _flown(options, config, begun, stop, console)
        stopped = stop() and flown.samples < options.samples
        try:
            if stopped:
                return _kept(flown, solution, folder, console)
            summary = summarise(flown, solution)
            path = summary.write(folder)
            forget_flights(folder)
        except OSError as error:
            raise unwritable(folder, "folder", error) from None
    show_summary(console, summary, probability_asked(solution))
    show_warnings(console, [*solution.warnings, *mission.warnings])
    failed = [
        *shortfalls(summary, solution),
        *too_wide(flown.widest_interval(), options.until),
    ]
    show_verdict(console, "as asked", failed)
    show_written(console, path)
    document = {"failed": failed, "files": [str(path)], **summary.model_dump(mode="json")}
    return Answer(NOT_VERIFIED if failed else 0, document)


def _kept(flown: FlightTally, solution: Solution, folder: Path, console: Console) -> Answer:
    """Ctrl-C loses nothing."""
    path = keep_flights(flown, solution, folder)
    show_line(
        console, f"interrupted: {flown.samples} flights are kept, and the same command goes on"
    )
    show_written(console, path)
    document = {"samples": flown.samples, "files": [str(path)]}
    return Answer(Status.INTERRUPTED.value.exit_code, document)


def _flown(
    options: argparse.Namespace,
    config: FlightConfig,
    begun: FlightTally | None,
    stop: Callable[[], bool],
    console: Console,
) -> FlightTally:
    """Fly, with a bar that grows."""
    blocks = None
    if options.scheduler is not None:
        from scp_recon.campaign.engine.flights import blocks_on_cluster

        blocks = blocks_on_cluster(options.scheduler, lambda line: show_line(console, line))
    columns = ("flights", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=progress_console(console)) as bar:
        task = bar.add_task("flights", total=options.samples)
        return fly_many(
            config,
            samples=options.samples,
            until=options.until,
            workers=options.workers,
            blocks=blocks,
            progress=lambda done: bar.update(task, completed=done),
            stop=stop,
            begun=begun,
        )


if __name__ == "__main__":
    sys.exit(main())
