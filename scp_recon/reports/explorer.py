"""Draw a plan for the page with sliders: the 3-D view and some charts, with few flights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from scp_recon.reports import page
from scp_recon.reports.flights import Shown
from scp_recon.reports.ground import Camera
from scp_recon.reports.scene import scene
from scp_recon.reports.subject import Subject
from scp_recon.reports.surfaces import shape_of
from scp_recon.reports.write import all_charts
from scp_recon.results.solution import Solution

SAMPLES = 500
"""Flights that are drawn, a twentieth of the report's: they take less time than the plan itself."""
CHARTS = ("observation", "probability", "timeline", "budget")


def shown_of(solution: Solution) -> Shown:
    """Fly a plan, and compute the content of the page."""
    scenario = solution.scenario
    subject = Subject(scenario.name, solution)
    return Shown.of(subject, shape_of(scenario), Camera(), SAMPLES)


def drawn(shown: Shown) -> dict[str, Any]:
    """Data of a plan for the report's script."""
    charts = [chart for chart in all_charts([shown]) if chart["key"] in CHARTS]
    return page.script_data(scene([shown], shown.shape), charts, shown.subject.solution)


def verdict(shown: Shown, solution: Solution) -> str:
    """HTML of the verdict on a shown plan, whose solution may have been verified since."""
    subject = replace(shown.subject, solution=solution)
    verdicts = [page.verdict_of(replace(shown, subject=subject))]
    return page.render_part("verdicts.html", verdicts=verdicts, names=[subject.name])


def render(shown: Shown, sliders: Sequence[Any], answer: dict[str, Any]) -> str:
    """Write the page.

    Args:
        shown: the plan shown first.
        sliders: of `api.exploring`.
        answer: the answer for that plan; `drawn` has the data to draw.
    """
    data = answer["drawn"]
    by_group: dict[str, list[Any]] = {}
    for slider in sliders:
        by_group.setdefault(slider.group, []).append(slider)
    return page.render_offline(
        "explore.html",
        ("report.js", "explore.js"),
        data | {"answer": answer | {"drawn": None}},
        title=shown.subject.name,
        sliders=by_group,
        feedback=shown.subject.solution.scenario.policy.kind == "feedback",
        first=shown,
        charts=data["charts"],
        groups=page.groups_of(data["scene"]),
        notes=page.NOTES,
        identity="",
    )
