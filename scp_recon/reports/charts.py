"""Draw the charts of the report, except the 3-D view, as Plotly's figures."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array
from scp_recon.monte_carlo.summary import Summary
from scp_recon.reports.ground import degrees_of, terminator
from scp_recon.reports.marks import (
    BURN,
    DASHES,
    GREY,
    LOGARITHMIC,
    MODES,
    PLANS,
    SITE,
    VIEW,
    Panels,
    labelled,
    map_axes,
    points,
    significant,
    whiskers,
)
from scp_recon.reports.shown import SO_FAR, History, Shown
from scp_recon.reports.subject import Subject
from scp_recon.reports.tables import called
from scp_recon.simulation.guidance import CONTROL_PERIOD_S
from scp_recon.simulation.record import Record

SHADES = {1: 0.34, 2: 0.2, 3: 0.14}
"""Opacity of a band by its sigmas."""
WORDS = {1: "1 sigma of the flights", 2: "2 sigma", 3: "3 sigma"}
LEVELS = 3
"""Heights at which burns are named."""
OUTLINES_SHOWN = 5
"""Of the field of view, over the window."""
CONVERGENCE = (
    ("merit (mm/s)", ("merit",), 1e3),
    ("change of merit: predicted, and dotted actual (mm/s)", ("predicted", "actual"), 1e3),
    ("violation, and dotted defect (m)", ("max_violation", "max_defect"), 1.0),
    ("trust radius (mm/s)", ("trust_radius",), 1e3),
)
LEAST, LEAST_DEG = 1e-13, 1e-4
"""Below these, logarithmic axes show nothing."""
BINS = 700
"""Parts of the time, of all simulations together, each shown by two points."""
IN_SIMULATION = (
    *("state of charge (%)", "power (W)", "pointing error (deg)"),
    "wheel speed (rad/s)",
)


def history_chart(
    key: str,
    title: str,
    plans: Sequence[Shown],
    of: Callable[[Shown], Sequence[History]],
    *,
    marked: bool = False,
) -> dict[str, Any]:
    """Panels of the histories `of` each plan, those of several laid over each other.

    `marked`: the observation window is marked behind them.
    """
    each = [(plan.subject.name, of(plan)) for plan in plans]
    alone, panels = len(plans) == 1, Panels([history.title for history in each[0][1]])
    if marked:
        panels.window(plans[0].subject.mission.schedule.window_s)
    for number, (name, histories) in enumerate(each):
        for panel, history in enumerate(histories):
            times, first = history.times_s, panel == 0
            for sigmas in sorted(history.bands, reverse=True):
                if alone or sigmas == max(history.bands):
                    said = labelled(name, WORDS[sigmas], alone)
                    edges, shade = history.bands[sigmas], SHADES[sigmas]
                    panels.band(times, edges, said, number, panel, shade, legend=first)
            shown = "plan" if alone else name
            panels.curve(times, history.planned, shown, number, panel, legend=first)
            for limit, value in history.limits:
                panels.limit(limit, value, panel)
    return panels.chart(key, title)


def probability_chart(plans: Sequence[Shown]) -> dict[str, Any]:
    """Probability of every joint constraint, and of all so far, over time with 95 % intervals.

    Of several plans only the latter is shown, to which a probability required at nodes does not apply.
    """
    panels = Panels(["probability (1)"], panel_px=300)
    alone, lowest = len(plans) == 1, 1.0
    for number, plan in enumerate(plans):
        # Several plans are told apart by colour: of each no more than what all of it comes to.
        shown = [one for one in plan.achieved if alone or one.name == SO_FAR]
        for i, one in enumerate(shown):
            colour = (i if alone else number) % len(PLANS)
            name = labelled(plan.subject.name, one.name, alone)
            panels.band(one.times_s, (one.low, one.high), name, colour, 0, 0.2, legend=False)
            panels.curve(one.times_s, one.value, name, colour)
            lowest = min(lowest, float(one.low.min()))
        risk, whole = plan.subject.solution.scenario.risk, "of whole flights"
        said = whole if risk.scope == "flight" else "of each at every node"
        if plan.subject.solution.problem == "P2" and (alone or said == whole):
            lowest = min(lowest, risk.p_chance)
            panels.limit(f"required {said}: at least", risk.p_chance, 0)
    panels.window(plans[0].subject.mission.schedule.window_s)
    panels.y_axis(0, range=[max(0.0, lowest - 0.06), 1.02])
    return panels.chart("probability", "Probability achieved over time")


def ground_chart(shown: Sequence[Shown]) -> dict[str, Any]:
    """Points below the spacecraft, the site, the field of view on the ground, and the terminator."""
    panels = Panels(["latitude (deg)"], panel_px=380)
    subject, alone = shown[0].subject, len(shown) == 1
    for number, one in enumerate(shown):
        track = one.ground
        first, last = one.subject.window_s
        seen = (track.times_s >= first) & (track.times_s <= last)
        longitude = _unbroken(track.longitude_deg)
        name = "below the spacecraft" if alone else one.subject.name
        panels.curve(longitude, track.latitude_deg, name, number)
        if seen.any():
            within = longitude[seen], track.latitude_deg[seen], f"{name}, window"
            panels.curve(*within, number, line={"dash": "solid", "width": 6})
            named = labelled(one.subject.name, "field of view", alone)
            panels.curve(*_outlines(one), named, number, line={"color": VIEW, "width": 1.5})
    star = {"symbol": "star", "size": 14, "color": SITE, "line": {"width": 1}}
    missions = [one.subject.mission for one in shown]
    sites = {degrees_of(m.site.position_body): m.scenario.site.name for m in missions}
    panels.data += [points([x], [y], f"site {name}", **star) for (x, y), name in sites.items()]
    middle = float(np.mean(subject.mission.schedule.window_s))
    style = {"color": GREY, "dash": "dot", "width": 2}
    panels.curve(
        *terminator(subject, middle), "terminator at mid-window, of a sphere", 0, line=style
    )
    ring = {"symbol": "circle-open", "size": 13, "color": VIEW, "line": {"width": 3}}
    panels.data.append(points([None], [None], "now", **ring) | {"meta": {"now": 0}})
    for axis, entries in map_axes((-180.0, 180.0)).items():
        panels.layout[axis] |= entries
    panels.layout["hovermode"] = "closest"
    return panels.chart("ground", "Ground track and field of view")


def _unbroken(longitude_deg: Array) -> Array:
    """Longitudes without the last one before each jump over the map's edge."""
    jumps = np.abs(np.diff(longitude_deg, append=longitude_deg[-1])) > 180.0
    return np.where(jumps, np.nan, longitude_deg)


def _outlines(one: Shown) -> tuple[list[float], list[float]]:
    """Some outlines of the field of view, broken where it leaves the body or the map, deg."""
    chosen = np.linspace(0, len(one.ground.looks_s) - 1, OUTLINES_SHOWN).astype(int)
    x: list[float] = []
    y: list[float] = []
    for outline in one.ground.outlines_m[chosen]:
        longitude, latitude = degrees_of(np.vstack([outline, outline[:1]]))
        x += [*_unbroken(longitude).tolist(), np.nan]
        y += [*latitude.tolist(), np.nan]
    return x, y


def timeline_chart(subjects: Sequence[Subject]) -> dict[str, Any]:
    """Attitude modes, the burns above them, and where each burn may be moved."""
    panels = Panels(["attitude modes and burns"], panel_px=max(170, 140 * len(subjects)))
    # Modes in the legend, each by the first plan that has it: an empty bar would not be there.
    named: set[str] = set()
    for row, subject in enumerate(reversed(subjects)):
        for mode, colour in MODES.items():
            legs = [
                x for x in subject.mission.schedule.legs if x.mode == mode and x.end_s > x.start_s
            ]
            panels.data.append(
                {
                    "type": "bar",
                    "orientation": "h",
                    "name": mode,
                    "legendgroup": mode,
                    "showlegend": bool(legs) and mode not in named,
                    "y": [row] * len(legs),
                    "base": [leg.start_s for leg in legs],
                    "x": [leg.end_s - leg.start_s for leg in legs],
                    "width": 0.34,
                    "marker": {"color": colour, "line": {"width": 1, "color": "#ffffff"}},
                    "hovertemplate": f"{mode}: %{{base:.0f}} s for %{{x:.0f}} s<extra></extra>",
                }
            )
            if legs:
                named.add(mode)
        panels.data += _burn_marks(subject, row)
    names = [subject.name for subject in reversed(subjects)]
    panels.y_axis(
        0,
        tickvals=list(range(len(names))),
        ticktext=names if len(names) > 1 else [""],
        range=[-0.25, len(names) - 0.15],
        automargin=True,
        showgrid=False,
        zeroline=False,
    )
    panels.layout |= {"hovermode": "closest", "barmode": "overlay"}
    return panels.chart("timeline", "Attitude modes under the burns")


def _burn_marks(subject: Subject, row: int) -> list[dict[str, Any]]:
    """Burns as triangles, where each may be moved as lines below, and their numbers and sizes."""
    executed, end = subject.solution.executed, float(subject.nodes_s[-1])
    sizes = {number: 1000.0 * float(np.linalg.norm(burn.dv_m_s)) for number, burn in executed}
    reach: list[float | None] = []
    intervals = subject.mission.schedule.firing_intervals_s
    for burn, (low, high) in zip(subject.solution.burns, intervals, strict=True):
        reach += [low, min(high, end), None] if any(burn.dv_m_s) else []
    times = [burn.t_s for _, burn in executed]
    moves = {
        "type": "scatter",
        "mode": "lines",
        "legendgroup": "moves",
        "showlegend": row == 0,
        "name": "where a burn may be moved, the others kept",
        "x": reach,
        "y": [row + 0.22] * len(reach),
        "line": {"color": BURN, "width": 4},
        "hoverinfo": "skip",
    }
    triangle = {"symbol": "triangle-down", "size": 13, "color": BURN}
    marks = points(times, [row + 0.3] * len(executed), "burn", **triangle) | {
        "legendgroup": "burn",
        "showlegend": row == 0,
        "hovertemplate": "burn at %{x:.0f} s<extra></extra>",
    }
    words = {
        "type": "scatter",
        "mode": "text",
        "showlegend": False,
        "hoverinfo": "skip",
        "x": times,
        # Neighbours stand at different heights, so that on a phone too none lies on another.
        "y": [row + 0.42 + 0.15 * (i % LEVELS) for i in range(len(executed))],
        "text": [f"{number}: {size:.1f} mm/s" for number, size in sizes.items()],
        "textposition": [
            "middle right" if t < 0.1 * end else "middle left" if t > 0.9 * end else "middle center"
            for t in times
        ],
    }
    return [moves, marks, words]


def budget_chart(plans: Sequence[Shown]) -> dict[str, Any]:
    """Every burn as planned, and what 99 % of its executions stay below."""
    panels = Panels(["delta-v (mm/s)"], "burn", panel_px=260)
    last = max(plan.budget.first + len(plan.budget.planned_m_s) for plan in plans)
    panels.layout["xaxis"] |= {"categoryarray": [f"burn {i}" for i in range(1, last)]}
    panels.layout |= {"hovermode": "closest", "barmode": "group"}
    for number, plan in enumerate(plans):
        budget, count = plan.budget, len(plan.budget.planned_m_s)
        name = "planned; whisker: 99 % of the flights" if len(plans) == 1 else plan.subject.name
        above = 1000.0 * (budget.high_m_s - budget.planned_m_s)
        panels.data.append(
            {
                "type": "bar",
                "name": name,
                "x": [f"burn {budget.first + i}" for i in range(count)],
                "y": significant(1000.0 * budget.planned_m_s),
                "marker": {"color": PLANS[number]},
                "error_y": whiskers(above, np.zeros(count), color=GREY),
            }
        )
    return panels.chart("budget", "Delta-v of every burn")


def held_chart(flights: Summary) -> dict[str, Any]:
    """Share of flights that keep each limit of the observation for so long, or longer."""
    x_title = "time in the observation window for which limits hold (s)"
    panels = Panels(["share of the flights that hold at least so long (%)"], x_title, 300)
    for number, (name, held) in enumerate(flights.held_s.items()):
        longer = 100.0 * np.cumsum(held.histogram.count[::-1])[::-1] / flights.samples
        times, share = np.append(0.0, held.histogram.start), np.append(100.0, longer)
        said = f"{called(name)}: {100.0 * held.throughout.estimate.value:.1f} % throughout"
        panels.curve(times, share, said, number, line={"shape": "vh"})
    return panels.chart("held", f"Time observed, of {flights.samples} flights")


def lowest_chart(flights: Summary) -> dict[str, Any]:
    """Lowest probability of each joint constraint with its interval."""
    panels = Panels(["lowest probability (1)"], "", 300)
    panels.layout |= {"hovermode": "closest", "showlegend": False}
    found = {called(name): one.estimate for name, one in flights.probability.items()}
    found["whole flights"] = flights.whole_flight.estimate
    values = np.array(list(found.values()))
    trace = points([*found], significant(values[:, 0]), "flights", size=11, color=PLANS[0])
    value, low, high = values.T
    panels.data.append(trace | {"error_y": whiskers(high - value, value - low)})
    title = f"Lowest probabilities, of {flights.samples} flights, with 95 % intervals"
    return panels.chart("probability", title)


def convergence_chart(subjects: Sequence[Subject]) -> dict[str, Any]:
    """Merit, its changes, violation and radius by iteration, stages one after the other."""
    panels = Panels([title for title, _, _ in CONVERGENCE], "iteration, over all stages", 140)
    alone = len(subjects) == 1
    for number, subject in enumerate(subjects):
        records = subject.solution.iterations
        x = np.arange(1, len(records) + 1)
        words = [f"{r.stage} {r.k}{'' if r.accepted else ', rejected'}" for r in records]
        for panel, (_, keys, scale) in enumerate(CONVERGENCE):
            for other, key in enumerate(keys):
                values = scale * np.abs([getattr(record, key) for record in records])
                said = key.removeprefix("max_").replace("_", " ")
                first = panel == other == 0
                panels.curve(
                    x,
                    np.where(values > LEAST, values, np.nan),
                    # Of several plans each has one entry in the legend: titles name the curves.
                    subject.name if first and not alone else labelled(subject.name, said, alone),
                    panel if alone else number,
                    panel,
                    legend=alone or first,
                    **({} if alone else {"legendgroup": subject.name}),
                    line={"dash": "dot" if other else "solid"},
                    mode="lines+markers",
                    marker={"symbol": "x" if other else "circle", "size": 7},
                    text=words,
                )
    for panel in range(len(CONVERGENCE)):
        panels.y_axis(panel, **LOGARITHMIC)
    return panels.chart("convergence", "Convergence")


def craft_chart(subjects: Sequence[Subject]) -> dict[str, Any] | None:
    """State of charge, power, attitude error and wheels over time; none without a simulation."""
    flown = [(s, s.record) for s in subjects if s.record is not None]
    if not flown:
        return None
    panels = Panels(IN_SIMULATION)
    panels.window(flown[0][0].mission.schedule.window_s)
    for number, (subject, record) in enumerate(flown):
        before = "" if len(flown) == 1 else f"{subject.name}: "
        _draw_record(panels, record, before, number, BINS // len(flown))
        panels.limit("floor: at least", 100.0 * record.summary.floor_charge, 0)
    panels.y_axis(2, **LOGARITHMIC)
    panels.y_axis(0, range=[0, 104])
    return panels.chart("craft", "Battery and pointing in the simulation")


def _draw_record(panels: Panels, record: Record, before: str, number: int, bins: int) -> None:
    times, arrays = record.arrays["t_s"].astype(float), record.arrays

    def add(values: npt.NDArray[Any], name: str, panel: int, which: int) -> None:
        points = thinned(times, np.asarray(values, dtype=float), bins)
        colour = (number if before else which) % len(PLANS)
        panels.curve(
            *points, before + name, colour, panel, line={"dash": DASHES[which % len(DASHES)]}
        )

    for i, charge in enumerate(100.0 * arrays["state_of_charge"].T):
        add(charge, f"battery {i + 1}", 0, i)
    add(arrays["panel_w"].reshape(len(times), -1).sum(axis=1), "generated", 1, 2)
    add(arrays["consumed_w"].reshape(len(times), -1).sum(axis=1), "consumed", 1, 3)
    error = np.rad2deg(arrays["pointing_error_rad"].astype(np.float64))
    seconds = CONTROL_PERIOD_S * np.arange(len(error))
    points = thinned(seconds, np.asarray(np.maximum(error, LEAST_DEG), dtype=float), bins)
    panels.curve(*points, f"{before}attitude against its command", number, 2)
    for i, speed in enumerate(arrays["wheel_speed_rad_s"].T):
        add(speed, f"wheel {i + 1}", 3, i)


def thinned(
    times: npt.NDArray[Any], values: npt.NDArray[Any], bins: int = BINS
) -> tuple[Array, Array]:
    """Least and largest value of even parts, each at its time: no peak is lost."""
    if len(times) <= 2 * bins:
        return times, values
    edges = np.linspace(0, len(times), bins + 1).astype(int)
    kept = sorted(
        {
            low + int(pick(values[low:high]))
            for low, high in itertools.pairwise(edges)
            for pick in (np.argmin, np.argmax)
        }
    )
    return times[kept], values[kept]
