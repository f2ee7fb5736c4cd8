"""Show results on the terminal: tables, warnings and verdicts; windows, flights and campaigns.

What is shown of a plan is in `plan_view`.
"""

from __future__ import annotations

import math
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table as RichTable
from rich.text import Text

from scp_recon.bodies.catalogue import DAY_S
from scp_recon.cli.command import progress_console, show_line, show_written
from scp_recon.display import mm_s
from scp_recon.mission.schedule import Interval, Survey
from scp_recon.monte_carlo.summary import Summary
from scp_recon.reports import flight_tables as tables
from scp_recon.results.table import SCALES, Column, Table
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.schema import Scenario
from scp_recon.simulation.record import FlightSummary

if TYPE_CHECKING:
    from scp_recon.campaigns.outcome import CampaignResults

STYLES = {"bad": "red", "doubtful": "yellow"}
"""Rich's styles of the cells' by name."""
IN_MM_S = SCALES["m/s", "mm/s"]


def terminal(table: Table, *, narrow: bool = False) -> RichTable:
    """A table as the terminal shows it, without its title and note.

    A narrow one has units below their headings, and cells on one line.
    """
    shown = RichTable(box=None, header_style="bold", pad_edge=False)
    gap = "\n" if narrow else " "
    for number, (column, side) in enumerate(zip(table.columns, table.sides, strict=True)):
        unit = column.shown_unit or column.unit
        heading = column.heading if unit in ("", "1") else f"{column.heading}{gap}{unit}"
        shown.add_column(Text(heading), justify=side, no_wrap=narrow or not number, overflow="fold")
    for row in table.rows:
        shown.add_row(*(Text(cell.text, STYLES.get(cell.style, "")) for cell in row))
    return shown


def show_headline(console: Console, name: str, said: str, colour: str = "") -> None:
    """Show a name in bold, and what is said of it."""
    line = Text(f"{name}: ", style=f"bold {colour}") + Text(said, style="not bold")
    console.print(line, soft_wrap=True)


def show_table(console: Console, table: Table, spare: str = "") -> None:
    """Show a table and its note, without a spare column where the lines would be too long."""
    shown = terminal(table)
    needed = console.measure(shown, options=console.options.update(width=1000)).maximum
    console.print(shown if needed <= console.width else terminal(table.without(spare)))
    if table.note:
        show_line(console, table.note, "dim")


def show_warnings(
    console: Console, warnings: Iterable[ScenarioWarning | str], of: str = ""
) -> None:
    """One line each, however long; each once, and named after its plan if there are several."""
    head = f"warning of {of}" if of else "warning"
    for warning in dict.fromkeys(warnings):
        show_line(console, f"{head}: {warning}", "yellow")


def show_verdict(
    console: Console, word: str, failed: Sequence[str], note: str | None = None
) -> None:
    """Show the good verdict, or failed checks and required values; and a note to read it with."""
    verdict = f"not {word}" if failed else word
    text = Text(verdict, style="bold red" if failed else "bold green")
    if failed:
        text += Text(f": {', '.join(failed)}", style="default")
    if note:
        text += Text(f"; {note}", style="yellow")
    console.print(text, soft_wrap=True)


def time_left(done: float, total: float, took_s: float) -> str:
    """Time that is left in words, where each piece of work takes as long as those done on average."""
    if not 0 < done < total:
        return ""
    left = (total - done) * took_s / done
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if left >= 1.5 * size:
            return f"about {left / size:.2g} {unit} left"
    return f"about {max(left, 1.0):.0f} s left"


# --- scenarios and lighting windows --------------------------------------------------------------


def scenarios_table(found: Mapping[str, Scenario]) -> Table:
    """Packaged scenarios by name, one row each."""
    rows = [
        [
            name,
            one.body.name,
            one.site.name,
            one.epoch.tdb.isoformat(timespec="seconds"),
            len(one.burns.times_s),
            one.duration_s,
            "yes" if one.boundary.home is not None else "",
        ]
        for name, one in found.items()
    ]
    names = ("scenario", "body", "site", "epoch, TDB", "burns", Column("lasts", "s", ".0f"))
    note = (
        "design takes those from a home orbit, solve the others, windows all of them; so does base in "
        "a scenario file"
    )
    return Table.of("Packaged scenarios", (*names, "from a home orbit"), rows, note=note)


def survey_document(survey: Survey) -> dict[str, Any]:
    """Document of windows in s past the epoch, with legal times of each burn; an open end is null."""
    return {
        "scenario": survey.scenario.name,
        "epoch_tdb": survey.scenario.epoch.tdb.isoformat(),
        "span_s": survey.span_s,
        "lit_throughout": survey.always,
        "windows": [
            {
                "edges_s": window.edges_s,
                "least_incidence_rad": window.least_incidence_rad,
                "local_solar_time_h": window.local_solar_time_h,
                "burns_s": window.burns_s,
                "epoch_shifts_s": [shift for _, shift in window.shifts_s],
            }
            for window in survey.windows
        ],
    }


def show_survey(console: Console, survey: Survey) -> None:
    """Show the windows of a span, and the legal burn times about them."""
    from scp_recon.api.designing import tdb  # which searches for passes too

    scenario, (first, last) = survey.scenario, survey.span_s
    limits, epoch = scenario.observation, scenario.epoch.tdb.isoformat()
    show_headline(
        console,
        scenario.name,
        f"{scenario.body.name}, site {scenario.site.name}, incidence at most "
        f"{limits.incidence_max_deg:g} deg, local solar time {limits.local_solar_time_min_h:g} to "
        f"{limits.local_solar_time_max_h:g} h",
    )
    span = f"{tdb(scenario, first)} to {tdb(scenario, last)} TDB, {(last - first) / DAY_S:g} days"
    show_line(console, f"searched  {span}; seconds count from the epoch, {epoch} TDB")
    if limits.window_s is not None:
        given = f"{limits.window_s[0]:g} to {limits.window_s[1]:g} s is given by the scenario"
        show_line(
            console,
            f"window    {given} and is what is planned with; below is what its limits give",
        )
    if not survey.windows:
        console.print("the limits hold throughout" if survey.always else "no whole window")
        return
    lit = [
        [
            number,
            tdb(scenario, one.edges_s[0]),
            *one.edges_s,
            one.edges_s[1] - one.edges_s[0],
            math.degrees(one.least_incidence_rad),
            "{:.2f} to {:.2f}".format(*one.local_solar_time_h),
        ]
        for number, one in enumerate(survey.windows, start=1)
    ]
    times = (Column(name, "s", ".1f") for name in ("opens", "closes", "lasts"))
    lighting = Column("least incidence", "deg", ".2f"), Column("local solar time", "h")
    table = Table.of("Windows", ["window", "opens, TDB", *times, *lighting], lit)
    console.print(terminal(table, narrow=True))
    legal = [
        [
            number,
            "\n".join(_words(shift) for _, shift in window.shifts_s) or "nowhere",
            *map(_words, window.burns_s),
        ]
        for number, window in enumerate(survey.windows, start=1)
    ]
    later = (f"burn {i}" for i in range(2, len(scenario.burns.times_s) + 1))
    columns = ["window", "moved", "burn 1 = epoch", *later]
    console.print(terminal(Table.of("Where burns may be", columns, legal), narrow=True))
    console.print(
        f"A flight of {scenario.duration_s:g} s with {survey.before} of its burns between the first "
        "and the window: where each burn may be, if the epoch and the other burns may move. Moved: "
        "by how much the epoch may move where the scenario's burns stay as they are. All in s past the "
        "scenario's epoch.",
        style="dim",
    )


def _words(interval: Interval) -> str:
    early, late = interval
    return f"{early:.0f} to {late:.0f}" if early <= late else "nowhere"


# --- flights -------------------------------------------------------------------------------------


def show_summary(console: Console, summary: Summary, required: float | None = None) -> None:
    """Show the main figures of many flights, with their intervals.

    `required` is the required probability of every joint constraint, if one is.
    """

    def said(interval: Any, digits: int, scale: float = 1.0) -> str:
        return tables.interval_cell(interval, digits, scale=scale).text

    first, last = summary.window_s or (0.0, 0.0)
    window = f"window {last - first:.1f} s" if summary.window_s else "the window is over"
    lowest, commanded = tables.flown_probabilities_table(summary, required), summary.commanded
    shown: list[RenderableType] = [
        f"{summary.samples} flights, truth {summary.truth}, errors {summary.errors}, "
        f"policy {summary.policy}, planned with {summary.planned_gravity}, "
        f"flown with {summary.flown_gravity}, "
        f"{100 * summary.confidence:.0f} % intervals; {window}",
        *([terminal(tables.observation_times_table(summary))] if summary.held_s else []),
        terminal(lowest),
        *([lowest.note] if lowest.note else []),
        *([terminal(tables.corrected_burns_table(commanded, required))] if commanded else []),
    ]
    for label, spread, digits, scale in (
        ("all hold from s", summary.entry_s, 0, 1.0),
        ("all hold until s", summary.exit_s, 0, 1.0),
        ("nearest the centre m", summary.closest_m, 1, 1.0),
        ("executed delta-v mm/s", summary.executed_dv_m_s, 2, IN_MM_S),
    ):
        if spread.mean is not None and spread.q05 is not None and spread.q95 is not None:
            ends = (scale * quantile.estimate.value for quantile in (spread.q05, spread.q95))
            between = " to ".join(f"{end:.{digits}f}" for end in ends)
            mean = said(spread.mean, digits, scale)
            shown.append(f"{label:21} {mean}; 90 % of flights {between}")
    if commanded:
        shown.append(
            f"commanded delta-v mm/s {said(commanded.mean_dv_m_s, 2, IN_MM_S)}; "
            f"99 % of flights at most {said(commanded.dv99_m_s, 2, IN_MM_S)}"
        )
    worst, end = said(summary.closest_m.worst, 1), summary.terminal
    shown.append(f"closest approach to the centre, 0.3 % quantile: {worst} m")
    if end.sigma_ratio:
        sigmas = (
            f"{said(end.sigma_position_m, 2)} m, {said(end.sigma_velocity_m_s, 2, IN_MM_S)} mm/s"
        )
        ratios = ", ".join(f"{name} {said(ratio, 3)}" for name, ratio in end.sigma_ratio.items())
        normal = ", ".join(f"{name} {test.p_value:.2g}" for name, test in end.normality.items())
        shown += [
            f"final dispersion: {sigmas}",
            f"final state, J2000, sampled over predicted sigma: {ratios}",
            f"final state, J2000, p-value of normality: {normal}",
        ]
    else:
        shown.append("final state: no component spreads")
    if (safe := summary.drift) is not None:
        shown += [
            str(safe),
            f"safe drifts, never within {safe.radius_m:g} m of the centre: {safe.value:.4f}, "
            f"{safe.low:.4f} to {safe.high:.4f}",
        ]
    if summary.then is not None:
        shown.append(str(summary.then))
    for one in shown:
        console.print(one, highlight=False)


@contextmanager
def flights_bar(
    console: Console, total: float, *, one: bool = False
) -> Iterator[Callable[[float], None]]:
    """Yield a function that moves a bar to so many flights, or to a time of one flight."""
    what, done = ("flight", TaskProgressColumn()) if one else ("flights", MofNCompleteColumn())
    columns = (what, BarColumn(), done, TimeRemainingColumn())
    with Progress(*columns, console=progress_console(console)) as bar:
        task = bar.add_task(what, total=total)
        yield lambda reached: bar.update(task, completed=reached)


def show_flight(console: Console, summary: FlightSummary) -> None:
    """The figures of a simulated flight."""
    console.print(terminal(tables.legs_table(summary)))
    console.print(terminal(tables.simulated_burns_table(summary)))
    for name, angles in (
        ("camera against command", summary.window_pointing_deg.camera),
        ("camera against site", summary.window_pointing_deg.site),
        ("estimated attitude", summary.estimate_deg),
    ):
        named = angles.model_dump(by_alias=True).items()
        spread = ", ".join(f"{key} {value:.3f}" for key, value in named)
        show_line(console, f"{name:22} {spread} deg")
    miss = summary.terminal_miss
    for line in (
        f"least state of charge  {summary.least_charge:.3f} (floor {summary.floor_charge:.2f})",
        f"energy ledger error    {summary.ledger_error:.1e} of what is generated",
        f"momentum dumps         {summary.dumps}",
        f"final state            {miss.position_m:.1f} m and {mm_s(miss.velocity_m_s, 2)} "
        "from the planned mean",
        f"within 3 sigma         at {100 * summary.within_3_sigma:.1f} % of the nodes, "
        f"at most {summary.largest_sigma_distance:.2f} sigma",
        *([str(summary.drift)] if summary.drift else []),
    ):
        show_line(console, line)


# --- campaigns -----------------------------------------------------------------------------------


def show_campaign(
    results: CampaignResults, written: Sequence[Path], console: Console
) -> dict[str, Any]:
    """Show the summary of a campaign and its files; returns the summary as a document for `--json`."""
    from scp_recon.campaigns.outcome import remarks

    said = remarks(results)
    for line in (results.verdict, *said):
        show_line(console, line)
    for path in written:
        show_written(console, path)
    return {"feasible": results.feasible, "ends": results.counts(), "remarks": said}


@contextmanager
def continuing(console: Console) -> Iterator[None]:
    """Treat a termination signal as Ctrl-C, and say after either how to continue the campaign.

    Only the main thread receives the signal.
    """

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, stop) if in_main_thread else None
    try:
        yield
    except KeyboardInterrupt:
        kept = "every row until now is kept, and the same command continues the campaign"
        show_line(progress_console(console), kept)
        raise
    finally:
        if in_main_thread:
            signal.signal(signal.SIGTERM, before)


@contextmanager
def cases_bar(
    console: Console,
) -> Iterator[tuple[Callable[[int, int, Mapping[str, Any] | None], None], Callable[[str], None]]]:
    """Yield a bar with time taken and left and outcomes, and a function that shows a line above it.

    The time left is known once the first case has ended, however long cases take.
    """
    errors, text = progress_console(console), TextColumn("{task.fields[left]}{task.fields[ends]}")
    columns = ("cases", BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), text)
    ends: Counter[str] = Counter()
    begun, before = monotonic(), 0
    with Progress(*columns, console=errors) as bar:
        task = bar.add_task("cases", total=None, left="", ends="")

        def observe(done: int, total: int, row: Mapping[str, Any] | None) -> None:
            nonlocal before
            if row is None:
                before = done
                if done:
                    show_line(errors, f"continued: {done} of {total} cases have their rows")
                bar.reset(task, total=total, completed=done)
                return
            ends[str(row.get("status"))] += 1
            left = time_left(done - before, total - before, monotonic() - begun)
            most = ", ".join(f"{count} {name}" for name, count in ends.most_common(4))
            bar.update(task, completed=done, left=left, ends=f" {most}")

        yield observe, lambda text: show_line(errors, text)
