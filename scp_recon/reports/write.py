"""Write the pages of plans: the report, whole or not at all, and the page with sliders."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scp_recon.errors import imported, option
from scp_recon.files import PAGE, check_ending, check_own, unwritable, write_atomically
from scp_recon.reports import charts, flight_tables, histories, page, tables
from scp_recon.reports.histories import history_chart
from scp_recon.reports.marks import Chart
from scp_recon.reports.page import Page
from scp_recon.reports.scene import picture, scene
from scp_recon.reports.shown import Camera, Shown, budget_table, plans_of
from scp_recon.results.comparison import compare
from scp_recon.results.solution import Solution
from scp_recon.results.table import Table

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

FILE_NAME, UNVERIFIED_NAME = "report.html", "report_unverified.html"
"""Beside a plan, and beside one that a verified one keeps from its place."""
TITLE_PX, LINE_PX, WIDTH_PX = 34, 29, 800
"""Above a chart that stands alone, for its title; of a further line of its legend, and across it."""
SLIDER_FLIGHTS = 500
"""Flights drawn on the page with sliders, a twentieth of the report's: faster than planning."""
SLIDER_CHARTS = ("observation", "probability", "timeline", "budget")
"""Keys of the charts on the page with sliders."""


def check_extra() -> None:
    """Check before the work that the report can be made.

    Raises:
        InputError: if not.
    """
    imported("report", "report", "plotly", "jinja2")


def write_report(
    given: Sequence[Solution | Path],
    file: Path,
    camera: Camera | None = None,
    now: Callable[[], datetime] = lambda: datetime.now(UTC),
) -> Path:
    """Write the report of some plans.

    Args:
        given: solutions, their files or folders; what lies beside a file of the same plan is shown too.
        file: to write; ends in .html.
        camera: whose view is laid on the ground; DARE's by default.
        now: the clock, UTC.

    Raises:
        InputError: if an extra is missing, a plan cannot be read, or the file cannot be written.
    """
    check_extra()
    check_ending(file, option("out"), ".html", ".htm")
    check_own(file, option("out"), PAGE)
    html = page.render(page_of(plans_of(given, camera), now()))
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        return write_atomically(file, html)
    except OSError as error:
        raise unwritable(file.parent, option("out"), error) from None


def page_of(plans: Sequence[Shown], made: datetime) -> Page:
    """Compute the content of the page."""
    comparison = compare([plan.name for plan in plans], [plan.solution for plan in plans])
    return Page(
        plans=plans,
        tables=[tables_of(plan) for plan in plans],
        comparison=comparison.table if len(plans) > 1 else None,
        scene=scene(plans),
        charts=list(all_charts(plans)),
        made=made,
    )


def charts_of(given: Sequence[Solution | Path]) -> dict[str, Figure]:
    """The page's view in 3-D as a picture, and its charts, by their keys, as figures of Plotly.

    Raises:
        InputError: as `write_report`.
    """
    check_extra()
    plans = plans_of(given)
    return figures_of((picture(plans), *all_charts(plans)))


def figures_of(drawn: Iterable[dict[str, Any]]) -> dict[str, Figure]:
    """Charts by their keys as figures of Plotly, with their titles; nothing follows a page's time."""
    from plotly.graph_objects import Figure

    found = {}
    for one in drawn:
        layout, margin = one["layout"], one["layout"]["margin"]
        data = [trace for trace in one["data"] if "now" not in trace.get("meta", {})]
        named = [trace["name"] for trace in data if trace.get("showlegend", True)]
        lines = sum(45 + 7 * len(name) for name in named) // WIDTH_PX
        room = TITLE_PX + LINE_PX * lines
        title = {"text": one["title"], "x": 0.01, "yref": "container", "y": 1.0, "yanchor": "top"}
        found[one["key"]] = Figure(data, layout).update_layout(
            title=title | {"pad": {"t": 12}},
            height=layout["height"] + room,
            margin=margin | {"t": margin["t"] + room},
        )
    return found


def tables_of(plan: Shown) -> list[Table]:
    """The tables of a plan, those that have any rows."""
    solution, mission, v = plan.solution, plan.mission, plan.solution.verification
    burns, required = tables.burns_table(solution), solution.scenario.risk.p_chance
    total = burns.columns[-1].cell(solution.total_dv_m_s)
    found = [burns.with_rows([["total", "", "", "", "", "", total]])]
    found.append(budget_table(plan.budget, solution.policy is not None))
    found.append(tables.corrections_table(solution))
    if v is not None:
        found += [tables.limits_table(mission, solution, v), tables.burn_limits_table(v, required)]
        found += [tables.drifts_table(v), tables.lost_contacts_table(v)]
    found.append(tables.constraints_table(solution))
    if v is not None:
        found.append(tables.reintegration_table(mission, v))
    found += [tables.stages_table(solution), tables.iterations_table(solution)]
    if plan.summary is not None:
        found.append(flight_tables.observation_times_table(plan.summary))
    found.append(flight_tables.missed_burns_table(plan.missed))
    if plan.record is not None:
        flown = plan.record.summary
        found += [flight_tables.simulated_burns_table(flown), flight_tables.simulated_table(flown)]
    return [each for each in found if each.rows]


def all_charts(plans: Sequence[Shown]) -> Iterator[Chart]:
    """All charts of the page, in order."""
    observes = any(len(plan.flown.window) for plan in plans)  # none does after the window
    if observes:
        yield history_chart("observation", plans, histories.observation_histories)
    yield histories.probability_chart(plans)
    yield history_chart("ranges", plans, histories.range_histories, marked=True)
    yield history_chart("lighting", plans, histories.lighting_histories, marked=True)
    yield charts.ground_chart(plans)
    if observes:
        yield history_chart("resolution", plans, histories.resolution_histories)
    yield charts.timeline_chart(plans)
    yield charts.budget_chart(plans)
    if corrected := list(filter(histories.is_corrected, plans)):
        yield histories.knowledge_chart(corrected)
        yield charts.commanded_chart(corrected)
    if (simulated := charts.craft_chart(plans)) is not None:
        yield simulated
    yield charts.convergence_chart(plans)


def slider_plan(solution: Solution) -> Shown:
    """The content of the page with sliders."""
    return Shown(solution.scenario.name, solution, samples=SLIDER_FLIGHTS)


def slider_data(shown: Shown) -> dict[str, Any]:
    """Data of a plan for the scripts of the page with sliders: the 3-D view and some charts."""
    chosen = [chart for chart in all_charts([shown]) if chart["key"] in SLIDER_CHARTS]
    return page.script_data(scene([shown]), chosen, shown.solution)


def slider_verdict(shown: Shown, solution: Solution) -> str:
    """HTML of the verdict on a shown plan, whose solution may have been verified since.

    It has no advice, which is for commands: the page has controls of its own.
    """
    verdict = page.verdict_of(replace(shown, solution=solution))._replace(advice=())
    return page.render_part("verdicts.html", verdicts=[verdict], names=[shown.name])


def slider_page(shown: Shown, sliders: Sequence[Any], answer: dict[str, Any]) -> str:
    """HTML of the page with sliders.

    Args:
        shown: the plan shown first.
        sliders: of `api.exploring`.
        answer: the answer for that plan; `drawn` has the data to draw.
    """
    data = answer["drawn"]
    by_group = {group: list(own) for group, own in groupby(sliders, lambda slider: slider.group)}
    return page.render_offline(
        "explore.html",
        ("report.js", "explore.js"),
        data | {"answer": answer | {"drawn": None}},
        title=shown.name,
        sliders=by_group,
        feedback=shown.solution.scenario.policy.kind == "feedback",
        first=shown,
        charts=data["charts"],
        groups=page.groups_of(data["scene"]),
        identity="",
    )
