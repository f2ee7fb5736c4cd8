"""From plans to the file: everything worked out, put on the page, written whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from scp_recon.errors import InputError, needing
from scp_recon.files import unwritable, write_atomically
from scp_recon.report import charts, tables
from scp_recon.report.content.achieved import achieved
from scp_recon.report.content.budget import budget_of
from scp_recon.report.content.camera import Camera
from scp_recon.report.content.flown import fly
from scp_recon.report.content.ground import ground_track
from scp_recon.report.content.histories import (
    lighting_histories,
    observation_histories,
    range_histories,
    resolution_history,
)
from scp_recon.report.content.shape import shape_of
from scp_recon.report.content.subject import Subject, subjects_of
from scp_recon.report.craft import craft_chart
from scp_recon.report.page import Page, render
from scp_recon.report.panels import history_chart
from scp_recon.report.verdict import verdict_of
from scp_recon.report.view.frame import Shown
from scp_recon.report.view.scene import scene
from scp_recon.solution.file import Solution

FILE_NAME, UNVERIFIED_NAME = "report.html", "report_unverified.html"
"""Beside a plan, and beside one that a verified one keeps from its place."""
ENTRY = "report"


def check_extra() -> None:
    """Find out before the work whether the report can be made.

    Raises:
        InputError: if not.
    """
    with needing(ENTRY, "report", "plotly", "jinja2"):
        import jinja2  # noqa: F401 -- whether it is there
        import plotly  # noqa: F401 -- whether it is there


def write_report(
    given: Sequence[Solution | Path],
    file: Path,
    camera: Camera | None = None,
    now: Callable[[], datetime] = lambda: datetime.now(UTC),
) -> Path:
    """Write the report of some plans.

    Args:
        given: solutions, their files or folders; what lies beside a file of the same plan is shown too.
        file: to write.
        camera: whose view is laid on the ground.
        now: the clock.

    Raises:
        InputError: if an extra is missing, a plan cannot be read, or the file cannot be written.
    """
    check_extra()
    if file.is_dir() or file.suffix.lower() not in (".html", ".htm"):
        raise InputError("--out", str(file), "must be a file that ends in .html")
    page = page_of(subjects_of(given), camera or Camera(), now())
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        return write_atomically(file, render(page))
    except OSError as error:
        raise unwritable(file.parent, "--out", error) from None


def page_of(subjects: Sequence[Subject], camera: Camera, made: datetime) -> Page:
    """All that the page shows."""
    shape = shape_of(subjects[0].solution.scenario)
    shown = [Shown(s, fly(s), ground_track(s, shape, camera)) for s in subjects]
    found = [achieved(one.subject, one.flown) for one in shown]
    budgets = [budget_of(one.subject, one.flown) for one in shown]
    return Page(
        subjects=tuple(subjects),
        verdicts=tuple(
            verdict_of(subject, each, budget.total_high_m_s)
            for subject, each, budget in zip(subjects, found, budgets, strict=True)
        ),
        tables=tuple(
            tuple(tables.tables_of(subject, budget))
            for subject, budget in zip(subjects, budgets, strict=True)
        ),
        comparison=tables.comparison_table(subjects) if len(subjects) > 1 else None,
        scene=scene(shown, shape),
        charts=tuple(_charts(shown, found, budgets, shape, camera)),
        body=shape.told,
        camera=str(camera),
        samples=shown[0].flown.samples,
        made=made,
    )


def _charts(
    shown: Sequence[Shown], found: Any, budgets: Any, shape: Any, camera: Camera
) -> Iterator[dict[str, Any]]:
    """In the order of the page."""
    subjects = [one.subject for one in shown]
    window = subjects[0].mission.schedule.window_s
    names = [subject.name for subject in subjects]
    observes = any(len(one.flown.window) for one in shown)  # none does after the window

    def named(of: Callable[[Shown], Any]) -> list[tuple[str, Any]]:
        return [(one.subject.name, of(one)) for one in shown]

    if observes:
        yield history_chart(
            "observation",
            "Constraints of the observation, in the window",
            named(lambda one: observation_histories(one.subject, one.flown)),
        )
    yield charts.probability_chart(list(zip(subjects, found, strict=True)))
    yield history_chart(
        "ranges",
        "Range to the surface and to the centre",
        named(lambda one: range_histories(one.subject, one.flown, shape)),
        window,
    )
    yield history_chart(
        "lighting",
        "Incidence and local solar time at the site",
        named(lambda one: lighting_histories(one.subject)),
        window,
    )
    yield charts.ground_chart(shown)
    if observes:
        yield history_chart(
            "resolution",
            "Resolution at the site, in the window",
            named(lambda one: resolution_history(one.subject, one.flown, camera)),
        )
    yield charts.timeline_chart(subjects)
    yield charts.budget_chart(list(zip(names, budgets, strict=True)))
    simulated = craft_chart(subjects)
    if simulated is not None:
        yield simulated
    yield charts.convergence_chart(subjects)
