"""The commands that take plans: verify, fly, compare, show, export; options are of `api.plan_verbs`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from scp_recon.api import plan_verbs
from scp_recon.cli.command import (
    NOT_VERIFIED,
    Answer,
    asked_to_stop,
    command,
    progress_console,
    show_line,
    show_written,
)
from scp_recon.cli.options import Option

if TYPE_CHECKING:
    from rich.console import Console


@command(plan_verbs.verify)
def verify(console: "Console", plan: Path, *, verbose: bool = False) -> Answer:
    """Verify a solution again.

    Args:
        verbose: show boundary states, schedule, grid, margins at nodes and the re-integration too.
    """
    from scp_recon.api.files import solution_of, verified
    from scp_recon.cli import plan_view

    solution = solution_of(plan)
    mission = solution.mission
    plan_view.show_mission(console, mission, verbose=verbose)
    checked = verified(solution)
    found = checked.verification
    assert found is not None
    warnings = [*solution.warnings, *mission.warnings]
    plan_view.show_plan(console, mission, solution, found, warnings, verbose=verbose)
    return Answer(0 if found.ok else NOT_VERIFIED, plan_view.plan_document(checked))


@command(plan_verbs.fly)
def montecarlo(console: "Console", plan: Path, **how: Any) -> Answer:
    """Fly a plan many times with errors."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    from scp_recon.api import flying
    from scp_recon.api.files import solution_of
    from scp_recon.cli.flight_view import show_summary
    from scp_recon.cli.rendering import show_verdict, show_warnings
    from scp_recon.results.runs import folder_of, resolve_run
    from scp_recon.scp.status import Status
    from scp_recon.verification.causes import shortfalls
    from scp_recon.verification.probabilities import required_probability

    options = flying.FlyOptions(**how)
    home = resolve_run(plan)
    solution, folder = solution_of(home), folder_of(home)
    config = flying.config_of(solution, options)  # before a bar is shown
    columns = ("flights", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with asked_to_stop() as stop, Progress(*columns, console=progress_console(console)) as bar:
        task = bar.add_task("flights", total=options.samples)
        watcher = flying.Watcher(
            lambda done: bar.update(task, completed=done),
            stop,
            lambda line: show_line(console, line),
        )
        flown = flying.fly_into(folder, solution, options, config, watcher)
    summary, document = flown.summary, {"files": [str(flown.path)]}
    if flown.interrupted:
        count = summary.samples
        show_line(console, f"interrupted: {count} of {options.samples} flights are summarised")
        show_written(console, flown.path)
        return Answer(Status.INTERRUPTED.value.exit_code, {"samples": count, **document})
    show_summary(console, summary, required_probability(solution))
    show_warnings(console, [*solution.warnings, *solution.mission.warnings])
    failed = shortfalls(summary, solution)
    widest, until = flown.flights.widest_interval(), options.until
    if until is not None and widest > until:
        found = f"widest interval {100.0 * widest:.3g} %, required {100.0 * until:g} %"
        failed.append(f"{found}: needs more --samples")
    free = summary.drift is not None and summary.drift.required is None
    word = "nothing is required of this drift" if free and not failed else "as required"
    show_verdict(console, word, failed, None if free else summary.terminal.missed)
    show_written(console, flown.path)
    document = {"failed": failed, **document, **summary.model_dump(mode="json")}
    return Answer(NOT_VERIFIED if failed else 0, document)


@command(plan_verbs.simulate)
def simulate(console: "Console", plan: Path, *, out: Path | None = None, **how: Any) -> Answer:
    """Fly a plan once with the spacecraft in the loop.

    Args:
        out: folder for simulation.npz (default: the plan's).
    """
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TimeRemainingColumn

    from scp_recon.api import flying
    from scp_recon.api.keeping import results_beside
    from scp_recon.cli.flight_view import show_flight
    from scp_recon.cli.rendering import show_verdict, show_warnings
    from scp_recon.errors import option
    from scp_recon.files import writing
    from scp_recon.results.runs import folder_of, resolve_run
    from scp_recon.simulation import record as records
    from scp_recon.simulation.vehicle import check_vehicle
    from scp_recon.verification.causes import shortfalls

    home = resolve_run(plan)
    simulation = flying.simulation_of(home, **how)  # before a bar is shown
    solution = simulation.solution
    folder, entry = out or folder_of(home), option("out")
    columns = ("flight", BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    name = records.file_name(simulation.miss)
    with results_beside(folder, solution, name, entry, records.MARK):
        with Progress(*columns, console=progress_console(console)) as bar:
            task = bar.add_task("flight", total=solution.scenario.duration_s)
            record = simulation.fly(lambda time: bar.update(task, completed=time))
        with writing(folder, entry):
            path = records.write_record(record, folder)
    show_flight(console, record.summary)
    other = check_vehicle(simulation.craft, solution.scenario)
    show_warnings(console, [*solution.warnings, *solution.mission.warnings, *other])
    failed = shortfalls(record.summary, solution)
    show_verdict(console, "as required", failed)
    show_written(console, path)
    document = {"failed": failed, "files": [str(path)], "summary": record.summary.entries()}
    return Answer(NOT_VERIFIED if failed else 0, document)


@command(plan_verbs.compare)
def compare(console: "Console", **given: Any) -> Answer:
    """Compare plans side by side; paths are compared with the first one's."""
    from scp_recon.cli.rendering import show_warnings, terminal
    from scp_recon.errors import printable

    plans = [plan_verbs.load(path) for path in given["plans"]]
    found = plan_verbs.compare(*given["plans"])
    console.print(terminal(found.table))
    for name, solution in zip(found.names, plans, strict=True):
        show_warnings(console, solution.warnings, of=printable(name))
    rows = [{"name": name, "unit": unit, "values": row} for name, unit, row in found.rows]
    return Answer(0, {"plans": list(found.names), "rows": rows})


@command(plan_verbs.report, out=Option("FILE", read=Path))
def report(console: "Console", *, out: Path | None = None, **given: Any) -> Answer:
    """Show plans, or a campaign, on one page.

    It is an HTML file that works without a network: the verdict, a 3-D view in time, histories with
    their bands, probabilities, ground track, delta-v, margins, convergence. It includes flights and
    simulations beside a plan.

    Args:
        out: the page of plans (default: report.html in the first plan's folder).
    """
    from scp_recon.api import files
    from scp_recon.results.runs import folder_of, resolve_run

    plans = given.pop("plans")
    if files.is_campaign(tuple(plans)):
        files.check_of_plans(out=out, **given)
        return _report_campaign(plans[0], console)
    from scp_recon.reports.write import FILE_NAME  # charts and ground tracks, of this command alone

    file = out or folder_of(resolve_run(plans[0])) / FILE_NAME
    path = plan_verbs.report(*plans, out=file, **given)
    show_line(console, f"{path.stat().st_size / 1e6:.1f} MB")
    show_written(console, path)
    return Answer(0, {"files": [str(path)]})


def _report_campaign(folder: Path, console: "Console") -> Answer:
    from scp_recon.campaigns.outcome import read_campaign
    from scp_recon.campaigns.page import write_page
    from scp_recon.cli.campaign_view import show_campaign, summary_of

    results = read_campaign(folder)
    written = [write_page(results)]
    show_campaign(results, written, console)
    return Answer(0, summary_of(results) | {"files": [str(path) for path in written]})


@command(plan_verbs.export)
def export(console: "Console", plan: Path, *, out: Path | None = None, **given: Any) -> Answer:
    """Write a plan for other tools.

    Args:
        out: folder for the files (default: export in PLAN's).
    """
    from scp_recon.api.keeping import EXPORTS
    from scp_recon.cli.plan_view import export_document
    from scp_recon.cli.rendering import show_verdict
    from scp_recon.interop.export import heading
    from scp_recon.results.runs import folder_of, resolve_run

    home = resolve_run(plan)
    written, found = plan_verbs.export(home, out=out or folder_of(home) / EXPORTS, **given)
    for line in heading(found):
        show_line(console, line)
    show_verdict(console, "verified", found.shortfalls)
    for file in written:
        show_written(console, file)
    return Answer(NOT_VERIFIED if found.shortfalls else 0, export_document(found, written))
