"""The commands about scenarios: `new` drafts one, `windows` shows its lighting, `schema` its format."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.text import Text

from scp_recon.api.drafts import NewOptions
from scp_recon.api.drafts import new as draft_scenario
from scp_recon.api.planning import scenario_of
from scp_recon.api.survey import DAYS_MAX, SPAN_DAYS, tdb
from scp_recon.api.survey import windows as survey_windows
from scp_recon.bodies.catalogue import DAY_S, body_names
from scp_recon.cli import plan_view
from scp_recon.cli.command import NOT_VERIFIED, Answer, Command, show_line, show_written
from scp_recon.cli.documents import plan_document, survey_document
from scp_recon.cli.options import number, numbers, whole
from scp_recon.cli.rendering import show_warnings, terminal
from scp_recon.errors import option
from scp_recon.files import check_writable, unwritable, write_atomically
from scp_recon.mission.checks.checks import check_scene
from scp_recon.mission.legal_burns import Interval
from scp_recon.mission.scene import Scene
from scp_recon.mission.survey import Survey
from scp_recon.results.table import Column, Table
from scp_recon.scenario.json_schema import schema_text
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status


def _add_new(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "name",
        metavar="NAME",
        help="of the scenario, written to NAME.toml",
    )
    p.add_argument(
        "--body",
        required=True,
        metavar="NAME",
        help=f"{', '.join(body_names())}; or another, with the next five options after --epoch",
    )
    p.add_argument(
        "--site",
        required=True,
        type=numbers,
        metavar="LAT,LON",
        help="planetocentric latitude and east longitude in deg; as --site=-20,30 where it is south",
    )
    p.add_argument(
        "--epoch",
        metavar="TDB",
        help="earliest time of the first burn, TDB, e.g. 2020-01-21T20:33:17; where no trajectory is "
        "given",
    )
    p.add_argument("--gm", type=number, metavar="GM", help="in m^3/s^2")
    p.add_argument("--radius", type=number, metavar="R", help="in m; a sphere")
    p.add_argument(
        "--period",
        type=number,
        metavar="H",
        help="sidereal spin period in h, right-handed about the pole",
    )
    p.add_argument("--pole", type=numbers, metavar="RA,DEC", help="spin pole in deg, J2000")
    p.add_argument(
        "--orbit",
        type=numbers,
        metavar="X,Y,Z,VX,VY,VZ",
        help="the body from the Sun at --epoch in km and km/s, J2000",
    )
    p.add_argument(
        "--from-spice",
        type=Path,
        metavar="META",
        help="meta-kernel: body, Sun, boundary states and start from it, with --spacecraft, "
        "--from and --to (the extra [spice])",
    )
    p.add_argument(
        "--spacecraft",
        type=whole,
        metavar="ID",
        help="NAIF's number in the kernels, as --spacecraft=-64",
    )
    p.add_argument(
        "--from-oem",
        type=Path,
        metavar="FILE",
        help="CCSDS OEM: boundary states and start from it, --from and --to if given (the extra [oem])",
    )
    p.add_argument(
        "--from-csv",
        type=Path,
        metavar="FILE",
        help="table of states as solve --init takes it, its t_s past --epoch; the same",
    )
    for name, flag, which in (("begin", "--from", "first"), ("end", "--to", "last")):
        p.add_argument(
            flag, dest=name, metavar="UTC", help=f"{which} burn, UTC, e.g. 2020-01-21T20:32:08"
        )


def _new(options: argparse.Namespace, console: Console) -> Answer:
    given = {field.name: getattr(options, field.name) for field in fields(NewOptions)}
    found = draft_scenario(**given, progress=lambda line: show_line(console, line))
    plan_view.show_mission(console, found.mission)
    plan_view.show_solution(console, found.solution)
    plan_view.show_verification(console, found.mission, found.verification, found.mission.warnings)
    for file in found.files:
        show_written(console, file)
    code = Status.named(found.solution.status).value.exit_code
    status = code or (0 if found.is_verified else NOT_VERIFIED)
    return Answer(status, plan_document(found.solution, found.files))


def _add_windows(p: argparse.ArgumentParser) -> None:
    p.add_argument("scenario", metavar="SCENARIO", help="TOML file, or recon_b")
    p.add_argument(
        "--from",
        metavar="TDB",
        dest="begin",
        help="where the span begins, TDB, e.g. 2020-01-21T20:33:17 (default: the scenario's epoch)",
    )
    p.add_argument(
        "--span-days",
        type=number,
        default=SPAN_DAYS,
        metavar="D",
        help=f"how long it is, up to {DAYS_MAX:g} days (default: {SPAN_DAYS:g})",
    )
    p.add_argument(
        "--chart",
        type=Path,
        metavar="FILE",
        help="draw the windows and where burns may be; .png, .pdf or .svg (the extra [report])",
    )
    p.add_argument("--csv", type=Path, metavar="FILE", help="write them as a table")


def _windows(options: argparse.Namespace, console: Console) -> Answer:
    scenario = scenario_of(options.scenario)
    files = {"csv": options.csv, "chart": options.chart}
    found = survey_windows(scenario, options.begin, options.span_days, **files)
    show_survey(console, scenario, found)
    show_warnings(console, check_scene(Scene.of(scenario)))
    written = [path for path in files.values() if path]
    for path in written:
        show_written(console, path)
    return Answer(0, {**survey_document(scenario, found), "files": [str(p) for p in written]})


def _add_schema(p: argparse.ArgumentParser) -> None:
    p.add_argument("file", type=Path, metavar="FILE", help="where to write it")


def _schema(options: argparse.Namespace, console: Console) -> Answer:
    file, entry = options.file, option("file")
    check_writable(file.parent, file.name, entry)
    try:
        path = write_atomically(file, schema_text())
    except OSError as error:
        raise unwritable(file.parent, entry, error) from None
    show_written(console, path)
    return Answer(0, {"files": [str(path)]})


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


new = Command("new", "Draft a scenario for one's own site and body.", _add_new, _new)
windows = Command("windows", "Lighting windows and legal burn times.", _add_windows, _windows)
schema = Command("schema", "Write the JSON schema of scenario files.", _add_schema, _schema)
