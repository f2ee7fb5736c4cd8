"""The page: what stands on it, and how it becomes one HTML file."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from scp_recon.physics.time_scales import instant, iso_utc, shown_utc
from scp_recon.report.content.subject import Subject
from scp_recon.report.offline import render_offline
from scp_recon.report.table import Table
from scp_recon.report.verdict import Verdict

SHOWN = 12
"""Digits of a plan's hash on a sheet."""
CURSORS = ("observation", "probability", "ranges", "lighting", "resolution", "timeline", "craft")
"""Charts over time, in which the time that the view shows is marked."""
NOTES = {
    "observation": "Line: planned mean. Bands: where 68.3 % and 95.4 % of the sampled flights are. "
    "Dashed: limits.",
    "probability": "Of sampled flights, with 95 % intervals. Shaded: observation window.",
    "ranges": "To the surface along the line to the centre. Bands: 1 and 3 sigma (99.7 %) of the "
    "sampled flights. Shaded: observation window.",
    "lighting": "Certain: both follow from the body's rotation alone. Shaded: observation window.",
    "ground": "Planned mean, body-fixed. Outlines: field of view at five times of the window, the "
    "camera pointed to the site. Ring: the time that the 3-D view shows.",
    "resolution": "Ground that a pixel sees at the site; along the slope it is stretched by the "
    "emission angle. Bands: 68.3 % and 95.4 % of the flights.",
    "timeline": "Triangles: burns. Lines below them: where each may be moved, the others kept.",
    "budget": "Bars: planned. Whiskers: what 99 % of the executions stay below.",
    "craft": "One flight of the spacecraft's simulation. Shaded: observation window.",
    "convergence": "Magnitudes. Hover names stage and iteration.",
}


@dataclass(frozen=True, eq=False)
class Page:
    """Everything on it.

    Attributes:
        subjects: plans.
        verdicts: of each.
        tables: of each.
        comparison: of several.
        scene: the 3-D view.
        charts: the others, in their order.
        body: what is drawn of the body.
        camera: whose view is drawn.
        samples: flights behind bands and probabilities.
        made: when the page was made, UTC.
    """

    subjects: tuple[Subject, ...]
    verdicts: tuple[Verdict, ...]
    tables: tuple[tuple[Table, ...], ...]
    comparison: Table | None
    scene: dict[str, Any]
    charts: tuple[dict[str, Any], ...]
    body: str
    camera: str
    samples: int
    made: datetime


def version_of_planner() -> str:
    """As installed; unknown where it only lies on the path."""
    try:
        return version("scp_recon")
    except PackageNotFoundError:
        return "unknown"


def identity(page: Page) -> str:
    """What every sheet says: scenarios, their epochs in UTC, plans, version, and when it was made."""
    plans = "; ".join(
        f"{s.solution.scenario.name}, "
        f"t = 0 at {shown_utc(instant(s.solution.scenario.epoch.tdb))} UTC, "
        f"plan {s.solution.plan_hash[:SHOWN]}"
        for s in page.subjects
    )
    return f"{plans} | scp_recon {version_of_planner()} | made {page.made:%Y-%m-%d %H:%M:%S} UTC"


def render(page: Page) -> str:
    """One HTML file that needs nothing else."""
    first = page.subjects[0]
    data = {
        "scene": page.scene,
        "charts": page.charts,
        "cursors": CURSORS,
        "epoch_utc": iso_utc(instant(first.solution.scenario.epoch.tdb))[:23] + "Z",
        "file": f"{first.solution.scenario.name}-{first.solution.plan_hash[:SHOWN]}",
    }
    names = [subject.name for subject in page.subjects]
    return render_offline(
        "page.html",
        "report.js",
        data,
        page=page,
        names=names,
        title=", ".join(dict.fromkeys(s.solution.scenario.name for s in page.subjects)),
        identity=identity(page),
        notes=NOTES,
        groups=_groups(page),
    )


def _groups(page: Page) -> list[tuple[str, bool, str]]:
    """What may be shown and hidden in the view: name, whether it is shown at first, and colour."""
    found: dict[str, tuple[bool, str]] = {}
    for trace in page.scene["traces"]:
        shown = trace.get("visible", True) is not False
        colour = trace.get("color") or trace.get("line", {}).get("color") or "#b9b09e"
        found.setdefault(trace["meta"]["group"], (shown, colour))
    return [(name, shown, colour) for name, (shown, colour) in found.items()]
