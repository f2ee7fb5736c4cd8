"""The commands about existing plans: `verify`, `compare`, `report` and `export`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from scp_recon.cli.command import NOT_VERIFIED, Answer, Command, show_line, show_written
from scp_recon.cli.options import Option, PlanFile, Vehicle

if TYPE_CHECKING:
    from rich.console import Console


@Command
def verify(console: "Console", plan: PlanFile) -> Answer:
    """Verify a solution again."""
    from scp_recon.api.files import open_plan
    from scp_recon.cli import plan_view
    from scp_recon.verification import reintegration

    mission, solution = open_plan(plan)
    plan_view.show_mission(console, mission)
    plan_view.show_solution(console, solution)
    found = reintegration.verify(mission, solution)
    warnings = [*solution.warnings, *mission.warnings]
    plan_view.show_verification(console, mission, solution, found, warnings)
    checked = solution.with_verification(found)
    return Answer(0 if found.ok else NOT_VERIFIED, plan_view.plan_document(checked))


@Command
def compare(
    console: "Console",
    plans: Annotated[list[Path], Option("PLAN", help="folder with a solution.json, or the file")],
) -> Answer:
    """Compare plans side by side; paths are compared with the first one's."""
    from scp_recon.api.files import load
    from scp_recon.cli.rendering import show_warnings, terminal
    from scp_recon.errors import printable
    from scp_recon.results import comparison

    names = [str(path) for path in plans]
    solutions = [load(path) for path in plans]
    found = comparison.compare(names, solutions)
    console.print(terminal(found.table))
    for name, solution in zip(names, solutions, strict=True):
        show_warnings(console, solution.warnings, of=printable(name))
    rows = [{"name": name, "unit": unit, "values": row} for name, unit, row in found.rows]
    return Answer(0, {"plans": list(found.names), "rows": rows})


@Command
def report(
    console: "Console",
    plans: Annotated[list[Path], Option("PLAN")],
    *,
    out: Path | None = None,
    field_deg: Annotated[float | None, Option("DEG")] = None,
    pixels: int | None = None,
) -> Answer:
    """Show plans, or a campaign, on one page.

    It is an HTML file that works without a network: the verdict, a 3-D view in time, histories with
    their bands, probabilities, ground track, delta-v, margins, convergence. It includes flights and
    simulations beside a plan.

    Args:
        plans: folder with a solution.json, or a file; several are overlaid; or the folder of a
            campaign, finished or not, which gets a page.
        out: the page (default: report.html in the first plan's folder).
        field_deg: full angle of the camera's field of view (default: DARE's, 21).
        pixels: across the field of view (default: DARE's, 5120).
    """
    from scp_recon.api import files
    from scp_recon.results.runs import folder_of, resolve_run

    if files.is_campaign(tuple(plans)):
        files.check_of_plans(out=out, field_deg=field_deg, pixels=pixels)
        return _report_campaign(plans[0], console)
    from scp_recon.reports.write import FILE_NAME  # charts and ground tracks, of this command alone

    file = out or folder_of(resolve_run(plans[0])) / FILE_NAME
    path = files.report(*plans, out=file, field_deg=field_deg, pixels=pixels)
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


@Command
def export(
    console: "Console",
    plan: PlanFile,
    *,
    format: Literal["oem", "spk", "ck", "csv", "parquet"],  # noqa: A002 -- as in `api.files.export`
    out: Annotated[Path | None, Option("DIR")] = None,
    spacecraft: int = -999,
    vehicle: Vehicle = None,
) -> Answer:
    """Write a plan for other tools.

    Args:
        format: oem (CCSDS, with an OPM of the burns), spk or ck (SPICE kernels of the path, or of the
            attitude; the extra [spice]), csv or parquet (a table; the extra [parquet]).
        out: folder for the files (default: export in PLAN's).
        spacecraft: NAIF's number of the spacecraft, below zero; as --spacecraft=-64.
        vehicle: a TOML file, for ck (default: the packaged DARE).
    """
    from scp_recon.api import files
    from scp_recon.api.keeping import EXPORTS
    from scp_recon.cli.plan_view import export_document
    from scp_recon.cli.rendering import show_verdict
    from scp_recon.interop.export import heading
    from scp_recon.results.runs import folder_of, resolve_run

    home = resolve_run(plan)
    folder = out or folder_of(home) / EXPORTS
    written, found = files.export(home, format, folder, spacecraft=spacecraft, vehicle=vehicle)
    for line in heading(found):
        show_line(console, line)
    show_verdict(console, "verified", found.shortfalls)
    for file in written:
        show_written(console, file)
    return Answer(NOT_VERIFIED if found.shortfalls else 0, export_document(found, written))
