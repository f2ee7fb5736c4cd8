"""Draw the charts of the report, except the 3-D view, as Plotly's figures."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from formulations.arrays import Array
from scp_recon.display import mm_s
from scp_recon.monte_carlo.summary import Summary
from scp_recon.reports.marks import (
    BURN,
    DASHES,
    GREY,
    LOGARITHMIC,
    MODES,
    PLANS,
    SITE,
    VIEW,
    Chart,
    Panels,
    Trace,
    faint,
    labelled,
    map_axes,
    points,
    significant,
    whiskers,
)
from scp_recon.reports.shown import SHARE, Shown
from scp_recon.reports.surfaces import degrees_of, rim
from scp_recon.reports.tables import called
from scp_recon.simulation.guidance import CONTROL_PERIOD_S
from scp_recon.simulation.record import Record

LEVELS = 3
"""Heights at which burns are named."""
OUTLINES_SHOWN = 5
"""Outlines of the field of view, over the window."""
CONVERGENCE = (
    ("merit (mm/s)", ("merit",), 1e3),
    ("change of merit: predicted, and dotted actual (mm/s)", ("predicted", "actual"), 1e3),
    ("violation, and dotted defect (m)", ("max_violation", "max_defect"), 1.0),
    ("trust radius (mm/s)", ("trust_radius",), 1e3),
)
LEAST, LEAST_DEG = 1e-13, 1e-4
"""Below these, logarithmic axes show nothing."""
BINS, DELTA_V_BINS = 700, 60
"""Parts of the time, of all simulations together, each shown by two points; and of a histogram."""
IN_SIMULATION = (
    *("state of charge (%)", "power (W)", "pointing error (deg)"),
    "wheel speed (rad/s)",
)


def ground_chart(plans: Sequence[Shown]) -> Chart:
    """Points below the spacecraft, the site, the field of view on the ground, and the terminator."""
    panels = Panels(["latitude (deg)"], panel_px=380)
    alone, sites = len(plans) == 1, {}
    for number, plan in enumerate(plans):
        times, (first, last) = plan.fine_s, plan.window_s
        seen = (times >= first) & (times <= last)
        longitude, latitude = degrees_of(plan.fixed(times))
        longitude, name = _unbroken(longitude), "below the spacecraft" if alone else plan.name
        panels.curve(longitude, latitude, name, number)
        if seen.any():
            within = longitude[seen], latitude[seen], f"{name}, window"
            panels.curve(*within, number, line={"dash": "solid", "width": 6})
            named = labelled(plan.name, "field of view", alone)
            x, y = _outlines(plan.outlines_m)
            panels.curve(x, y, named, number, line={"color": VIEW, "width": 1.5})
        sites[degrees_of(plan.mission.site.position_body)] = plan.mission.scenario.site.name
    star = {"symbol": "star", "size": 14, "color": SITE, "line": {"width": 1}}
    panels.data += [points([x], [y], f"site {name}", **star) for (x, y), name in sites.items()]
    dark = terminator(plans[0], float(np.mean(plans[0].mission.schedule.window_s)))
    style = {"color": GREY, "dash": "dot", "width": 2}
    panels.curve(*dark, "terminator at mid-window, of a sphere", 0, line=style)
    ring = {"symbol": "circle-open", "size": 13, "color": VIEW, "line": {"width": 3}}
    panels.data.append(points([None], [None], "now", **ring) | {"meta": {"now": 0}})
    for axis, entries in map_axes((-180.0, 180.0)).items():
        panels.layout[axis] |= entries
    panels.layout["hovermode"] = "closest"
    return panels.chart("ground")


def _unbroken(longitude_deg: Array) -> Array:
    """Longitudes without the last one before each jump over the map's edge."""
    jumps = np.abs(np.diff(longitude_deg, append=longitude_deg[-1])) > 180.0
    return np.where(jumps, np.nan, longitude_deg)


def _outlines(outlines_m: Array) -> Array:
    """Some outlines of the field of view, broken where it leaves the body or the map, deg, (2, n)."""
    chosen = np.linspace(0, len(outlines_m) - 1, OUTLINES_SHOWN).astype(int)
    found = []
    for outline in outlines_m[chosen]:
        longitude, latitude = degrees_of(np.vstack([outline, outline[:1]]))
        found += [np.stack([_unbroken(longitude), latitude]), np.full((2, 1), np.nan)]
    return np.hstack(found)


def terminator(plan: Shown, time_s: float) -> tuple[Array, Array]:
    """Longitude and latitude (deg) of the great circle on which the Sun stands on the horizon.

    Of a sphere: a rough shape's own terminator departs from it.
    """
    mission = plan.mission
    sun = mission.rotation.body_to_j2000(time_s).T @ mission.sun_direction(time_s)
    longitude, latitude = degrees_of(rim(sun[None], 360)[0])
    order = np.argsort(longitude)
    return longitude[order], latitude[order]


def timeline_chart(plans: Sequence[Shown]) -> Chart:
    """Attitude modes, the burns above them, and where each burn may be moved."""
    panels = Panels(["attitude modes and burns"], panel_px=max(170, 140 * len(plans)))
    rows = list(enumerate(reversed(plans)))
    for mode, colour in MODES.items():
        legs = [(row, leg) for row, plan in rows for leg in plan.mission.schedule.legs
                if leg.mode == mode and leg.end_s > leg.start_s]  # fmt: skip
        if legs:
            panels.data.append(
                {
                    "type": "bar",
                    "orientation": "h",
                    "name": mode,
                    "y": [row for row, _ in legs],
                    "base": [leg.start_s for _, leg in legs],
                    "x": [leg.end_s - leg.start_s for _, leg in legs],
                    "width": 0.34,
                    "marker": {"color": colour, "line": {"width": 1, "color": "#ffffff"}},
                    "hovertemplate": f"{mode}: %{{base:.0f}} s for %{{x:.0f}} s<extra></extra>",
                }
            )
    panels.data += _burn_marks(rows)
    names = [plan.name for _, plan in rows]
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
    return panels.chart("timeline")


def _burn_marks(rows: Sequence[tuple[int, Shown]]) -> list[Trace]:
    """Burns as triangles, where each may be moved as lines below, and their numbers and sizes."""
    reach, burns, words, sides = list[tuple[Any, Any]](), [], [], []
    for row, plan in rows:
        end = float(plan.nodes_s[-1])
        intervals = plan.mission.schedule.firing_intervals_s
        for burn, (low, high) in zip(plan.solution.burns, intervals, strict=True):
            if any(burn.dv_m_s):
                reach += [(low, row + 0.22), (min(high, end), row + 0.22), (None, None)]
        for i, (number, burn) in enumerate(plan.solution.executed):
            # Neighbours stand at different heights, so that on a phone too none lies on another.
            burns.append((burn.t_s, row + 0.3, row + 0.42 + 0.15 * (i % LEVELS)))
            words.append(f"{number}: {mm_s(float(np.linalg.norm(burn.dv_m_s)), 1)}")
            share = burn.t_s / end
            side = "right" if share < 0.1 else "left" if share > 0.9 else "center"
            sides.append(f"middle {side}")
    times, marks, heights = zip(*burns, strict=True) if burns else ((), (), ())
    silent: Trace = {"type": "scatter", "hoverinfo": "skip"}
    x, y = zip(*reach, strict=True) if reach else ((), ())
    line = {"color": BURN, "width": 4}
    moves = {"mode": "lines", "name": "where a burn may be moved, the others kept", "line": line}
    text = {"mode": "text", "showlegend": False, "text": words, "textposition": sides}
    triangle = {"symbol": "triangle-down", "size": 13, "color": BURN}
    return [
        silent | moves | {"x": x, "y": y},
        points(times, marks, "burn", **triangle)
        | {"hovertemplate": "burn at %{x:.0f} s<extra></extra>"},
        silent | text | {"x": times, "y": heights},
    ]


def budget_chart(plans: Sequence[Shown]) -> Chart:
    """Every burn as planned, and what 99 % of its executions stay below."""
    panels = Panels(["delta-v (mm/s)"], "burn", panel_px=260)
    last = max(plan.budget.first + len(plan.budget.planned_m_s) for plan in plans)
    panels.layout["xaxis"] |= {"categoryarray": [f"burn {i}" for i in range(1, last)]}
    panels.layout |= {"hovermode": "closest", "barmode": "group"}
    for number, plan in enumerate(plans):
        budget, count = plan.budget, len(plan.budget.planned_m_s)
        name = "planned; whisker: 99 % of the flights" if len(plans) == 1 else plan.name
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
    return panels.chart("budget")


def held_chart(flights: Summary) -> Chart:
    """Share of flights that keep each limit of the observation for so long, or longer."""
    x_title = "time in the observation window for which limits hold (s)"
    panels = Panels(["share of the flights that hold at least so long (%)"], x_title, 300)
    for number, (name, held) in enumerate(flights.held_s.items()):
        longer = 100.0 * np.cumsum(held.histogram.count[::-1])[::-1] / flights.samples
        times, share = np.append(0.0, held.histogram.start), np.append(100.0, longer)
        said = f"{called(name)}: {100.0 * held.throughout.estimate.value:.1f} % throughout"
        panels.curve(times, share, said, number, line={"shape": "vh"})
    return panels.chart("held", f"Time observed, of {flights.samples} flights")


def lowest_chart(flights: Summary) -> Chart:
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


def convergence_chart(plans: Sequence[Shown]) -> Chart:
    """Merit, its changes, violation and radius by iteration, stages one after the other."""
    panels = Panels([title for title, _, _ in CONVERGENCE], "iteration, over all stages", 140)
    alone = len(plans) == 1
    for number, plan in enumerate(plans):
        records = plan.solution.iterations
        words = [f"{r.stage} {r.k}{'' if r.accepted else ', rejected'}" for r in records]
        for panel, (_, keys, scale) in enumerate(CONVERGENCE):
            for other, key in enumerate(keys):
                values = scale * np.abs([getattr(record, key) for record in records])
                # Several plans have one entry each in the legend: titles name the curves.
                said = key.removeprefix("max_").replace("_", " ") if alone else plan.name
                panels.curve(
                    np.arange(1, len(records) + 1),
                    np.where(values > LEAST, values, np.nan),
                    said,
                    panel if alone else number,
                    panel,
                    legend=alone or panel == other == 0,
                    line={"dash": "dot" if other else "solid"},
                    mode="lines+markers",
                    marker={"symbol": "x" if other else "circle", "size": 7},
                    text=words,
                )
    for panel in range(len(CONVERGENCE)):
        panels.y_axis(panel, **LOGARITHMIC)
    return panels.chart("convergence")


def craft_chart(plans: Sequence[Shown]) -> Chart | None:
    """State of charge, power, attitude error and wheels over time; none without a simulation."""
    flown = [(plan, plan.record) for plan in plans if plan.record is not None]
    if not flown:
        return None
    panels = Panels(IN_SIMULATION)
    panels.window(flown[0][0].mission.schedule.window_s)
    for number, (plan, record) in enumerate(flown):
        alone = len(flown) == 1
        for panel, which, name, times, values in _simulated(record):
            x, y = thinned(times, np.asarray(values, dtype=float), BINS // len(flown))
            colour, style = which if alone else number, {"dash": DASHES[which % len(DASHES)]}
            panels.curve(
                x, y, labelled(plan.name, name, alone), colour % len(PLANS), panel, line=style
            )
        panels.limit("floor: at least", 100.0 * record.summary.floor_charge, 0)
    panels.y_axis(2, **LOGARITHMIC)
    panels.y_axis(0, range=[0, 104])
    return panels.chart("craft")


def _simulated(record: Record) -> Iterator[tuple[int, int, str, Array, Array]]:
    """Panel, number among its curves, name, times and values of each curve of a simulation."""
    arrays, times = record.arrays, record.arrays["t_s"].astype(float)
    for i, charge in enumerate(100.0 * arrays["state_of_charge"].T):
        yield 0, i, f"battery {i + 1}", times, charge
    for i, (name, key) in enumerate(
        (("generated", "panel_w"), ("consumed", "consumed_w")), start=2
    ):
        yield 1, i, name, times, arrays[key].reshape(len(times), -1).sum(axis=1)
    error: Array = np.maximum(np.rad2deg(arrays["pointing_error_rad"].astype(float)), LEAST_DEG)
    seconds = CONTROL_PERIOD_S * np.arange(len(error), dtype=float)
    yield 2, 0, "attitude against its command", seconds, error
    for i, speed in enumerate(arrays["wheel_speed_rad_s"].T):
        yield 3, i, f"wheel {i + 1}", times, speed


def thinned(times: Array, values: Array, bins: int = BINS) -> tuple[Array, Array]:
    """Least and largest value of even parts, each at its time: no peak is lost."""
    if len(times) <= 2 * bins:
        return times, values
    edges = np.linspace(0, len(times), bins + 1).astype(int)
    parts = [(low, values[low:high]) for low, high in itertools.pairwise(edges)]
    kept = np.unique([low + each for low, part in parts for each in (part.argmin(), part.argmax())])
    return times[kept], values[kept]


def commanded_chart(plans: Sequence[Shown]) -> Chart:
    """Distribution of the flights' commanded delta-v, with the plan's own, the mean and 99 %."""
    panels = Panels(["share of the flights (%)"], "commanded delta-v of a flight (mm/s)", 240)
    panels.layout["hovermode"] = "closest"
    for number, plan in enumerate(plans):
        totals = 1000.0 * plan.flown.commanded_m_s
        counts, edges = np.histogram(totals, DELTA_V_BINS)
        share = 100.0 * counts / len(totals)
        name = "flights" if len(plans) == 1 else plan.name
        steps = np.repeat(edges, 2)[1:-1], np.repeat(share, 2)
        style = {"dash": "solid"}
        panels.curve(*steps, name, number, line=style, fill="tozeroy")
        panels.data[-1]["fillcolor"] = faint(PLANS[number], 0.3)
        figures = {
            "nominal": 1000.0 * plan.solution.total_dv_m_s,
            "mean": float(totals.mean()),
            f"{100.0 * SHARE:g} %": float(np.quantile(totals, SHARE)),
        }
        for i, (what, value) in enumerate(figures.items(), start=1):
            said = labelled(plan.name, f"{what} {value:.2f} mm/s", len(plans) == 1)
            style = {"dash": DASHES[i]}
            panels.curve([value, value], [0.0, float(share.max())], said, number, line=style)
    return panels.chart("commanded")
