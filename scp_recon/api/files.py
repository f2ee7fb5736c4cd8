"""Save, load, verify, compare, export and show plans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from scp_recon.api.keeping import keep
from scp_recon.errors import (
    InputError,
    number_between,
    one_of,
    option,
    path_of,
    shortened,
    whole_number,
)
from scp_recon.files import check_writable, unwritable
from scp_recon.interop.export import UNNAMED_BODY_ID, Export, Ids
from scp_recon.interop.files import FORMATS, require, stem, write_export
from scp_recon.interop.path import fly_path
from scp_recon.mission.mission import Mission
from scp_recon.planning.plan import Plan
from scp_recon.results import comparison
from scp_recon.results.facts import Verification
from scp_recon.results.read import read_solution
from scp_recon.results.runs import resolve_run
from scp_recon.results.solution import FILE_NAME, Solution, make_solution
from scp_recon.simulation.vehicle import load_vehicle
from scp_recon.verification import reintegration

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

AnyPlan = Plan | Solution | str | Path
"""A plan, a solution, or the file or folder of one."""

SPACECRAFT_MIN = -99_999
"""NAIF's numbers of spacecraft are below zero; their axes have a thousand times that, and SPICE counts
to 2^31."""
FIELD_MAX_DEG, PIXELS_MAX = 170.0, 1_000_000
CAMPAIGN = "campaign.json"


class Opened(NamedTuple):
    """A plan that was given as a plan, a solution, a file or a folder.

    Attributes:
        mission: of its scenario.
        solution: as its file has it.
    """

    mission: Mission
    solution: Solution


def open_plan(given: AnyPlan) -> Opened:
    """A plan with its mission.

    Raises:
        InputError: if it is no plan and no file of one.
    """
    solution = solution_of(given)
    mission = given.mission if isinstance(given, Plan) else None
    return Opened(mission or solution.mission, solution)


def solution_of(given: AnyPlan) -> Solution:
    """The solution of a plan; a plan that was not verified stays so.

    Raises:
        InputError: if it is no plan and no file of one.
    """
    return make_solution(given) if isinstance(given, Plan) else load(given)


def load(plan: AnyPlan) -> Solution:
    """Read the solution in a file or a folder.

    Args:
        plan: the file or folder; a solution is returned as it is, a plan is verified first.

    Returns:
        The solution. The solution of a file has the file's verification.

    Raises:
        InputError: if `plan` is none of these, or cannot be read.

    Examples:
        >>> import scp_recon as sr
        >>> folder = sr.save(sr.plan(problem="P3"), "runs/mine").parent
        >>> sr.load(folder).problem
        'P3'
    """
    if isinstance(plan, Plan):
        return verified(plan.mission, make_solution(plan))
    if isinstance(plan, Solution):
        return plan
    if not isinstance(plan, str | Path):
        raise InputError("plan", shortened(plan), "must be a plan, a solution or its file")
    return read_solution(resolve_run(Path(plan)))


def verified(mission: Mission, solution: Solution) -> Solution:
    """A solution with its verification."""
    checked = reintegration.verify(mission, solution)
    return solution.with_verification(checked)


def verify(plan: AnyPlan) -> Verification:
    """Verify a plan without the solver: `ok`, and what `failed`.

    Args:
        plan: to verify; a solution, or its file.

    Returns:
        The verification: `ok`, what `failed`, and every figure that was checked, in SI.

    Raises:
        InputError: if it is no plan and no file of one.

    Examples:
        >>> import scp_recon as sr
        >>> sr.verify(sr.plan())
        <Verification: verified>
    """
    return reintegration.verify(*open_plan(plan))


def save(plan: AnyPlan, folder: str | Path) -> Path:
    """Verify a plan and write its `solution.json` into a folder, whole or not at all.

    A plan that is not verified does not overwrite a verified one: it is written beside it as
    `solution_unverified.json`. Results of another plan are renamed (`old_montecarlo.json`), and
    its exports moved (`old_export`).

    Args:
        plan: to write; a solution, or its file.
        folder: for the file; it is made.

    Returns:
        The file that was written.

    Raises:
        InputError: if it is no plan and no file of one, or the folder cannot be written.

    Examples:
        >>> import scp_recon as sr
        >>> sr.save(sr.plan(), "runs/mine").name
        'solution.json'
    """
    given = plan if isinstance(plan, Plan) else load(plan)
    path = path_of("folder", folder)
    check_writable(path, FILE_NAME, "folder")
    written = keep(load(given), path, "folder").path
    assert written is not None
    return written


def compare(*plans: AnyPlan) -> comparison.Comparison:
    """Compare plans, solutions or their files; paths are compared with the first one's.

    Args:
        plans: to compare; a solution, or its file.

    Returns:
        A table with a row for each figure: its unit and the value of every plan. A figure is found
            by its name in brackets.

    Raises:
        InputError: if there is none, or one is no plan and no file of a solution.

    Examples:
        >>> import scp_recon as sr
        >>> table = sr.compare(sr.plan(), sr.plan(problem="P3"))
        >>> print(*(f"{dv:.3f} m/s" for dv in table["total delta-v"]))
        0.140 m/s 0.108 m/s
    """
    _require_some(plans)
    names = [
        str(given) if isinstance(given, str | Path) else f"plan {number}"
        for number, given in enumerate(plans, start=1)
    ]
    return comparison.compare(names, [load(given) for given in plans])


def report(
    *plans: AnyPlan,
    out: str | Path = "report.html",
    field_deg: float | None = None,
    pixels: int | None = None,
) -> Path:
    """Write a page that overlays plans; it works offline.

    The folder of a campaign, finished or not, gets its own page, `campaign.html`, and pictures.

    Args:
        plans: one to six, of one body, with the flights and simulations beside their files. Or the
            folder of a campaign.
        out: the file to write, for plans.
        field_deg: full angle of the camera's field of view (default: DARE's, 21).
        pixels: across the field of view (default: DARE's, 5120).

    Returns:
        The file that was written.

    Raises:
        InputError: if one is no plan and no file of a solution, the extra [report] is missing, or the
            file cannot be written.

    Examples:
        >>> import scp_recon as sr
        >>> sr.report(sr.plan(), out="runs/mine.html").name
        'mine.html'
    """
    from scp_recon.reports import write
    from scp_recon.reports.ground import Camera

    write.check_extra()
    _require_some(plans)
    if is_campaign(plans):
        check_of_plans(field_deg=field_deg, pixels=pixels)
        from scp_recon.campaigns.outcome import read_campaign
        from scp_recon.campaigns.page import write_page

        (folder,) = plans
        return write_page(read_campaign(Path(str(folder))))
    usual = Camera()
    camera = Camera(
        number_between(
            option("field_deg"),
            usual.field_deg if field_deg is None else field_deg,
            0.01,
            FIELD_MAX_DEG,
        ),
        whole_number(option("pixels"), usual.pixels if pixels is None else pixels, 1, PIXELS_MAX),
    )
    return write.write_report(_shown(plans), path_of(option("out"), out), camera)


def charts(*plans: AnyPlan) -> dict[str, Figure]:
    """Draw the charts of `report`, for a notebook: Plotly's figures by name.

    "flight" is the 3-D view at the middle of the observation window. With feedback there are also
    "knowledge" and dispersion over time, "ellipses" before and after each correction, and the
    distribution of the "commanded" delta-v.

    Args:
        plans: one to six, of one body; what lies beside a plan's file is shown with it.

    Returns:
        Figures of Plotly by name, with units on their axes.

    Raises:
        InputError: if one is no plan and no file of a solution, or the extra [report] is missing.

    Examples:
        >>> import scp_recon as sr
        >>> sorted(sr.charts(sr.plan()))[:3]
        ['budget', 'convergence', 'flight']
    """
    from scp_recon.reports import write

    _require_some(plans)
    return write.charts_of([solution_of(p) if isinstance(p, Plan) else p for p in _shown(plans)])


def _shown(plans: tuple[AnyPlan, ...]) -> list[Solution | Path]:
    return [load(p) if isinstance(p, Plan | Solution) else Path(p) for p in plans]


def is_campaign(plans: tuple[AnyPlan, ...]) -> bool:
    """Whether the argument is the folder of a campaign."""
    return (
        len(plans) == 1
        and isinstance(plans[0], str | Path)
        and (Path(plans[0]) / CAMPAIGN).is_file()
    )


def check_of_plans(**given: object) -> None:
    """Refuse what says how to write the page of plans where it is the page of a campaign."""
    for name, value in given.items():
        if value is not None:
            raise InputError(option(name), str(value), "goes with plans, not with a campaign")


def _require_some(plans: tuple[object, ...]) -> None:
    if not plans:
        raise InputError("plans", "none", "must be one or more")
    for given in plans:
        if not isinstance(given, Plan | Solution | str | Path):
            raise InputError("plan", shortened(given), "must be a plan, a solution or its file")


class Exported(NamedTuple):
    """The files of an export.

    Attributes:
        files: paths of the files.
        export: verdict, frame, path and burns, as in the files' headings.
    """

    files: list[Path]
    export: Export

    def __repr__(self) -> str:
        """One line."""
        return f"<Exported: {', '.join(file.name for file in self.files)}>"


def export(
    plan: AnyPlan,
    format: str,  # noqa: A002 -- as the command line and every other tool has it
    out: str | Path = "export",
    *,
    spacecraft: int = -999,
    vehicle: str | Path | None = None,
) -> Exported:
    """Write a plan for other tools, sampled densely enough for their interpolation.

    Args:
        plan: to write.
        format: "oem" (CCSDS, with an OPM of the burns), "spk" or "ck" (SPICE kernels of the path, or of
            the attitude; the extra [spice]), "csv" or "parquet" (a table; the extra [parquet]).
        out: folder for the files.
        spacecraft: NAIF's number of the spacecraft, below zero; as --spacecraft=-64 on the command
            line.
        vehicle: a TOML file, for "ck" (default: the packaged DARE).

    Returns:
        The files that were written, and the content of their headings.

    Raises:
        InputError: naming the argument, what was given and what is allowed.

    Examples:
        >>> import scp_recon as sr
        >>> files, _ = sr.export(sr.plan(), "csv", "runs/mine/export")
        >>> [file.suffix for file in files]
        ['.csv']
    """
    one_of(option("format"), format, FORMATS)
    spacecraft = whole_number(option("spacecraft"), spacecraft, SPACECRAFT_MIN, -1)
    require(format)
    if vehicle is not None and format != "ck":
        raise InputError(option("vehicle"), str(vehicle), f"goes with {option('format')} ck")
    craft = load_vehicle(None if vehicle is None else path_of(option("vehicle"), vehicle))
    found, place = export_of(plan, spacecraft), path_of(option("out"), out)
    check_writable(place, f"{stem(found)}.{format}", option("out"))
    try:
        return Exported(write_export(found, format, place, craft), found)
    except OSError as error:
        raise unwritable(place, option("out"), error) from None


def export_of(plan: AnyPlan, spacecraft: int = -999) -> Export:
    """Fly a plan's burns again, sampled for other tools."""
    mission, solution = open_plan(plan)
    ids = Ids(spacecraft, mission.scenario.body.naif_id or UNNAMED_BODY_ID)
    return Export(solution, mission, fly_path(mission, solution), ids)
