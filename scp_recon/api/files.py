"""Read, save, show and export plans: what the functions of `api.plan_verbs` do with files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from scp_recon.api.keeping import check_folder, keep
from scp_recon.errors import (
    InputError,
    number_between,
    one_of,
    option,
    path_of,
    shortened,
    whole_number,
)
from scp_recon.files import check_writable, writing
from scp_recon.interop.export import Export
from scp_recon.interop.files import FORMATS, require, stem, write_export
from scp_recon.jobs.cores import one_thread
from scp_recon.planning.plan import Plan
from scp_recon.results.read import read_solution
from scp_recon.results.runs import resolve_run
from scp_recon.results.solution import Solution, make_solution
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


def solution_of(given: AnyPlan) -> Solution:
    """The solution of a plan; a plan that was not verified stays so.

    Raises:
        InputError: if it is no plan and no file of one.
    """
    return make_solution(given) if isinstance(given, Plan) else stored(given)


def stored(plan: AnyPlan) -> Solution:
    """See `plan_verbs.load`."""
    if isinstance(plan, Plan):
        return verified(make_solution(plan))
    if isinstance(plan, Solution):
        return plan
    require_some((plan,))
    return read_solution(resolve_run(Path(plan)))


@one_thread
def verified(solution: Solution) -> Solution:
    """A solution with its verification, without the solver."""
    return solution.with_verification(reintegration.verify(solution.mission, solution))


def save(plan: AnyPlan, folder: str | Path) -> Path:
    """See `plan_verbs.save`."""
    given = plan if isinstance(plan, Plan) else stored(plan)
    path = path_of("folder", folder)
    check_folder(path, "folder")
    written = keep(stored(given), path, "folder").path
    assert written is not None
    return written


def write_page_of(
    plans: tuple[AnyPlan, ...], out: str | Path, field_deg: float | None, pixels: int | None
) -> Path:
    """See `plan_verbs.report`."""
    from scp_recon.reports import write
    from scp_recon.reports.shown import Camera

    write.check_extra()
    require_some(plans)
    if is_campaign(plans):
        check_of_plans(field_deg=field_deg, pixels=pixels)
        from scp_recon.campaigns.outcome import read_campaign
        from scp_recon.campaigns.page import write_page

        return write_page(read_campaign(Path(str(plans[0]))))
    field, across = Camera().field_deg, Camera().pixels
    if field_deg is not None:
        field = number_between(option("field_deg"), field_deg, 0.01, FIELD_MAX_DEG)
    if pixels is not None:
        across = whole_number(option("pixels"), pixels, 1, PIXELS_MAX)
    return write.write_report(_shown(plans), path_of(option("out"), out), Camera(field, across))


def charts_of(plans: tuple[AnyPlan, ...]) -> dict[str, Figure]:
    """See `plan_verbs.charts`."""
    from scp_recon.reports import write

    require_some(plans)
    return write.charts_of([solution_of(p) if isinstance(p, Plan) else p for p in _shown(plans)])


def _shown(plans: tuple[AnyPlan, ...]) -> list[Solution | Path]:
    return [stored(p) if isinstance(p, Plan | Solution) else Path(p) for p in plans]


def is_campaign(plans: tuple[AnyPlan, ...]) -> bool:
    """Whether the argument is the folder of a campaign."""
    given = plans[0]
    return len(plans) == 1 and isinstance(given, str | Path) and (Path(given) / CAMPAIGN).is_file()


def check_of_plans(**given: object) -> None:
    """Refuse what says how to write the page of plans where it is the page of a campaign."""
    for name, value in given.items():
        if value is not None:
            raise InputError(option(name), str(value), "goes with plans, not with a campaign")


def require_some(plans: tuple[object, ...]) -> None:
    """Refuse no plans, and what is no plan.

    Raises:
        InputError: if there are none, or one is no plan and no file of one.
    """
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


def write_export_of(
    plan: AnyPlan,
    form: str,
    out: str | Path,
    spacecraft: int,
    vehicle: str | Path | None,
    miss: int | None,
) -> Exported:
    """See `plan_verbs.export`."""
    one_of(option("format"), form, FORMATS)
    spacecraft = whole_number(option("spacecraft"), spacecraft, SPACECRAFT_MIN, -1)
    require(form)
    if vehicle is not None and form != "ck":
        raise InputError(option("vehicle"), str(vehicle), f"goes with {option('format')} ck")
    if miss is not None and form == "ck":
        raise InputError(
            option("miss"), str(miss), f"goes with a path, not with {option('format')} ck"
        )
    craft = load_vehicle(None if vehicle is None else path_of(option("vehicle"), vehicle))
    found, place = Export.of(solution_of(plan), spacecraft, miss), path_of(option("out"), out)
    check_writable(place, f"{stem(found)}.{form}", option("out"))
    with writing(place, option("out")):
        return Exported(write_export(found, form, place, craft), found)
