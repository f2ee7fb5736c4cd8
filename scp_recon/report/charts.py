"""The report's charts as Plotly's figures, but the 3-D view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from scp_recon.report.content import palette
from scp_recon.report.content.achieved import SO_FAR, Achieved
from scp_recon.report.content.budget import Budget
from scp_recon.report.content.ground import degrees_of, site_degrees, terminator
from scp_recon.report.content.histories import Bound
from scp_recon.report.content.numbers import significant
from scp_recon.report.content.subject import Subject
from scp_recon.report.panels import (
    Trace,
    axis_name,
    band,
    chart,
    curve,
    limit_line,
    shade_window,
    stacked,
)
from scp_recon.report.view.frame import Shown

LEVELS = 3
"""Heights at which burns are named."""
OUTLINES_SHOWN = 5
"""Of the field of view, over the window."""
CONVERGENCE = (
    ("merit (m/s)", ("merit",)),
    ("change of merit (m/s)", ("predicted", "actual")),
    ("violation, defect (m)", ("max_violation", "max_defect")),
    ("trust radius (m/s)", ("trust_radius",)),
)
LEAST = 1e-13
"""Below this, logarithmic axes show nothing."""


def probability_chart(named: Sequence[tuple[Subject, Sequence[Achieved]]]) -> dict[str, Any]:
    """Of every joint constraint, and of all of them so far, with 95 % intervals."""
    layout = stacked(["probability (1)"], panel_px=300)
    alone, data = len(named) == 1, []
    lowest = 1.0
    for number, (subject, found) in enumerate(named):
        asked = subject.solution.scenario.risk.p_chance
        # Several plans are told apart by colour: of each no more than what all of it comes to.
        shown = found if alone else [one for one in found if one.name == SO_FAR]
        for i, one in enumerate(shown):
            colour = (i if alone else number) % len(palette.PLANS)
            name = one.name if alone else f"{subject.name}: {one.name}"
            edges = (one.low, one.high)
            data += band(one.times_s, edges, name, colour, 0, 0.2, legend=False)
            data.append(curve(one.times_s, one.value, name, colour))
            lowest = min(lowest, float(one.low.min()))
        lowest = min(lowest, asked)
        limit_line(layout, Bound("asked: at least", asked), 0)
    shade_window(layout, named[0][0].mission.schedule.window_s, 1)
    layout["yaxis"]["range"] = [max(0.0, lowest - 0.06), 1.02]
    return chart("probability", "Probability achieved over time", data, layout)


def ground_chart(shown: Sequence[Shown]) -> dict[str, Any]:
    """Points below the spacecraft, the site, the field of view on the ground, and the terminator."""
    data: list[Trace] = []
    subject = shown[0].subject
    alone = len(shown) == 1
    for number, one in enumerate(shown):
        track = one.ground
        first, last = one.subject.window_s
        seen = (track.times_s >= first) & (track.times_s <= last)
        jumps = np.abs(np.diff(track.longitude_deg, append=track.longitude_deg[-1])) > 180.0
        longitude = np.where(jumps, np.nan, track.longitude_deg)
        name = "below the spacecraft" if alone else one.subject.name
        data.append(curve(longitude, track.latitude_deg, name, number))
        if seen.any():
            within = curve(longitude[seen], track.latitude_deg[seen], f"{name}, window", number)
            data.append(within | {"line": {"color": palette.PLANS[number], "width": 6}})
            data += _outlines(one, number, alone=alone)
    marker = {"symbol": "star", "size": 14, "color": palette.SITE, "line": {"width": 1}}
    sites = {site_degrees(one.subject): one.subject.mission.scenario.site.name for one in shown}
    data += [_points([x], [y], f"site {name}", marker) for (x, y), name in sites.items()]
    middle = float(np.mean(subject.mission.schedule.window_s))
    dark = curve(*terminator(subject, middle), "terminator at mid-window, of a sphere", 0)
    data.append(dark | {"line": {"color": palette.GREY, "dash": "dot", "width": 2}})
    now = {"symbol": "circle-open", "size": 13, "color": palette.VIEW, "line": {"width": 3}}
    data.append(_points([None], [None], "now", now) | {"meta": {"now": 0}})
    layout = stacked(["latitude (deg)"], "east longitude (deg)", panel_px=380)
    layout["hovermode"] = "closest"
    layout["xaxis"] |= {"range": [-180, 180], "dtick": 30}
    layout["yaxis"] |= {"range": [-90, 90], "dtick": 30}
    return chart("ground", "Ground track and field of view", data, layout)


def _points(x: list[Any], y: list[Any], name: str, marker: dict[str, Any]) -> Trace:
    return {"type": "scatter", "mode": "markers", "name": name, "x": x, "y": y, "marker": marker}


def _outlines(one: Shown, number: int, *, alone: bool) -> list[Trace]:
    """Some outlines of the field of view, broken where it leaves the body or the map."""
    chosen = np.linspace(0, len(one.ground.looks_s) - 1, OUTLINES_SHOWN).astype(int)
    x: list[float] = []
    y: list[float] = []
    for outline in one.ground.outlines_m[chosen]:
        longitude, latitude = degrees_of(np.vstack([outline, outline[:1]]))
        jumps = np.abs(np.diff(longitude, append=longitude[-1])) > 180.0
        x += [*np.where(jumps, np.nan, longitude).tolist(), np.nan]
        y += [*latitude.tolist(), np.nan]
    name = "field of view" if alone else f"{one.subject.name}: field of view"
    trace = curve(x, y, name, number)
    return [trace | {"line": {"color": palette.VIEW, "width": 1.5, "dash": palette.DASHES[number]}}]


def timeline_chart(subjects: Sequence[Subject]) -> dict[str, Any]:
    """Attitude modes, the burns above them, and where each burn may be moved."""
    data: list[Trace] = []
    layout = stacked(["attitude modes and burns"], panel_px=max(170, 140 * len(subjects)))
    # Modes in the legend, each by the first plan that has it: an empty bar would not be there.
    told: set[str] = set()
    for row, subject in enumerate(reversed(subjects)):
        schedule = subject.mission.schedule
        for mode, colour in palette.MODES.items():
            legs = [leg for leg in schedule.legs if leg.mode == mode and leg.end_s > leg.start_s]
            data.append(
                {
                    "type": "bar",
                    "orientation": "h",
                    "name": mode,
                    "legendgroup": mode,
                    "showlegend": bool(legs) and mode not in told,
                    "y": [row] * len(legs),
                    "base": [leg.start_s for leg in legs],
                    "x": [leg.end_s - leg.start_s for leg in legs],
                    "width": 0.34,
                    "marker": {"color": colour, "line": {"width": 1, "color": "#ffffff"}},
                    "hovertemplate": f"{mode}: %{{base:.0f}} s for %{{x:.0f}} s<extra></extra>",
                }
            )
            if legs:
                told.add(mode)
        data += _burn_marks(subject, row)
    names = [subject.name for subject in reversed(subjects)]
    layout["yaxis"] |= {
        "tickvals": list(range(len(names))),
        "ticktext": names if len(names) > 1 else [""],
        "range": [-0.25, len(names) - 0.15],
        "automargin": True,
        "showgrid": False,
        "zeroline": False,
    }
    layout["hovermode"] = "closest"
    layout["barmode"] = "overlay"
    return chart("timeline", "Attitude modes under the burns", data, layout)


def _burn_marks(subject: Subject, row: int) -> list[Trace]:
    burns, sizes = subject.solution.burns, np.linalg.norm(subject.solution.burns_m_s, axis=1)
    end, first = float(subject.nodes_s[-1]), 1 + subject.solution.scenario.burns_flown
    reach: list[float | None] = []
    for low, high in subject.mission.schedule.firing_intervals_s:
        reach += [low, min(high, end), None]
    times = [burn.t_s for burn in burns]
    marks = {
        "type": "scatter",
        "mode": "markers",
        "name": "burn",
        "legendgroup": "burn",
        "showlegend": row == 0,
        "x": times,
        "y": [row + 0.3] * len(burns),
        "marker": {"symbol": "triangle-down", "size": 13, "color": palette.BURN},
        "hovertemplate": "burn at %{x:.0f} s<extra></extra>",
    }
    words = {
        "type": "scatter",
        "mode": "text",
        "showlegend": False,
        "hoverinfo": "skip",
        "x": times,
        # Neighbours stand at different heights, so that on a phone too none lies on another.
        "y": [row + 0.42 + 0.15 * (i % LEVELS) for i in range(len(burns))],
        "text": [f"{i}: {1000.0 * size:.1f} mm/s" for i, size in enumerate(sizes, start=first)],
        "textposition": [
            "middle right" if t < 0.1 * end else "middle left" if t > 0.9 * end else "middle center"
            for t in times
        ],
    }
    moves = {
        "type": "scatter",
        "mode": "lines",
        "name": "where a burn may be moved, the others kept",
        "legendgroup": "moves",
        "showlegend": row == 0,
        "x": reach,
        "y": [row + 0.22] * len(reach),
        "line": {"color": palette.BURN, "width": 4},
        "hoverinfo": "skip",
    }
    return [moves, marks, words]


def budget_chart(named: Sequence[tuple[str, Budget]]) -> dict[str, Any]:
    """Every burn as planned, and what 99 % of its executions stay below."""
    layout = stacked(["delta-v (mm/s)"], "burn", panel_px=260)
    layout["barmode"] = "group"
    last = max(budget.first + len(budget.planned_m_s) for _, budget in named)
    layout["xaxis"] |= {"categoryarray": [f"burn {i}" for i in range(1, last)]}
    data: list[Trace] = []
    for number, (name, budget) in enumerate(named):
        labels = [f"burn {budget.first + i}" for i in range(len(budget.planned_m_s))]
        over = 1000.0 * (budget.high_m_s - budget.planned_m_s)
        data.append(
            {
                "type": "bar",
                "name": "planned; whisker: 99 % of the flights" if len(named) == 1 else name,
                "x": labels,
                "y": significant(1000.0 * budget.planned_m_s),
                "marker": {"color": palette.PLANS[number]},
                "error_y": {
                    "type": "data",
                    "array": significant(over),
                    "arrayminus": [0.0] * len(labels),
                    "symmetric": False,
                    "color": palette.GREY,
                },
            }
        )
    layout["hovermode"] = "closest"
    return chart("budget", "Delta-v of every burn", data, layout)


def convergence_chart(subjects: Sequence[Subject]) -> dict[str, Any]:
    """Merit, its changes, violation and radius by iteration, stages one after the other."""
    layout = stacked([title for title, _ in CONVERGENCE], "iteration, over all stages", 140)
    data: list[Trace] = []
    for number, subject in enumerate(subjects):
        records = subject.solution.iterations
        x = np.arange(1, len(records) + 1)
        words = [f"{r.stage} {r.k}{'' if r.accepted else ', rejected'}" for r in records]
        for panel, (_, keys) in enumerate(CONVERGENCE):
            for other, key in enumerate(keys):
                values = np.array([getattr(record, key) for record in records])
                positive = np.where(np.abs(values) > LEAST, np.abs(values), np.nan)
                said = key.removeprefix("max_").replace("_", " ")
                name = said if len(subjects) == 1 else f"{subject.name}: {said}"
                colour = panel if len(subjects) == 1 else number
                trace = curve(x, positive, name, colour, panel, dash="dot" if other else "solid")
                marker = {"symbol": "x" if other else "circle", "size": 7}
                data.append(trace | {"mode": "lines+markers", "marker": marker, "text": words})
    for panel in range(len(CONVERGENCE)):
        name = axis_name("y", panel).replace("y", "yaxis")
        layout[name] |= {"type": "log", "exponentformat": "power", "nticks": 5}
    return chart("convergence", "Convergence", data, layout)
