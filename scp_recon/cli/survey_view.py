"""Show lighting windows with legal burn times, and the table of packaged scenarios."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text

from scp_recon.api.survey import tdb
from scp_recon.bodies.catalogue import DAY_S
from scp_recon.cli.rendering import terminal
from scp_recon.mission.schedule import Interval, Survey
from scp_recon.results.table import Column, Table
from scp_recon.scenario.schema import Scenario

HINT = (
    "design takes those from a home orbit, solve the others, windows all of them; so does base in a "
    "scenario file"
)


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
    return Table.of("Packaged scenarios", (*names, "from a home orbit"), rows)


def survey_document(scenario: Scenario, survey: Survey) -> dict[str, Any]:
    """Document of windows in s past the epoch, with legal times of each burn; an open end is null."""
    return {
        "scenario": scenario.name,
        "epoch_tdb": scenario.epoch.tdb.isoformat(),
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


def show_survey(console: Console, scenario: Scenario, survey: Survey) -> None:
    """Show the windows of a span, and the legal burn times about them."""
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
    console.print(terminal(_windows_table(scenario, survey), narrow=True))
    console.print(terminal(_legal(scenario, survey), narrow=True))
    console.print(
        f"A flight of {scenario.duration_s:g} s with {survey.before} of its burns between the first "
        "and the window: where each burn may be, if the epoch and the other burns may move. Moved: "
        "by how much the epoch may move where the scenario's burns stay as they are. All in s past the "
        "scenario's epoch.",
        style="dim",
    )


def _windows_table(scenario: Scenario, survey: Survey) -> Table:
    rows = []
    for count, w in enumerate(survey.windows, start=1):
        (first, last), (early, late) = w.edges_s, w.local_solar_time_h
        incidence = float(np.rad2deg(w.least_incidence_rad))
        hours = f"{early:.2f} to {late:.2f}"
        rows.append([count, tdb(scenario, first), first, last, last - first, incidence, hours])
    columns = (
        Column("window"),
        Column("opens, TDB"),
        *(Column(name, "s", ".1f") for name in ("opens", "closes", "lasts")),
        Column("least incidence", "deg", ".2f"),
        Column("local solar time", "h"),
    )
    return Table.of("Windows", columns, rows)


def _legal(scenario: Scenario, survey: Survey) -> Table:
    later = (f"burn {i}" for i in range(2, len(scenario.burns.times_s) + 1))
    columns = ("window", "moved", "burn 1 = epoch", *later)
    rows = (
        [
            number,
            "\n".join(_interval(shift) for _, shift in w.shifts_s) or "nowhere",
            *map(_interval, w.burns_s),
        ]
        for number, w in enumerate(survey.windows, start=1)
    )
    return Table.of("Where burns may be", columns, rows)


def _interval(interval: Interval) -> str:
    early, late = interval
    return f"{early:.0f} to {late:.0f}" if early <= late else "nowhere"
