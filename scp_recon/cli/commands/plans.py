"""The commands about plans that there are: `verify`, `compare`, `report` and `export`."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from scp_recon.api import files
from scp_recon.cli import plan_view
from scp_recon.cli.command import (
    NOT_VERIFIED,
    Answer,
    Command,
    show_line,
    show_written,
)
from scp_recon.cli.documents import comparison_document, export_document, plan_document
from scp_recon.cli.options import add_plan, add_vehicle, number, whole
from scp_recon.cli.rendering import show_verdict, show_warnings, terminal
from scp_recon.errors import printable
from scp_recon.interop.export import SPACECRAFT_ID, heading
from scp_recon.interop.files import FORMATS
from scp_recon.reports.ground import Camera
from scp_recon.reports.write import FILE_NAME
from scp_recon.results.runs import folder_of, resolve_run
from scp_recon.verification.reintegration import verify as verified

EXPORTS = "export"
"""Folder of a plan's."""


def _verify(options: argparse.Namespace, console: Console) -> Answer:
    mission, solution = files.open_plan(options.plan)
    plan_view.show_mission(console, mission)
    plan_view.show_solution(console, solution)
    verification = verified(mission, solution)
    warnings = [*solution.warnings, *mission.warnings]
    plan_view.show_verification(console, mission, verification, warnings)
    checked = solution.with_verification(verification)
    return Answer(0 if verification.ok else NOT_VERIFIED, plan_document(checked))


def _add_compare(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "plans", type=Path, nargs="+", metavar="PLAN", help="folder with a solution.json, or a file"
    )


def _compare(options: argparse.Namespace, console: Console) -> Answer:
    solutions = [files.load(path) for path in options.plans]
    found = files.compare(*options.plans)
    console.print(terminal(found.table))
    for path, solution in zip(options.plans, solutions, strict=True):
        show_warnings(console, solution.warnings, of=printable(str(path)))
    return Answer(0, comparison_document(found))


def _add_report(p: argparse.ArgumentParser) -> None:
    usual = Camera()
    p.add_argument(
        "plans",
        type=Path,
        nargs="+",
        metavar="PLAN",
        help="folder with a solution.json, or a file; several are laid over each other; or the folder "
        "of a campaign, finished or not, which gets its page and pictures",
    )
    p.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help=f"the page (default: {FILE_NAME} in the first plan's folder)",
    )
    p.add_argument(
        "--field-deg",
        type=number,
        default=usual.field_deg,
        metavar="DEG",
        help=f"full angle of the camera's field of view (default: {usual.field_deg:g}, DARE's)",
    )
    p.add_argument(
        "--pixels",
        type=whole,
        default=usual.pixels,
        metavar="N",
        help=f"across the field of view (default: {usual.pixels}, DARE's)",
    )


def _report(options: argparse.Namespace, console: Console) -> Answer:
    if files.is_campaign(tuple(options.plans)):
        return _report_campaign(options.plans[0], console)
    file = options.out or folder_of(resolve_run(options.plans[0])) / FILE_NAME
    lens = {"field_deg": options.field_deg, "pixels": options.pixels}
    path = files.report(*options.plans, out=file, **lens)
    show_line(console, f"{path.stat().st_size / 1e6:.1f} MB")
    show_written(console, path)
    return Answer(0, {"files": [str(path)]})


def _report_campaign(folder: Path, console: Console) -> Answer:
    from scp_recon.campaigns.outcome import read_campaign
    from scp_recon.campaigns.page import write_pictures
    from scp_recon.cli.commands.campaigns import show_campaign, summary_of

    results = read_campaign(folder)
    written = write_pictures(results)
    show_campaign(results, written, console)
    return Answer(0, summary_of(results) | {"files": [str(path) for path in written]})


def _add_export(p: argparse.ArgumentParser) -> None:
    add_plan(p, "PLAN")
    p.add_argument(
        "--format",
        required=True,
        metavar="|".join(FORMATS),
        help="CCSDS OEM (and an OPM with the burns); SPICE kernels of the path, or of the attitude "
        "(the extra [spice]); a table as CSV or Parquet (the extra [parquet])",
    )
    p.add_argument(
        "--spacecraft",
        type=whole,
        default=SPACECRAFT_ID,
        metavar="ID",
        help=f"NAIF's number of the spacecraft, as --spacecraft=-64 (default: {SPACECRAFT_ID})",
    )
    add_vehicle(p, ", for --format ck")
    p.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help=f"folder for the files (default: {EXPORTS} in PLAN's)",
    )


def _export(options: argparse.Namespace, console: Console) -> Answer:
    home = resolve_run(options.plan)
    folder = options.out or folder_of(home) / EXPORTS
    craft = {"spacecraft": options.spacecraft, "vehicle": options.vehicle}
    written, found = files.export(home, options.format, folder, **craft)
    for line in heading(found):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    show_verdict(console, "verified", found.shortfalls)
    for file in written:
        show_written(console, file)
    return Answer(NOT_VERIFIED if found.shortfalls else 0, export_document(found, written))


verify = Command("verify", "Verify a solution again.", add_plan, _verify)
compare = Command(
    "compare", "Compare plans; paths are held against the first one's.", _add_compare, _compare
)
report = Command(
    "report",
    "Show plans on one page, an HTML file that works without a network: the verdict, a 3-D view in "
    "time, histories with their bands, probabilities, ground track, delta-v, margins, convergence. "
    "Flights and simulations that lie beside a plan are shown with it.",
    _add_report,
    _report,
)
export = Command("export", "Write a plan for other tools.", _add_export, _export)
