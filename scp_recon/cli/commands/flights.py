"""The commands that fly a plan: `montecarlo` many times with errors, `simulate` the spacecraft once."""

from __future__ import annotations

import argparse

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskProgressColumn,
    TimeRemainingColumn,
)

from scp_recon.api.files import open_plan
from scp_recon.api.flights import (
    FlyOptions,
    Watcher,
    fly_into,
    required_probability,
    shortfalls,
)
from scp_recon.api.flights import simulate as fly_spacecraft
from scp_recon.api.keeping import check_holds
from scp_recon.cli.command import (
    NOT_VERIFIED,
    Answer,
    asked_to_stop,
    progress_console,
    show_line,
    show_written,
)
from scp_recon.cli.rendering import show_verdict, show_warnings, terminal
from scp_recon.errors import imported, option, whole_number
from scp_recon.files import check_writable, only_run_in, unwritable
from scp_recon.monte_carlo.flights import SEED_MAX
from scp_recon.monte_carlo.summary import (
    Statistics,
    Summary,
    Terminal,
)
from scp_recon.reports.tables import (
    corrected_burns_table,
    flown_probabilities_table,
    interval_cell,
    legs_table,
    observation_times_table,
    simulated_burns_table,
)
from scp_recon.results.runs import folder_of, resolve_run
from scp_recon.results.solution import require_whole_flight
from scp_recon.scp.status import Status
from scp_recon.simulation import record as records
from scp_recon.simulation.record import Angles, FlightSummary
from scp_recon.simulation.vehicle import check_vehicle, load_vehicle


def montecarlo(options: argparse.Namespace, console: Console) -> Answer:
    """Fly many times, show and write."""
    how = FlyOptions(
        options.samples,
        options.until,
        options.truth,
        options.errors,
        options.seed,
        options.workers,
        options.scheduler,
        options.policy,
    )
    home = resolve_run(options.plan)
    plan, folder = open_plan(home), folder_of(home)
    columns = ("flights", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with asked_to_stop() as stop, Progress(*columns, console=progress_console(console)) as bar:
        task = bar.add_task("flights", total=options.samples)
        watcher = Watcher(
            lambda done: bar.update(task, completed=done),
            stop,
            lambda line: show_line(console, line),
        )
        flown = fly_into(folder, plan, how, watcher)
    summary, document = flown.summary, {"files": [str(flown.path)]}
    if flown.interrupted:
        count = summary.samples
        show_line(console, f"interrupted: {count} of {options.samples} flights are summarised")
        show_written(console, flown.path)
        return Answer(Status.INTERRUPTED.value.exit_code, {"samples": count, **document})
    show_summary(console, summary, required_probability(plan.solution))
    show_warnings(console, [*plan.solution.warnings, *plan.mission.warnings])
    failed = [
        *shortfalls(summary, plan.solution),
        *_too_wide(flown.flights.widest_interval(), how.until),
    ]
    show_verdict(console, "as required", failed)
    show_written(console, flown.path)
    found = {"failed": failed, **document, **summary.model_dump(mode="json")}
    return Answer(NOT_VERIFIED if failed else 0, found)


def _too_wide(width: float, until: float | None) -> list[str]:
    """A message if the flights ended with an interval wider than required."""
    if until is None or width <= until:
        return []
    return [
        f"widest interval {100.0 * width:.3g} %, required {100.0 * until:g} %: needs more --samples"
    ]


def simulate(options: argparse.Namespace, console: Console) -> Answer:
    """Fly once, show and write."""
    imported("scp-recon simulate", "sim", "Basilisk")
    home = resolve_run(options.plan)
    whole_number(option("seed"), options.seed, 0, SEED_MAX)  # before a bar is shown
    mission, solution = open_plan(home)
    vehicle = load_vehicle(options.vehicle)
    require_whole_flight(solution.scenario, option("plan"))
    folder = options.out or folder_of(home)
    check_writable(folder, records.FILE_NAME, option("out"))
    check_holds(folder, solution, option("out"))
    columns = ("flight", BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with only_run_in(folder, option("out")):
        with Progress(*columns, console=progress_console(console)) as bar:
            task = bar.add_task("flight", total=solution.scenario.duration_s)
            record = fly_spacecraft(
                solution,
                seed=options.seed,
                policy=options.policy,
                vehicle=options.vehicle,
                progress=lambda time: bar.update(task, completed=time),
            )
        try:
            path = records.write_record(record, folder)
        except OSError as error:
            raise unwritable(folder, option("out"), error) from None
    show_flight(console, record.summary)
    other = check_vehicle(vehicle, solution.scenario)
    show_warnings(console, [*solution.warnings, *mission.warnings, *other])
    failed = records.shortfalls(record.summary, solution)
    show_verdict(console, "as required", failed)
    show_written(console, path)
    document = {"failed": failed, "files": [str(path)], "summary": record.summary.entries()}
    return Answer(NOT_VERIFIED if failed else 0, document)


def show_summary(console: Console, summary: Summary, required: float | None = None) -> None:
    """Show the main figures of many flights, with their intervals.

    Args:
        console: to print to.
        summary: what to show.
        required: required probability of every joint constraint; None without one.
    """
    first, last = summary.window_s or (0.0, 0.0)
    window = f"window {last - first:.1f} s" if summary.window_s else "the window is over"
    console.print(
        f"{summary.samples} flights, truth {summary.truth}, errors {summary.errors}, "
        f"policy {summary.policy}, planned with {summary.planned_gravity}, "
        f"flown with {summary.flown_gravity}, "
        f"{100 * summary.confidence:.0f} % intervals; {window}",
        highlight=False,
    )
    if summary.held_s:
        console.print(terminal(observation_times_table(summary)))
    lowest = flown_probabilities_table(summary, required)
    console.print(terminal(lowest))
    if lowest.note:
        console.print(lowest.note, highlight=False)
    if summary.commanded is not None:
        console.print(terminal(corrected_burns_table(summary.commanded, required)))
    for label, spread, digits in (
        ("all hold from", summary.entry_s, 0),
        ("all hold until", summary.exit_s, 0),
        ("closest approach m", summary.closest_m, 1),
        ("executed delta-v m/s", summary.executed_dv_m_s, 5),
    ):
        _show_spread(console, label, spread, digits)
    if summary.commanded is not None:
        mean, most = summary.commanded.mean_dv_m_s, summary.commanded.dv99_m_s
        console.print(
            f"commanded delta-v m/s {interval_cell(mean, 5).text}; "
            f"99 % of flights at most {interval_cell(most, 5).text}",
            highlight=False,
        )
    worst = interval_cell(summary.closest_m.worst, 1).text
    console.print(f"closest approach, 0.3 % quantile: {worst} m", highlight=False)
    _show_terminal(console, summary.terminal)


def _show_spread(console: Console, label: str, spread: Statistics, digits: int) -> None:
    """One line, and none without flights."""
    if spread.mean is None or spread.q05 is None or spread.q95 is None:
        return
    low, high = spread.q05.estimate.value, spread.q95.estimate.value
    console.print(
        f"{label:21} {interval_cell(spread.mean, digits).text}; 90 % of flights {low:.{digits}f} to "
        f"{high:.{digits}f}",
        highlight=False,
    )


def _show_terminal(console: Console, terminal: Terminal) -> None:
    if not terminal.sigma_ratio:
        console.print("final state: no component spreads", highlight=False)
        return
    if terminal.sigma_position_m is not None and terminal.sigma_velocity_m_s is not None:
        position = interval_cell(terminal.sigma_position_m, 2).text
        velocity = interval_cell(terminal.sigma_velocity_m_s, 5).text
        console.print(f"final dispersion: {position} m, {velocity} m/s", highlight=False)
    ratios = ", ".join(
        f"{name} {interval_cell(r, 3).text}" for name, r in terminal.sigma_ratio.items()
    )
    console.print(f"final state, J2000, sampled over predicted sigma: {ratios}", highlight=False)
    normal = ", ".join(f"{name} {test.p_value:.2g}" for name, test in terminal.normality.items())
    console.print(f"final state, J2000, p-value of normality: {normal}", highlight=False)


def show_flight(console: Console, summary: FlightSummary) -> None:
    """The figures of a simulated flight."""
    console.print(terminal(legs_table(summary)))
    console.print(terminal(simulated_burns_table(summary)))
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
