"""The commands that fly a plan: `montecarlo` many times with errors, `simulate` the spacecraft once."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from scp_recon.cli.command import (
    NOT_VERIFIED,
    Answer,
    Command,
    asked_to_stop,
    progress_console,
    show_line,
    show_written,
)
from scp_recon.cli.options import Option, PlanFile, Scheduler, Vehicle, width

if TYPE_CHECKING:
    from rich.console import Console

Policy = Literal["open", "replan", "feedback"] | None


@Command
def montecarlo(
    console: "Console",
    plan: PlanFile,
    *,
    samples: int = 10_000,
    seed: int = 0,
    until: Annotated[float | None, Option("P%", read=width)] = None,
    truth: Literal["planner", "harmonics", "polyhedron"] = "planner",
    errors: Literal["componentwise", "gates"] | None = None,
    policy: Policy = None,
    workers: int | None = None,
    scheduler: Scheduler = None,
) -> Answer:
    """Fly a plan many times with errors.

    Args:
        samples: flights, at most with `until`.
        seed: of all draws.
        until: stop when every joint probability's interval is this narrow, e.g. 0.5%.
        truth: gravity of the planner; or, turning with the body, all harmonics of body.gravity_file or
            degree 8 of a packaged field, or a homogeneous polyhedron, of body.solid_file or the
            ellipsoid body.radii_m.
        errors: of the burns: componentwise, or gates, by magnitude and pointing (default: the
            scenario's).
        policy: what burns are commanded: open, those planned; replan, planned again before each from
            what is estimated; feedback, corrected by the plan's gains (default: feedback of a plan with
            gains, else open).
        workers: processes; the result does not depend on their number (default: 1).
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    from scp_recon.api import flights
    from scp_recon.api.files import open_plan
    from scp_recon.cli.flight_view import show_summary
    from scp_recon.cli.rendering import show_verdict, show_warnings
    from scp_recon.results.runs import folder_of, resolve_run
    from scp_recon.scp.status import Status

    how = flights.FlyOptions(samples, until, truth, errors, seed, workers, scheduler, policy)
    home = resolve_run(plan)
    opened, folder = open_plan(home), folder_of(home)
    columns = ("flights", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with asked_to_stop() as stop, Progress(*columns, console=progress_console(console)) as bar:
        task = bar.add_task("flights", total=samples)
        watcher = flights.Watcher(
            lambda done: bar.update(task, completed=done),
            stop,
            lambda line: show_line(console, line),
        )
        flown = flights.fly_into(folder, opened, how, watcher)
    summary, document = flown.summary, {"files": [str(flown.path)]}
    if flown.interrupted:
        count = summary.samples
        show_line(console, f"interrupted: {count} of {samples} flights are summarised")
        show_written(console, flown.path)
        return Answer(Status.INTERRUPTED.value.exit_code, {"samples": count, **document})
    show_summary(console, summary, flights.required_probability(opened.solution))
    show_warnings(console, [*opened.solution.warnings, *opened.mission.warnings])
    failed = list(flights.shortfalls(summary, opened.solution))
    widest = flown.flights.widest_interval()
    if until is not None and widest > until:
        found = f"widest interval {100.0 * widest:.3g} %, required {100.0 * until:g} %"
        failed.append(f"{found}: needs more --samples")
    show_verdict(console, "as required", failed)
    show_written(console, flown.path)
    document = {"failed": failed, **document, **summary.model_dump(mode="json")}
    return Answer(NOT_VERIFIED if failed else 0, document)


@Command
def simulate(
    console: "Console",
    plan: PlanFile,
    *,
    seed: int = 0,
    policy: Policy = None,
    vehicle: Vehicle = None,
    out: Annotated[Path | None, Option("DIR")] = None,
) -> Answer:
    """Fly a plan once with the spacecraft in the loop.

    Args:
        seed: of all errors.
        policy: what burns are commanded, open, replan or feedback; from the simulated state at each
            cut-off, with errors of its measurement.
        out: folder for simulation.npz (default: the plan's).
    """
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TimeRemainingColumn

    from scp_recon.api import flights
    from scp_recon.api.files import open_plan
    from scp_recon.api.keeping import check_holds
    from scp_recon.cli.flight_view import show_flight
    from scp_recon.cli.rendering import show_verdict, show_warnings
    from scp_recon.errors import imported, option, whole_number
    from scp_recon.files import check_writable, only_run_in, unwritable
    from scp_recon.monte_carlo.flights import SEED_MAX
    from scp_recon.results.runs import folder_of, resolve_run
    from scp_recon.results.solution import require_whole_flight
    from scp_recon.simulation import record as records
    from scp_recon.simulation.vehicle import check_vehicle, load_vehicle

    imported("scp-recon simulate", "sim", "Basilisk")
    home = resolve_run(plan)
    whole_number(option("seed"), seed, 0, SEED_MAX)  # before a bar is shown
    mission, solution = open_plan(home)
    craft = load_vehicle(vehicle)
    require_whole_flight(solution.scenario, option("plan"))
    folder = out or folder_of(home)
    check_writable(folder, records.FILE_NAME, option("out"))
    check_holds(folder, solution, option("out"))
    columns = ("flight", BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with only_run_in(folder, option("out")):
        with Progress(*columns, console=progress_console(console)) as bar:
            task = bar.add_task("flight", total=solution.scenario.duration_s)
            record = flights.simulate(
                solution,
                seed=seed,
                policy=policy,
                vehicle=vehicle,
                progress=lambda time: bar.update(task, completed=time),
            )
        try:
            path = records.write_record(record, folder)
        except OSError as error:
            raise unwritable(folder, option("out"), error) from None
    show_flight(console, record.summary)
    other = check_vehicle(craft, solution.scenario)
    show_warnings(console, [*solution.warnings, *mission.warnings, *other])
    failed = records.shortfalls(record.summary, solution)
    show_verdict(console, "as required", failed)
    show_written(console, path)
    document = {"failed": failed, "files": [str(path)], "summary": record.summary.entries()}
    return Answer(NOT_VERIFIED if failed else 0, document)
