"""Draw the 3-D view: Plotly's traces, and the data that moves them in time.

Axes: Sun-North at the first plan's epoch, inertial, m. A trace's `meta.moves` says in what its
coordinates are given: `body` turns with the body, `site` travels with the site, `companion` with the
second body, `craft`, `view` and `cloud` are made anew at each time; without it they stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from formulations.arrays import Array
from scp_recon.display import mm_s
from scp_recon.mission.constraints import companion_distance_m
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import RK4_STEP_MAX_S
from scp_recon.monte_carlo.drifts import reach_s
from scp_recon.physics.flow import propagate
from scp_recon.physics.frames import TabulatedRotation, sun_north_to_j2000, unit
from scp_recon.reports.marks import (
    BURN,
    DASHES,
    FLIGHTS,
    GREY,
    KEEP_IN,
    KEEP_OUT,
    NIGHT_TO_DAY,
    PLANS,
    SITE,
    SUN,
    VIEW,
    Chart,
    Trace,
    chart,
    compact,
    lines,
    mesh,
    moved,
    spots,
)
from scp_recon.reports.shown import LOOKS, Shown
from scp_recon.reports.surfaces import Shape, Solid, cone, shell, sphere, tube

ARROW = 0.13
"""Length of the largest burn's arrow, over the longest edge of what the paths fill."""
ROOM = 0.04
"""Around what is drawn, over its longest edge."""
PATHS = 40
"""Sampled flights whose paths are drawn, of all plans together."""
SUN_FROM, SUN_TO = 1.15, 1.75
"""Ends of the line to the Sun, in radii of the body."""
X_NAME, Z_NAME = "X, to the Sun (m)", "Z, north (m)"


@dataclass(frozen=True, eq=False)
class Frame:
    """Rotation from J2000 to the axes of the view, and the box shown.

    Attributes:
        to_j2000: shape (3, 3).
        low_m: least of each coordinate that is in the box, shape (3,).
        high_m: largest of each.
        arrow_m: length of the largest burn's arrow.
    """

    to_j2000: Array
    low_m: Array
    high_m: Array
    arrow_m: float

    def seen(self, vectors: Array) -> Array:
        """Vectors (..., 3) in J2000 in the view's axes."""
        return vectors @ self.to_j2000


def frame_of(plans: Sequence[Shown]) -> Frame:
    """Frame of the first plan, with room for the mean paths of all, burns, and the safety radius.

    The box ends at whole metres, as in the file, so that points on its edge are inside.
    """
    mission = plans[0].mission
    axes = sun_north_to_j2000(mission.sun_direction(0.0), mission.rotation.pole)
    paths = np.vstack([plan.positions(plan.fine_s) @ axes for plan in plans])
    safety = mission.scenario.safety.radius_min_m
    low, high = np.minimum(paths.min(axis=0), -safety), np.maximum(paths.max(axis=0), safety)
    edge = float((high - low).max())
    bare = Frame(axes, low, high, ARROW * edge)
    tips = np.vstack([arrows_of(bare, plan)[1] for plan in plans])
    low = np.minimum(low, tips.min(axis=0, initial=np.inf))
    high = np.maximum(high, tips.max(axis=0, initial=-np.inf))
    low, high = np.floor(low - ROOM * edge), np.ceil(high + ROOM * edge)
    return replace(bare, low_m=low, high_m=high)


def arrows_of(frame: Frame, plan: Shown) -> tuple[Array, Array]:
    """Starts and ends of the arrows of the burns that are executed, shape (m, 3) each."""
    executed = [burn for _, burn in plan.solution.executed]
    burns = np.array([burn.dv_m_s for burn in executed]).reshape(-1, 3)
    scale = frame.arrow_m / max(float(np.linalg.norm(burns, axis=1).max(initial=0.0)), 1e-12)
    starts = frame.seen(plan.positions(np.array([burn.t_s for burn in executed])))
    return starts, starts + scale * frame.seen(burns)


def scene(plans: Sequence[Shown]) -> dict[str, Any]:
    """Traces, layout and what moves them, as the page's script takes them."""
    first, frame = plans[0], frame_of(plans)
    mission, shape = first.mission, first.shape
    sites = {tuple(m.site.position_body): m for m in (plan.mission for plan in plans)}
    traces = [
        *_body(frame, mission, shape),
        *(_site(each, shape) for each in sites.values()),
        *keep_sets(frame, first),
        *drifts(frame, first),
    ]
    for number, plan in enumerate(plans):
        traces += _plan(frame, plan, number, PATHS // len(plans))
    ends = [
        float(min(plan.nodes_s[0] for plan in plans)),
        float(max(plan.nodes_s[-1] for plan in plans)),
    ]
    return {
        "traces": traces,
        "layout": _layout(frame, first),
        "motion": {
            "rotation": _rotation(frame, mission),
            "site": compact(mission.site.position_body, 3),
            "site_normal": compact(mission.site.normal_body, 9),
            "sun": [compact(frame.seen(mission.sun_direction(t)), 8) for t in ends],
            "ends_s": ends,
            "companion": companion_of(frame, first),
            "normals": compact(shape.normals, 3),
            "plans": [_moving(frame, plan) for plan in plans],
        },
    }


def picture(plans: Sequence[Shown]) -> Chart:
    """The view at the middle of the first plan's window, as a chart without motion."""
    shown, mission, shape = scene(plans), plans[0].mission, plans[0].shape
    frame, at_s = frame_of(plans), float(np.mean(mission.schedule.window_s))
    body = frame.to_j2000.T @ mission.rotation.body_to_j2000(at_s)
    sun = frame.seen(mission.sun_direction(at_s)) @ body
    traces: list[Trace] = []
    for trace in shown["traces"]:
        about = trace["meta"]
        if trace.get("visible") is False or about.get("moves") in ("view", "cloud"):
            continue
        xyz = np.array([trace[axis] for axis in "xyz"], dtype=float)
        if about.get("moves") == "body":
            xyz = body @ xyz
        elif about.get("moves") == "craft":
            xyz = frame.seen(plans[about["plan"]].positions(np.array([at_s]))).T
        placed = trace | dict(zip("xyz", compact(xyz, 1), strict=True))
        if "lit" in about:
            placed["intensity"] = compact(shape.normals @ sun, 3)
        # A path is named by its plan where there are several, all else by what it is, once.
        several = len(plans) > 1 and about["group"] == "planned path"
        name = trace["name"] if several else about["group"]
        first = all(name != other["legendgroup"] for other in traces)
        traces.append(placed | {"name": name, "legendgroup": name, "showlegend": first})
    view = shown["layout"]["scene"]
    eye = {axis: 1.1 * at for axis, at in view["camera"]["eye"].items()}  # all of it, at any width
    layout = shown["layout"] | {
        "height": 640,
        "scene": view | {"camera": view["camera"] | {"eye": eye}},
        "showlegend": True,
        "legend": {"orientation": "h", "yanchor": "top", "y": 0.0},
    }
    return chart("flight", traces, layout)


def _rotation(frame: Frame, mission: Mission) -> dict[str, Any]:
    """The attitude at angle W is `axes` turned by W about their third."""
    rotation = mission.rotation
    if isinstance(rotation, TabulatedRotation):  # shown as it is amid the window
        axes = rotation.body_to_j2000(float(np.mean(mission.schedule.window_s)))
        turn = {"meridian": 0.0, "rate": 0.0, "acceleration": 0.0}
    else:
        turn = {key: getattr(rotation, key) for key in ("meridian", "rate", "acceleration")}
        c, s = np.cos(rotation.meridian), np.sin(rotation.meridian)
        back = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        axes = rotation.body_to_j2000(0.0) @ back
    return {"axes": compact(frame.to_j2000.T @ axes, 9)} | turn


def companion_of(frame: Frame, plan: Shown) -> dict[str, Any] | None:
    """Where the second body is at even times of the flight, if there is one."""
    other, times = plan.mission.scene.companion, plan.fine_s
    if other is None:
        return None
    return {"t_s": compact(times, 3), "position": compact(frame.seen(other.position(times)).T, 1)}


def _moving(frame: Frame, plan: Shown) -> dict[str, Any]:
    times, schedule = plan.fine_s, plan.mission.schedule
    return {
        "name": plan.name,
        "t_s": compact(times, 3),
        "position": compact(frame.seen(plan.positions(times)).T, 2),
        "nodes_s": compact(plan.nodes_s, 3),
        "window_s": list(plan.window_s),
        "legs": [[leg.mode.value, leg.start_s, leg.end_s] for leg in schedule.legs],
        "site": compact(plan.mission.site.position_body, 3),
        "looks_s": compact(plan.looks_s(LOOKS), 2),
        "outlines": compact(plan.outlines_m, 1),
    }


def _body(frame: Frame, mission: Mission, shape: Shape) -> list[Trace]:
    name = mission.scenario.body.name
    surface = mesh(shape, name, name, "", 1.0)
    del surface["color"]
    surface |= {
        "intensity": [0.0] * len(shape.vertices_m),
        "cmin": -1.0,
        "cmax": 1.0,
        "colorscale": NIGHT_TO_DAY,
        "showscale": False,
        "lighting": {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0},
    }
    pole = frame.seen(mission.rotation.pole) * np.array([[-1.4], [1.4]]) * shape.size_m
    sun = frame.seen(mission.sun_direction(0.0)) * np.array([[SUN_FROM], [SUN_TO]]) * shape.size_m
    rays = lines(sun, "to the Sun", "Sun and spin axis", SUN, width=6)
    axis = lines(pole, "spin axis", "Sun and spin axis", GREY, dash="dash")
    return [moved(surface, "body", lit=True), rays, axis]


def _site(mission: Mission, shape: Shape) -> Trace:
    """A mark on the ground with the normal there."""
    site = mission.site
    normal = site.position_body + np.outer([0.005, 0.35], shape.size_m * site.normal_body)
    trace = lines(normal, f"site {mission.scenario.site.name}", "site", SITE, width=6)
    trace["mode"] = "lines+markers"
    trace["marker"] = {"size": [6, 0.1], "color": SITE, "symbol": "diamond"}
    return moved(trace, "body")


def keep_sets(frame: Frame, plan: Shown) -> list[Trace]:
    """Sets that positions and burns of the first plan keep in or out of; shown on demand."""
    mission = plan.mission
    scenario, site = mission.scenario, mission.site
    limits = {limit.name: limit.value for limit in mission.limits}
    distances = limits["site_distance_min"], limits["site_distance_max"]
    emissions = limits["emission_min"], limits["emission_max"]
    keep_in = shell(site.normal_body, site.position_body, distances, emissions)
    sun = frame.seen(mission.sun_direction(float(np.mean(mission.schedule.window_s))))

    def about_the_sun(angle: float) -> Solid:
        return cone(sun, np.zeros(3), angle, distances[1])

    lit = about_the_sun(max(limits["phase_min"], limits["battery_observation"]))
    sets = [
        ("keep out: safety radius", sphere(scenario.safety.radius_min_m), ""),
        ("keep in: distance and emission", keep_in, "body"),
        ("keep out: phase and battery cone", lit, "site"),
    ]
    if mission.scene.companion is not None:
        sets.append(("keep out: companion", sphere(companion_distance_m(scenario)), "companion"))
    if "phase_max" in limits:
        sets.append(("keep in: phase at most", about_the_sun(limits["phase_max"]), "site"))
    traces = _burn_cones(frame, plan)
    for name, solid, moves in sets:
        colour = KEEP_IN if name.startswith("keep in") else KEEP_OUT
        traces.append(moved(mesh(solid, name, name, colour, 0.2), moves))
    return [trace | {"visible": False} for trace in traces]


def drifts(frame: Frame, plan: Shown) -> list[Trace]:
    """Mean drifts of the first plan after each missed burn but the first, and where they are nearest.

    They are shown on demand, as far as they stay in the box.
    """
    mission, nodes, traces = plan.mission, plan.solution.nodes, list[Trace]()
    spell = reach_s(mission)
    for number, burn in plan.solution.executed:
        if number == 1 or spell <= 0.0:
            continue
        state = np.array(nodes.state[int(np.searchsorted(nodes.t_s, burn.t_s))])
        state[3:] -= burn.dv_m_s
        seen = frame.seen(free_path(mission, state, burn.t_s, spell)[:, :3])
        nearest = seen[[np.argmin(np.linalg.norm(seen, axis=1))]]
        outside = np.any((seen < frame.low_m) | (seen > frame.high_m), axis=1)
        group = f"drift if burn {number} is missed"
        name = f"{group}, nearest {np.linalg.norm(nearest):.0f} m from the centre"
        traces.append(lines(np.where(outside[:, None], np.nan, seen), group, group, BURN, width=3))
        traces.append(spots(nearest, name, group, size=5, color=BURN, symbol="circle"))
    return [trace | {"visible": False} for trace in traces]


def free_path(mission: Mission, state: Array, begin_s: float, spell_s: float) -> Array:
    """Mean states (n, 6) of a free flight at even times, from its beginning to its end, SI."""
    times = np.linspace(0.0, spell_s, 1 + max(1, int(np.ceil(spell_s / RK4_STEP_MAX_S))))
    path = [state]
    for time in times[:-1]:
        path.append(propagate(path[-1], times[1], mission.forces, 1, begin_s + time))
    return np.stack(path)


def _burn_cones(frame: Frame, plan: Shown) -> list[Trace]:
    """The double cones about the Sun line that every burn keeps out of."""
    times = np.array([burn.t_s for _, burn in plan.solution.executed])
    angle = float(np.deg2rad(plan.mission.scenario.battery.delta_v_cone_deg))
    places, suns = plan.positions(times), plan.mission.sun_direction(times)
    name = "keep out: burns' battery cones"
    return [
        mesh(cone(side * unit(sun), at, angle, frame.arrow_m), name, name, KEEP_OUT, 0.22)
        for at, sun in zip(frame.seen(places), frame.seen(suns), strict=True)
        for side in (1.0, -1.0)
    ]


def _plan(frame: Frame, plan: Shown, number: int, flights: int) -> list[Trace]:
    colour, name, times = PLANS[number], plan.name, plan.fine_s
    path = frame.seen(plan.positions(times))
    first, last = plan.mission.schedule.window_s
    seen = (times >= first) & (times <= last)
    edge = {"color": "#ffffff", "width": 2}
    dot = {"size": 7, "color": colour, "symbol": "circle", "line": edge}
    craft = spots(path[:1], f"{name}: spacecraft", "spacecraft", **dot)
    view = lines(path[:1], f"{name}: field of view", "field of view", VIEW, width=4)
    return [
        lines(path, name, "planned path", colour, width=5, dash=DASHES[number]),
        lines(path[seen], f"{name}: window", "observation window", colour, width=11),
        *_sampled(frame, plan, number, flights),
        *_tubes(frame, plan, number),
        *_burns(frame, plan),
        moved(craft, "craft", plan=number),
        moved(view, "view", plan=number),
    ]


def _sampled(frame: Frame, plan: Shown, number: int, flights: int) -> list[Trace]:
    """Paths of some flights at the nodes, broken between them; and where they are at a time."""
    nodes = np.isin(plan.flown.times_s, plan.mission.times_s)
    paths = frame.seen(plan.flown.positions[nodes][:, :flights]).swapaxes(0, 1)
    broken = np.concatenate([paths, np.full((len(paths), 1, 3), np.nan)], axis=1).reshape(-1, 3)
    name, group = f"{plan.name}: {len(paths)} sampled flights", "sampled flights"
    drawn = lines(broken, name, group, FLIGHTS[number], width=1)
    marker = {"size": 2.5, "color": PLANS[number], "opacity": 0.6}
    cloud = spots(paths[:, 0], f"{name}, now", group, **marker)
    for trace in (drawn, cloud):
        trace["hoverinfo"] = "skip"
    return [moved(drawn, "", paths=number), moved(cloud, "cloud", plan=number)]


def _tubes(frame: Frame, plan: Shown, number: int) -> list[Trace]:
    states = np.array(plan.solution.nodes.state)
    covariance = np.array(plan.solution.nodes.covariance)[:, :3, :3]
    turned = frame.to_j2000.T @ covariance @ frame.to_j2000
    path = frame.seen(states[:, :3])
    apart = np.linalg.norm(np.gradient(path, axis=0), axis=1) > 0.0
    traces = []
    for sigmas, opacity in ((1, 0.3), (3, 0.14)):
        solid = tube(path[apart], turned[apart], sigmas)
        name, group = f"{plan.name}: {sigmas} sigma", f"{sigmas} sigma tube"
        trace = mesh(solid, name, group, PLANS[number], opacity)
        traces.append(trace | {"visible": sigmas == 3})
    return traces


def _burns(frame: Frame, plan: Shown) -> list[Trace]:
    """Arrows of the burns, proportional to their sizes."""
    starts, ends = arrows_of(frame, plan)
    gaps, name = np.full_like(starts, np.nan), f"{plan.name}: burns"
    shafts = np.stack([starts, ends, gaps], axis=1).reshape(-1, 3)
    tips = spots(ends, name, "burns", size=5, color=BURN, symbol="diamond")
    return [lines(shafts, name, "burns", BURN, width=7), tips]


def _layout(frame: Frame, plan: Shown) -> dict[str, Any]:
    # What is written stands in annotations: letters in WebGL would take longer than all the rest.
    ends = zip("xyz", compact(frame.low_m, 0), compact(frame.high_m, 0), strict=True)
    axes = {f"{x}axis": {"title": {"text": ""}, "range": [a, b], "nticks": 4} for x, a, b in ends}
    # One scale for all axes and for good: "data" would take another when a set is shown.
    size = frame.high_m - frame.low_m
    camera = {
        "eye": {"x": 1.5, "y": -1.25, "z": 0.5},
        "center": {"x": 0, "y": 0, "z": -0.15},  # the X axis's name is below the box
        "up": {"x": 0, "y": 0, "z": 1},
    }
    return {
        "scene": {
            **axes,
            "aspectmode": "manual",
            "aspectratio": dict(zip("xyz", compact(size / np.cbrt(size.prod()), 6), strict=True)),
            "camera": camera,
            "dragmode": "orbit",
            "annotations": _words(frame, plan),
        },
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "showlegend": False,
    }


def _words(frame: Frame, plan: Shown) -> list[dict[str, Any]]:
    """Names of axes, Sun, north, and the first plan's burns."""
    mission, low, high, size = plan.mission, frame.low_m, frame.high_m, plan.shape.size_m
    middle = 0.5 * (low + high)
    named: list[tuple[Any, str]] = [
        ((middle[0], low[1], low[2]), X_NAME),
        ((high[0], middle[1], low[2]), "Y (m)"),
        ((low[0], low[1], middle[2]), Z_NAME),
        (SUN_TO * size * frame.seen(mission.sun_direction(0.0)), "Sun"),
        (1.5 * size * frame.seen(mission.rotation.pole), "N"),
    ]
    tips = zip(arrows_of(frame, plan)[1], plan.solution.executed, strict=True)
    named += [
        (at, f"{number}: {mm_s(float(np.linalg.norm(b.dv_m_s)), 1)}") for at, (number, b) in tips
    ]
    found = []
    for at, text in named:
        where = dict(zip("xyz", compact(np.array(at), 1), strict=True))
        # The first two are at the view's left: to their right there is room.
        anchor = "left" if text in (X_NAME, Z_NAME) else "center"
        style = {"showarrow": False, "yshift": 10, "xanchor": anchor, "font": {"size": 12}}
        found.append(where | {"text": text} | style)
    return found
