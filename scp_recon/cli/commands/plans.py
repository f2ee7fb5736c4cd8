"""The commands about existing plans: `verify`, `compare`, `report` and `export`."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console

from scp_recon.api import files
from scp_recon.api.keeping import EXPORTS
from scp_recon.cli import plan_view
from scp_recon.cli.command import (
    NOT_VERIFIED,
    Answer,
    show_line,
    show_written,
)
from scp_recon.cli.plan_view import FRAME, plan_document
from scp_recon.cli.rendering import show_verdict, show_warnings, terminal
from scp_recon.errors import printable
from scp_recon.interop.export import Export, heading
from scp_recon.interop.path import WITHIN_M
from scp_recon.results import comparison
from scp_recon.results.comparison import Comparison
from scp_recon.results.runs import folder_of, resolve_run
from scp_recon.scenario.time_scales import iso_tdb, iso_utc
from scp_recon.verification.reintegration import verify as verified


def verify(options: argparse.Namespace, console: Console) -> Answer:
    """Verify and show."""
    mission, solution = files.open_plan(options.plan)
    plan_view.show_mission(console, mission)
    plan_view.show_solution(console, solution)
    verification = verified(mission, solution)
    warnings = [*solution.warnings, *mission.warnings]
    plan_view.show_verification(console, mission, solution, verification, warnings)
    checked = solution.with_verification(verification)
    return Answer(0 if verification.ok else NOT_VERIFIED, plan_document(checked))


def compare(options: argparse.Namespace, console: Console) -> Answer:
    """Show plans beside each other."""
    names = [str(path) for path in options.plans]
    solutions = [files.load(path) for path in options.plans]
    found = comparison.compare(names, solutions)
    console.print(terminal(found.table))
    for name, solution in zip(names, solutions, strict=True):
        show_warnings(console, solution.warnings, of=printable(name))
    return Answer(0, comparison_document(found))


def report(options: argparse.Namespace, console: Console) -> Answer:
    """Write the page."""
    if files.is_campaign(tuple(options.plans)):
        files.check_of_plans(out=options.out, field_deg=options.field_deg, pixels=options.pixels)
        return _report_campaign(options.plans[0], console)
    from scp_recon.reports.write import FILE_NAME  # charts and ground tracks, of this command alone

    file = options.out or folder_of(resolve_run(options.plans[0])) / FILE_NAME
    lens = {"field_deg": options.field_deg, "pixels": options.pixels}
    path = files.report(*options.plans, out=file, **lens)
    show_line(console, f"{path.stat().st_size / 1e6:.1f} MB")
    show_written(console, path)
    return Answer(0, {"files": [str(path)]})


def _report_campaign(folder: Path, console: Console) -> Answer:
    from scp_recon.campaigns.outcome import read_campaign
    from scp_recon.campaigns.page import write_page
    from scp_recon.cli.commands.campaigns import show_campaign, summary_of

    results = read_campaign(folder)
    written = [write_page(results)]
    show_campaign(results, written, console)
    return Answer(0, summary_of(results) | {"files": [str(path) for path in written]})


def export(options: argparse.Namespace, console: Console) -> Answer:
    """Write the files."""
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


def comparison_document(found: Comparison) -> dict[str, Any]:
    """Rows with a value for each plan."""
    return {
        "plans": list(found.names),
        "rows": [{"name": name, "unit": unit, "values": row} for name, unit, row in found.rows],
    }


def export_document(found: Export, files: Iterable[Path]) -> dict[str, Any]:
    """Document of an export: the path, the burns with their dates, and the files."""
    return {
        "verdict": found.verdict,
        "files": [str(file) for file in files],
        "frame": FRAME,
        "states": found.path.size,
        "linear_error_m": found.path.linear_error_m,
        "cubic_error_m": found.path.cubic_error_m,
        "asked_error_m": WITHIN_M,
        "burns": [
            {
                "t_s": burn.t_s,
                "tdb": iso_tdb(found.instant(burn.t_s)),
                "utc": iso_utc(found.instant(burn.t_s)),
                "dv_m_s": burn.dv_m_s,
            }
            for burn in found.solution.burns
        ],
        "plan_hash": found.solution.plan_hash,
    }
