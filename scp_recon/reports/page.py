"""Render verdicts, charts and tables as one HTML file that needs no network."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from formulations.rows.exact_flight import FLIGHT
from scp_recon.display import digits, mm_s
from scp_recon.errors import version_of
from scp_recon.mission.constraints import required_in_words
from scp_recon.planning.plan import NOT_CHECKED
from scp_recon.reports.marks import BODY, TIME, Chart, script
from scp_recon.reports.shown import SO_FAR, Shown
from scp_recon.results.solution import Solution
from scp_recon.results.table import Table
from scp_recon.scenario.time_scales import instant, iso_utc, shown_utc
from scp_recon.scp.status import Status
from scp_recon.verification.causes import in_doubt, next_lines

if TYPE_CHECKING:
    from jinja2 import Environment

OWN = "scp_recon.reports"
SHOWN = 12
"""Digits of a plan's hash on a sheet."""


class Verdict(NamedTuple):
    """The head of the page, in words: probability required and achieved, delta-v; what to do next."""

    good: bool
    word: str
    required: str
    achieved: str
    cost: str
    remarks: tuple[str, ...]
    advice: tuple[str, ...]


def verdict_of(plan: Shown) -> Verdict:
    """The verdict on a plan; one that was not verified is judged by the sampled flights."""
    solution = plan.solution
    checked, status = solution.verification, Status.named(solution.status)
    good = checked is not None and checked.ok and status is Status.CONVERGED
    return Verdict(
        good,
        NOT_CHECKED if checked is None else checked.verdict,
        required_in_words(solution.scenario)
        if solution.problem == "P2"
        else "no probability (P3: the problem without uncertainty)",
        _achieved(plan),
        f"{mm_s(solution.total_dv_m_s)} in {len(solution.executed)} burns; 99 % of the "
        f"flights execute at most {mm_s(plan.budget.total_high_m_s)}",
        _remarks(plan, status),
        () if checked is None else next_lines(plan.mission, solution, checked),
    )


def _achieved(plan: Shown) -> str:
    solution = plan.solution
    whole = solution.scenario.risk.scope == "flight"
    checked, by = solution.verification, "sampled flights"
    if whole and solution.risk is not None and solution.risk.certificate is not None:
        test = solution.risk.certificate
        return (
            f"{test.reached:.4f} of whole flights ({test.interval}, by the certificate's flights)"
        )
    if checked is not None and checked.probabilities:
        chosen = [p for p in checked.probabilities if (p.name == FLIGHT) == whole]
        p = min(chosen or checked.probabilities, key=lambda p: p.estimate)
        name, at, value, low, high = p.name, p.worst_t_s, p.estimate, p.low, p.high
        by = f"{checked.samples} flights"
    else:
        fitting = (one for one in plan.achieved if (one.name == SO_FAR) == whole)
        one = min(fitting, key=lambda one: one.value.min())
        name, worst = one.name, int(np.argmin(one.value))
        at, value, low, high = (x[worst] for x in (one.times_s, one.value, one.low, one.high))
    interval = f"(95 % interval {low:.4f} to {high:.4f}, by {by})"
    if whole:
        return f"{value:.4f} of whole flights {interval}"
    return f"{value:.4f} where it is least, {name} at {at:.0f} s {interval}"


def _remarks(plan: Shown, status: Status) -> tuple[str, ...]:
    solution = plan.solution
    said = [] if status is Status.CONVERGED else [status.value.message]
    said += [
        f"{name}: violated by up to {digits(amount.max, 4)} {amount.unit}"
        for name, amount in solution.violation.by_constraint.items()
    ]
    said += [words for words in (solution.cost_in_words, solution.by_policy) if words]
    risk = solution.risk
    if risk is not None:
        law = "not certified by flights: the normal law alone promises the probability"
        said.append(f"certificate: {risk.certificate}" if risk.certificate else law)
    warned = [*solution.warnings, *plan.mission.warnings]
    said += [f"warning: {one}" for one in in_doubt(solution, solution.verification, warned)]
    return (*said, *plan.passed_over)


class Page(NamedTuple):
    """Everything on it; tables are one tuple a plan, charts in their order, `made` is UTC."""

    plans: Sequence[Shown]
    tables: Sequence[Sequence[Table]]
    comparison: Table | None
    scene: dict[str, Any]
    charts: Sequence[Chart]
    made: datetime


def render(page: Page) -> str:
    """Render a page as one HTML file that needs no other file.

    At the foot of each sheet stand scenarios, their epochs in UTC, plans, version and time of making.
    """
    solutions = [plan.solution for plan in page.plans]
    plans = "; ".join(
        f"{s.scenario.name}, t = 0 at {shown_utc(instant(s.scenario.epoch.tdb))} UTC, "
        f"plan {s.plan_hash[:SHOWN]}"
        for s in solutions
    )
    return render_offline(
        "page.html",
        ("report.js",),
        script_data(page.scene, page.charts, solutions[0]),
        page=page,
        charts=page.charts,
        first=page.plans[0],
        names=[plan.name for plan in page.plans],
        verdicts=map(verdict_of, page.plans),
        title=", ".join(dict.fromkeys(s.scenario.name for s in solutions)),
        identity=f"{plans} | {made_by(page.made)}",
        groups=groups_of(page.scene),
    )


def script_data(scene: dict[str, Any], charts: Sequence[Chart], first: Solution) -> dict[str, Any]:
    """Data that `report.js` draws; `first` is the first plan. It marks the time in charts over time."""
    return {
        "scene": scene,
        "charts": charts,
        "cursors": [c["key"] for c in charts if c["layout"]["xaxis"]["title"]["text"] == TIME],
        "epoch_utc": iso_utc(instant(first.scenario.epoch.tdb))[:23] + "Z",
        "file": f"{first.scenario.name}-{first.plan_hash[:SHOWN]}",
    }


def groups_of(scene: dict[str, Any]) -> list[tuple[str, bool, str]]:
    """Groups of traces that the view shows and hides: name, whether shown at first, colour."""
    found: dict[str, tuple[bool, str]] = {}
    for trace in scene["traces"]:
        shown = trace.get("visible", True) is not False
        parts = trace, trace.get("line", {}), trace.get("marker", {})
        colour = next(filter(None, (part.get("color") for part in parts)), BODY)
        found.setdefault(trace["meta"]["group"], (shown, colour))
    return [(name, shown, colour) for name, (shown, colour) in found.items()]


def made_by(made: datetime) -> str:
    """Program, version and time of making."""
    return f"scp_recon {version_of('scp_recon')} | made {made:%Y-%m-%d %H:%M:%S} UTC"


def render_offline(
    template: str, javascript: Sequence[str], data: Any, package: str = OWN, **shown: Any
) -> str:
    """A template's HTML with all that it needs; its charts are begun once it can be read.

    Template and scripts are files in the package's `page_files`; the style and `scripts.html` are the
    report's. The scripts are given `data`, the template what is `shown`.
    """
    pages = _pages(package)

    def text(name: str) -> str:
        assert pages.loader is not None
        return pages.loader.get_source(pages, name)[0]

    return pages.get_template(template).render(
        **shown,
        css=text("report.css"),
        js="\n".join(map(text, javascript)),
        plotly=plotly_script(),
        data=script(data),
    )


def render_part(template: str, **shown: Any) -> str:
    """The HTML of a part of the report's page."""
    return _pages(OWN).get_template(template).render(**shown)


@cache
def _pages(package: str) -> Environment:
    """Templates of a package and of the report."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=ChoiceLoader([PackageLoader(name, "page_files") for name in (package, OWN)]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def plotly_script() -> str:
    """Plotly's script without the loader about it.

    The loader takes the whole script as one function. A browser would parse that function twice:
    once to find its end, once to run it.
    """
    from plotly.offline import get_plotlyjs

    whole = get_plotlyjs()
    bare = re.search(r'"use strict";var Plotly=.*window\.Plotly = Plotly;', whole, re.DOTALL)
    return whole if bare is None else whole[: whole.index("*/") + 2] + bare[0]
