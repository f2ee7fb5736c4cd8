"""What the terminal shows of lighting windows, and the same as a table in a file."""

from __future__ import annotations

import csv
from datetime import timedelta
from io import StringIO

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from scp_recon.cli.tables import plain_table
from scp_recon.mission.legal_burns import Interval
from scp_recon.mission.survey import LitWindow, Survey
from scp_recon.physics.frames import DAY_S
from scp_recon.scenario.schema import Scenario


def tdb(scenario: Scenario, time_s: float) -> str:
    """Date and time of seconds past the scenario's epoch, TDB, to the second."""
    date = scenario.epoch.tdb + timedelta(seconds=time_s + 0.5)
    return date.replace(microsecond=0).isoformat()


def show_survey(console: Console, scenario: Scenario, survey: Survey) -> None:
    """The windows of a span, and where burns may be about them."""
    limits, (first, last) = scenario.observation, survey.span_s
    console.print(
        Text(scenario.name, style="bold")
        + Text(
            f": {scenario.body.name}, site {scenario.site.name}, incidence at most "
            f"{limits.incidence_max_deg:g} deg, local solar time {limits.local_solar_time_min_h:g} to "
            f"{limits.local_solar_time_max_h:g} h",
            style="not bold",
        )
    )
    console.print(
        f"searched  {tdb(scenario, first)} to {tdb(scenario, last)} TDB, {(last - first) / DAY_S:g} "
        f"days; seconds count from the epoch, {scenario.epoch.tdb.isoformat()} TDB",
        highlight=False,
        soft_wrap=True,
    )
    if limits.window_s is not None:
        console.print(
            f"window    {limits.window_s[0]:g} to {limits.window_s[1]:g} s is given by the scenario "
            "and is what is planned with; below is what its limits give",
            highlight=False,
            soft_wrap=True,
        )
    if not survey.windows:
        console.print("the limits hold throughout" if survey.always else "no whole window")
        return
    console.print(_windows(scenario, survey))
    console.print(_legal(scenario, survey))
    console.print(
        f"A flight of {scenario.duration_s:g} s with {survey.before} of its burns between the first "
        "and the window: where each burn may be, if the epoch moves and the others give way. Moved: "
        "by how much the epoch may move where the scenario's burns stay as they are. All in s past the "
        "scenario's epoch.",
        style="dim",
    )


def _windows(scenario: Scenario, survey: Survey) -> Table:
    table = plain_table(
        "window",
        "opens, TDB",
        "opens\ns",
        "closes\ns",
        "lasts\ns",
        "least inci-\ndence deg",
        "local solar\ntime h",
        no_wrap=True,
    )
    for number, w in enumerate(survey.windows, start=1):
        (first, last), (early, late) = w.edges_s, w.local_solar_time_h
        table.add_row(
            str(number),
            tdb(scenario, first),
            *(f"{x:.1f}" for x in (first, last, last - first)),
            f"{np.rad2deg(w.least_incidence_rad):.2f}",
            f"{early:.2f} to {late:.2f}",
        )
    return table


def _legal(scenario: Scenario, survey: Survey) -> Table:
    count = len(scenario.burns.times_s)
    headings = ["burn 1\n= epoch", *(f"burn {i}\n" for i in range(2, count + 1))]
    table = plain_table("window", "moved\n", *headings, no_wrap=True)
    for number, w in enumerate(survey.windows, start=1):
        table.add_row(str(number), _moved(w), *map(_interval, w.burns_s))
    return table


def _moved(window: LitWindow) -> str:
    return "\n".join(_interval(shift) for _, shift in window.shifts_s) or "nowhere"


def _interval(interval: Interval) -> str:
    early, late = interval
    return f"{early:.0f} to {late:.0f}" if early <= late else "nowhere"


def as_csv(scenario: Scenario, survey: Survey) -> str:
    """One row for each window; times in s past the scenario's epoch, and edges as TDB dates too.

    An interval that is empty has its first above its second.
    """
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    burns = range(1, len(scenario.burns.times_s) + 1)
    writer.writerow(
        [
            *("opens_tdb", "closes_tdb", "opens_s", "closes_s", "least_incidence_deg"),
            *("local_solar_time_opens_h", "local_solar_time_closes_h"),
            *(f"burn_{i}_{end}_s" for i in burns for end in ("earliest", "latest")),
        ]
    )
    for w in survey.windows:
        writer.writerow(
            [
                *(tdb(scenario, edge) for edge in w.edges_s),
                *(f"{edge:.3f}" for edge in w.edges_s),
                f"{np.rad2deg(w.least_incidence_rad):.4f}",
                *(f"{hour:.4f}" for hour in w.local_solar_time_h),
                *(f"{edge:.3f}" for interval in w.burns_s for edge in interval),
            ]
        )
    return text.getvalue()
