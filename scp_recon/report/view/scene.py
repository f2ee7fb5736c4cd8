"""The 3-D view: Plotly's traces, and what the page needs to move them in time.

Axes: Sun-North at the first plan's epoch, inertial, m. A trace's `meta.moves` says in what its
coordinates are given: `body` turns with the body, `site` travels with the site, `craft`, `view` and
`cloud` are made anew at each time; without it they stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scp_recon.mission.mission import Mission
from scp_recon.report.content import palette
from scp_recon.report.content.numbers import compact
from scp_recon.report.content.shape import Shape
from scp_recon.report.content.subject import Subject
from scp_recon.report.view import solids
from scp_recon.report.view.frame import Frame, Shown, arrows_of, frame_of
from scp_recon.report.view.sets import keep_sets
from scp_recon.report.view.solids import Solid
from scp_recon.report.view.traces import Trace, lines, mesh, moved

Array = npt.NDArray[np.float64]

PATHS = 40
"""Sampled flights whose paths are drawn, of all plans together."""
SUN_FROM, SUN_TO = 1.15, 1.75
"""Ends of the line to the Sun, in radii of the body."""
X_NAME, Z_NAME = "X, to the Sun (m)", "Z, north (m)"


def scene(plans: Sequence[Shown], shape: Shape) -> dict[str, Any]:
    """Traces, layout and what moves them, as the page's script takes them."""
    frame, mission = frame_of(plans), plans[0].subject.mission
    missions = (one.subject.mission for one in plans)
    sites = {tuple(each.site.position_body): each for each in missions}
    traces = [
        *_body(frame, mission, shape),
        *(_site(each, shape) for each in sites.values()),
        *keep_sets(frame, plans[0].subject),
    ]
    for number, one in enumerate(plans):
        traces += _plan(frame, one, number, PATHS // len(plans))
    return {
        "traces": traces,
        "layout": _layout(frame, plans[0].subject, shape),
        "motion": {
            "rotation": _rotation(frame, mission),
            "site": compact(mission.site.position_body, 3),
            "site_normal": compact(mission.site.normal_body, 9),
            "sun": [compact(frame.seen(mission.sun_direction(t)), 8) for t in _ends(plans)],
            "ends_s": list(_ends(plans)),
            "normals": compact(shape.normals, 3),
            "plans": [_moving(frame, one) for one in plans],
        },
    }


def _ends(plans: Sequence[Shown]) -> tuple[float, float]:
    """From the first plan's begin to the last one's end, s."""
    nodes = [one.subject.nodes_s for one in plans]
    return float(min(each[0] for each in nodes)), float(max(each[-1] for each in nodes))


def _rotation(frame: Frame, mission: Mission) -> dict[str, Any]:
    """The attitude at angle W is `axes` turned by W about their third."""
    rotation = mission.rotation
    still = rotation.body_to_j2000(0.0)
    c, s = np.cos(rotation.meridian), np.sin(rotation.meridian)
    axes = still @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
    return {
        "axes": compact(frame.to_j2000.T @ axes, 9),
        "meridian": rotation.meridian,
        "rate": rotation.rate,
        "acceleration": rotation.acceleration,
    }


def _moving(frame: Frame, one: Shown) -> dict[str, Any]:
    subject, ground = one.subject, one.ground
    times = subject.fine_s
    legs = [[leg.mode.value, leg.start_s, leg.end_s] for leg in subject.mission.schedule.legs]
    return {
        "name": subject.name,
        "t_s": compact(times, 3),
        "position": compact(frame.seen(subject.positions(times)).T, 2),
        "nodes_s": compact(subject.nodes_s, 3),
        "window_s": list(subject.window_s),
        "legs": legs,
        "site": compact(subject.mission.site.position_body, 3),
        "looks_s": compact(ground.looks_s, 2),
        "outlines": compact(ground.outlines_m, 1),
    }


def _body(frame: Frame, mission: Mission, shape: Shape) -> list[Trace]:
    name = mission.scenario.body.name
    surface = mesh(Solid(shape.vertices_m, shape.facets), name, name, "", 1.0)
    del surface["color"]
    surface |= {
        "intensity": [0.0] * len(shape.vertices_m),
        "cmin": -1.0,
        "cmax": 1.0,
        "colorscale": palette.NIGHT_TO_DAY,
        "showscale": False,
        "lighting": {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0},
    }
    size = float(np.linalg.norm(shape.vertices_m, axis=1).max())
    pole = frame.seen(mission.rotation.pole) * np.array([[-1.4], [1.4]]) * size
    sun = frame.seen(mission.sun_direction(0.0)) * np.array([[SUN_FROM], [SUN_TO]]) * size
    rays = lines(sun, "to the Sun", "Sun and spin axis", palette.SUN, width=6)
    axis = lines(pole, "spin axis", "Sun and spin axis", palette.GREY, dash="dash")
    return [moved(surface, "body", lit=True), rays, axis]


def _site(mission: Mission, shape: Shape) -> Trace:
    """A mark on the ground with the normal there."""
    site, size = mission.site, float(np.linalg.norm(shape.vertices_m, axis=1).max())
    normal = site.position_body + np.outer([0.005, 0.35], size * site.normal_body)
    marker = lines(normal, f"site {mission.scenario.site.name}", "site", palette.SITE, width=6)
    marker["mode"] = "lines+markers"
    marker["marker"] = {"size": [6, 0.1], "color": palette.SITE, "symbol": "diamond"}
    return moved(marker, "body")


def _plan(frame: Frame, one: Shown, number: int, flights: int) -> list[Trace]:
    subject, colour = one.subject, palette.PLANS[number]
    name, times = subject.name, subject.fine_s
    path = frame.seen(subject.positions(times))
    first, last = subject.mission.schedule.window_s
    seen = (times >= first) & (times <= last)
    craft = lines(path[:1], f"{name}: spacecraft", "spacecraft", colour)
    craft |= {"mode": "markers", "marker": {"size": 7, "color": colour, "symbol": "circle"}}
    craft["marker"]["line"] = {"color": "#ffffff", "width": 2}
    view = lines(path[:1], f"{name}: field of view", "field of view", palette.VIEW, width=4)
    dash = palette.DASHES[number]
    return [
        lines(path, name, "planned path", colour, width=5, dash=dash),
        lines(path[seen], f"{name}: window", "observation window", colour, width=11),
        *_sampled(frame, one, number, flights),
        *_tubes(frame, subject, number),
        *_burns(frame, subject),
        moved(craft, "craft", plan=number),
        moved(view, "view", plan=number),
    ]


def _sampled(frame: Frame, one: Shown, number: int, flights: int) -> list[Trace]:
    """Paths of some flights at the nodes, broken between them; and where they are at a time."""
    nodes = np.isin(one.flown.times_s, one.subject.mission.times_s)
    paths = frame.seen(one.flown.positions[nodes][:, :flights]).swapaxes(0, 1)
    broken = np.concatenate([paths, np.full((len(paths), 1, 3), np.nan)], axis=1)
    colour = palette.FLIGHTS[number]
    name = f"{one.subject.name}: {len(paths)} sampled flights"
    drawn = lines(broken.reshape(-1, 3), name, "sampled flights", colour, width=1)
    drawn["hoverinfo"] = "skip"
    cloud = lines(paths[:, 0], f"{name}, now", "sampled flights", colour)
    marker = {"size": 2.5, "color": palette.PLANS[number], "opacity": 0.6}
    cloud |= {"mode": "markers", "marker": marker, "hoverinfo": "skip"}
    return [moved(drawn, "", paths=number), moved(cloud, "cloud", plan=number)]


def _tubes(frame: Frame, subject: Subject, number: int) -> list[Trace]:
    states = np.array(subject.solution.nodes.state)
    covariance = np.array(subject.solution.nodes.covariance)[:, :3, :3]
    turned = frame.to_j2000.T @ covariance @ frame.to_j2000
    path = frame.seen(states[:, :3])
    apart = np.linalg.norm(np.gradient(path, axis=0), axis=1) > 0.0
    traces = []
    for sigmas, opacity in ((1, 0.3), (3, 0.14)):
        solid = solids.tube(path[apart], turned[apart], sigmas)
        name, group = f"{subject.name}: {sigmas} sigma", f"{sigmas} sigma tube"
        trace = mesh(solid, name, group, palette.PLANS[number], opacity)
        traces.append(trace | {"visible": sigmas == 3})
    return traces


def _burns(frame: Frame, subject: Subject) -> list[Trace]:
    """An arrow from where each is, as long as it is large."""
    starts, ends = arrows_of(frame, subject)
    gaps = np.full_like(starts, np.nan)
    points = np.stack([starts, ends, gaps], axis=1).reshape(-1, 3)
    trace = lines(points, f"{subject.name}: burns", "burns", palette.BURN, width=7)
    tips = lines(ends, f"{subject.name}: burns", "burns", palette.BURN)
    tips |= {"mode": "markers", "marker": {"size": 5, "color": palette.BURN, "symbol": "diamond"}}
    return [trace, tips]


def _layout(frame: Frame, subject: Subject, shape: Shape) -> dict[str, Any]:
    # What is written stands in annotations: letters in WebGL would take longer than all the rest.
    axes = {
        f"{axis}axis": {"title": {"text": ""}, "range": [low, high], "nticks": 4}
        for axis, low, high in zip(
            "xyz", compact(frame.low_m, 0), compact(frame.high_m, 0), strict=True
        )
    }
    # One scale for all axes and for good: "data" would take another when a set is shown.
    size = frame.high_m - frame.low_m
    aspect = dict(zip("xyz", compact(size / np.cbrt(size.prod()), 6), strict=True))
    camera = {
        "eye": {"x": 1.5, "y": -1.25, "z": 0.5},
        "center": {"x": 0, "y": 0, "z": -0.15},  # the X axis's name is below the box
        "up": {"x": 0, "y": 0, "z": 1},
    }
    return {
        "scene": {
            **axes,
            "aspectmode": "manual",
            "aspectratio": aspect,
            "camera": camera,
            "dragmode": "orbit",
            "annotations": _words(frame, subject, shape),
        },
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "showlegend": False,
    }


def _words(frame: Frame, subject: Subject, shape: Shape) -> list[dict[str, Any]]:
    """Names of axes, Sun, north, and the first plan's burns."""
    mission, low, high = subject.mission, frame.low_m, frame.high_m
    middle = 0.5 * (low + high)
    size = float(np.linalg.norm(shape.vertices_m, axis=1).max())
    north = 1.5 * size * frame.seen(mission.rotation.pole)
    sun = SUN_TO * size * frame.seen(mission.sun_direction(0.0))
    named = [
        ((middle[0], low[1], low[2]), X_NAME),
        ((high[0], middle[1], low[2]), "Y (m)"),
        ((low[0], low[1], middle[2]), Z_NAME),
        (sun, "Sun"),
        (north, "N"),
    ]
    sizes = np.linalg.norm(subject.solution.burns_m_s, axis=1)
    first = 1 + mission.scenario.burns_flown
    for number, (at, size) in enumerate(
        zip(arrows_of(frame, subject)[1], sizes, strict=True), first
    ):
        named.append((at, f"{number}: {1000.0 * size:.1f} mm/s"))
    found = []
    for at, text in named:
        where = dict(zip("xyz", compact(np.array(at), 1), strict=True))
        # The first two are at the view's left: to their right there is room.
        anchor = "left" if text in (X_NAME, Z_NAME) else "center"
        style = {"showarrow": False, "yshift": 10, "xanchor": anchor, "font": {"size": 12}}
        found.append(where | {"text": text} | style)
    return found
