"""Draw a plan's flight: its path with sampled flights, its burns, its attitude modes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Polygon
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator, MultipleLocator
from scipy.spatial import ConvexHull

from formulations.arrays import Array
from paper_figs.drawing import BURN, Look, draw_burns, history, place_labels
from paper_figs.inputs import FlownPlan, Runs
from paper_figs.observation import SEED, observed, planned_positions
from scp_recon.display import mm_s
from scp_recon.mission.constraints import companion_distance_m
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import Mode
from scp_recon.monte_carlo.sampling import sample_positions
from scp_recon.physics import geometry
from scp_recon.physics.frames import sun_north_to_j2000
from scp_recon.results.pictures import legend, page, plain
from scp_recon.results.solution import Solution

PATHS_SHOWN = 150
ARROW = 0.2
"""In the flyby: arrow of the largest burn over the extent of the path."""

PATHS, TIMES = 60, 600
SIGMAS = ((2.0, "0.87", "2 sigma"), (1.0, "0.7", "1 sigma"))
PLANE_ARROW, MARGIN, TICKS = 0.12, 0.06, 7
"""On the J2000 planes: the largest burn's arrow over the longest side, the room around all that is
drawn, and ticks at most."""
AXES = ("x", "y", "z")
PLANES = ((1, 2), (0, 2), (1, 0))
"""Horizontal and vertical axis of each panel, placed so that neighbours share one."""


def flyby(solution: Solution) -> Figure:
    """The path seen from the Sun with sampled flights; the observation geometry in the window."""
    mission = solution.mission
    seen = seen_from_sun(mission, np.array(solution.nodes.state)[:, :3])
    across, up = np.ptp(np.vstack([seen, np.zeros(2)]), axis=0)
    with page(1.2 + 3.5 * min(up / across, 1.0), 8.6) as figure:
        path, *histories = figure.subplots(1, 4, width_ratios=(3.0, 1.0, 1.0, 1.0))
        _path(path, mission, solution)
        _histories(histories, mission, solution)
        path.set_title(
            f"{plain(mission.scenario.site.name)} on {plain(mission.scenario.body.name)}: "
            f"{mm_s(solution.total_dv_m_s, 1)} in {len(solution.executed)} burns",
            fontweight="bold",
        )
        legend(figure, 7, columnspacing=1.2, handlelength=1.6)
        starts, arrows, _ = _burns_from_sun(mission, solution)
        sizes = [1e3 * float(np.linalg.norm(burn.dv_m_s)) for _, burn in solution.executed]
        words = [
            f"{n}: {size:.0f} mm/s" for (n, _), size in zip(solution.executed, sizes, strict=True)
        ]
        along = (starts + np.linspace(0.0, 1.0, 9)[:, None, None] * arrows).reshape(-1, 2)
        place_labels(path, starts, words, np.vstack([seen, along]), color=BURN, fontsize=8)
    return figure


def seen_from_sun(mission: Mission, vectors: Array) -> Array:
    """Sun-North Y and Z in km; the Sun is behind the viewer, so Y points right."""
    to_frame = sun_north_to_j2000(mission.sun_direction(0.0), mission.rotation.pole)
    return (vectors @ to_frame)[..., 1:] / 1000.0


def _burns(solution: Solution, project: Callable[[Array], Array]) -> tuple[Array, Array]:
    """Positions and sizes of the burns that are not zero, projected, shape (m, 2) each."""
    nodes, fired = solution.mission.burn_nodes, solution.burns_m_s.any(axis=1)
    places = np.array(solution.nodes.state)[nodes[fired], :3]
    return project(places), project(solution.burns_m_s[fired])


def _burns_from_sun(mission: Mission, solution: Solution) -> tuple[Array, Array, float]:
    """Positions of the burns that are not zero, their arrows, km, (m, 2) each, and km per m/s."""
    starts, burns = _burns(solution, partial(seen_from_sun, mission))
    extent = float(np.ptp(np.array(solution.nodes.state)[:, :3], axis=0).max()) / 1000.0
    scale = ARROW * extent / max(np.linalg.norm(solution.burns_m_s, axis=1).max(), 1e-12)
    return starts, 1000.0 * scale * burns, scale


def _path(axes: Axes, mission: Mission, solution: Solution) -> None:
    seen, times = partial(seen_from_sun, mission), mission.times_s
    burns, policy = solution.burns_m_s, solution.corrections
    samples = seen(sample_positions(mission, burns, times, PATHS_SHOWN, SEED, policy))
    axes.plot(samples[..., 0], samples[..., 1], color="0.7", lw=0.4, alpha=0.6, zorder=1)
    axes.plot([], [], color="0.6", lw=1, label=f"{PATHS_SHOWN} sampled flights")
    mean = seen(np.array(solution.nodes.state)[:, :3])
    axes.plot(*mean.T, color="k", lw=1.2, label="plan", zorder=3)
    window = mission.window_nodes
    axes.plot(*mean[window].T, color="C0", lw=4, solid_capstyle="butt", label="window", zorder=3)
    track = geometry.track(mission.site, mission.rotation, times[window])
    axes.plot(*seen(track.position).T, color="C4", lw=3, label="site in the window", zorder=3)
    axes.add_patch(_body(mission))
    companion, amid = mission.scene.companion, float(np.mean(mission.schedule.window_s))
    if companion is not None:
        way, at = seen(companion.position(times)), seen(companion.position(amid))
        axes.plot(*way.T, color="C2", lw=1, ls=":", label="companion's path")
        radius, label = companion_distance_m(mission.scenario) / 1e3, "kept clear, mid-window"
        look: Look = {"facecolor": "none", "edgecolor": "C2", "zorder": 2}
        axes.add_patch(Circle(tuple(at), radius, label=label, **look))
    starts, arrows, scale = _burns_from_sun(mission, solution)
    size = float(f"{500.0 * np.linalg.norm(burns, axis=1).max():.1g}")
    arrow = draw_burns(axes, starts, arrows)
    axes.quiverkey(arrow, 0.76, 0.06, 1e-3 * scale * size, f"{size:g} mm/s", labelpos="E")
    axes.set(xlabel="Sun-North Y (km), seen from the Sun", ylabel="Sun-North Z (km)")
    axes.set_aspect("equal")
    axes.margins(0.12)


def _body(mission: Mission) -> Patch:
    """The body's outline in the middle of the window; a circle where its shape is not known."""
    look: Look = {"facecolor": "0.9", "edgecolor": "0.4", "zorder": 2}
    body = mission.scenario.body
    if body.solid is None and body.radii_m is None:
        return Circle((0.0, 0.0), float(np.linalg.norm(mission.site.position_body)) / 1e3, **look)
    axes = mission.rotation.body_to_j2000(np.mean(mission.schedule.window_s))
    corners = seen_from_sun(mission, mission.gravity.solid.vertices_m @ axes.T)
    return Polygon(corners[ConvexHull(corners).vertices], **look)


def _histories(panels: Sequence[Axes], mission: Mission, solution: Solution) -> None:
    window = mission.schedule.window_s
    times = np.linspace(*window, 61)
    for axes, quantity in zip(panels, observed(solution, times), strict=True):
        history(axes, times, quantity.sampled, quantity.plan, quantity.limits, window)
        axes.set_title(quantity.label)
        axes.xaxis.set_major_locator(MaxNLocator(3))
    panels[1].set_xlabel("time past the epoch (s)")


def trajectories(runs: Runs) -> Figure:
    """Front, side and top view as in a technical drawing, J2000, the legend in the free corner."""
    mission, burns = runs.plan.mission, runs.plan.solution.burns_m_s
    times = np.linspace(0.0, mission.times_s[-1], TIMES)
    policy = runs.plan.solution.corrections
    sampled = sample_positions(mission, burns, mission.times_s, PATHS, SEED, policy)
    flights = sampled.transpose(1, 0, 2) / 1000.0
    plan, reference, window = (
        planned_positions(mission, of, at) / 1000.0
        for of, at in (
            (burns, times),
            (runs.reference.solution.burns_m_s, times),
            (burns, np.array(mission.schedule.window_s)),
        )
    )
    low, high = _reach(runs.plan, np.vstack([plan, reference, flights.reshape(-1, 3)]))
    spans, words = high - low, [str(number) for number, _ in runs.plan.solution.executed]
    arrow = PLANE_ARROW * float(spans.max())
    scale = arrow / max(np.linalg.norm(burns, axis=1).max(), 1e-12)
    locator = MaxNLocator(TICKS, steps=[1, 2, 5, 10])
    step = float(np.diff(locator.tick_values(0.0, spans.max()))[0])
    sides: Look = {"width_ratios": spans[[1, 0]], "height_ratios": spans[[2, 0]]}
    with page(5.95) as figure:
        panels = figure.subplots(2, 2, **sides)
        ends = list[tuple[Array, Array]]()
        shown = [(axes, list(pair)) for axes, pair in zip(panels.flat, PLANES, strict=False)]
        for axes, pair in shown:
            _dispersions(axes, runs.plan, times, plan[:, pair], pair)
            look: Look = {"colors": "0.35", "linewidths": 0.3, "alpha": 0.6, "zorder": 2}
            axes.add_collection(LineCollection(list(flights[..., pair]), **look))
            axes.plot([], [], color="0.35", lw=0.6, label=f"{PATHS} sampled flights")
            axes.plot(*plan[:, pair].T, "k-", lw=1.4, label="plan", zorder=4)
            label = runs.reference.label.replace(" (", "\n(")
            axes.plot(*reference[:, pair].T, "k:", lw=1.4, label=label, zorder=4)
            _spheres(axes, mission)
            starts, sizes = _burns(runs.plan.solution, partial(np.take, indices=pair, axis=1))
            starts, arrows = starts / 1000.0, scale * sizes
            ends.append((starts, starts + arrows))
            draw_burns(axes, starts, arrows)
            label = f"burns {', '.join(words)}, arrows to scale"
            axes.plot(*starts.T, "o", color=BURN, ms=4.5, zorder=7, label=label)
            look = {"mfc": "w", "mec": "k", "ms": 5, "zorder": 6}
            axes.plot(*window[:, pair].T, "s", label="window opens, closes", **look)
            across, up = (f"J2000 {AXES[axis]} (km)" for axis in pair)
            (left, right), (bottom, top) = zip(low[pair], high[pair], strict=True)
            axes.set(xlabel=across, ylabel=up, xlim=(left, right), ylim=(bottom, top))
            axes.set(aspect="equal", axisbelow=True)
            axes.xaxis.set_major_locator(MultipleLocator(step))
            axes.yaxis.set_major_locator(MultipleLocator(step))
        look = {"color": BURN, "fontweight": "bold", "zorder": 7}
        look["path_effects"] = [withStroke(linewidth=2.5, foreground="w")]
        for (axes, _), (starts, tips) in zip(shown, ends, strict=True):
            place_labels(axes, tips, words, np.vstack([starts, tips]), **look)
        corner = panels[1, 1]
        corner.axis("off")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        corner.legend(handles, labels, loc="center", borderaxespad=0.0)
    return figure


def _reach(flown: FlownPlan, drawn: Array) -> tuple[Array, Array]:
    """Least and greatest coordinates of paths, the widest band and the keep-out sphere, with room."""
    safe, nodes = flown.mission.scenario.safety.radius_min_m / 1000.0, flown.solution.nodes
    variance = np.diagonal(np.array(nodes.covariance), axis1=1, axis2=2)[:, :3]
    band = max(sigmas for sigmas, *_ in SIGMAS) * np.sqrt(variance) / 1000.0
    mean = np.array(nodes.state)[:, :3] / 1000.0
    drawn = np.vstack([drawn, mean - band, mean + band, np.full(3, safe), np.full(3, -safe)])
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    room = MARGIN * float((high - low).max())
    return low - room, high + room


def _dispersions(axes: Axes, flown: FlownPlan, times: Array, path: Array, pair: list[int]) -> None:
    """Draw ellipses of the planned covariance along the path, dense enough for a band."""
    nodes, stored = flown.mission.times_s, np.array(flown.solution.nodes.covariance)
    covariance = np.empty((len(times), 2, 2))
    for i, j in np.ndindex(2, 2):
        covariance[:, i, j] = np.interp(times, nodes, stored[:, pair[i], pair[j]])
    variance, direction = np.linalg.eigh(covariance)
    narrow, wide = np.sqrt(np.maximum(variance, 0.0)).T / 1000.0
    angles = np.rad2deg(np.arctan2(direction[:, 1, 1], direction[:, 0, 1]))
    at: Look = {"units": "xy", "offsets": path, "offset_transform": axes.transData}
    for sigmas, shade, name in SIGMAS:
        look = at | {"facecolors": shade, "edgecolors": "none", "zorder": 1}
        widths = 2.0 * sigmas * wide, 2.0 * sigmas * narrow
        axes.add_collection(EllipseCollection(*widths, angles, **look))
        axes.fill([], [], color=shade, label=name)


def _spheres(axes: Axes, mission: Mission) -> None:
    """Draw the sphere through the site, and the keep-out sphere."""
    radius = float(np.linalg.norm(mission.site.position_body)) / 1000.0
    safe = mission.scenario.safety.radius_min_m / 1000.0
    body: Look = {"facecolor": "0.93", "edgecolor": "k", "hatch": "....", "lw": 0.8, "zorder": 0.6}
    ring: Look = {"fill": False, "edgecolor": "k", "ls": "--", "lw": 0.8, "zorder": 0.6}
    label = f"{mission.scenario.body.name}, sphere through the site"
    axes.add_patch(Circle((0.0, 0.0), radius, label=label, **body))
    axes.add_patch(Circle((0.0, 0.0), safe, label=f"closest allowed, {safe:g} km", **ring))


def control_history(runs: Runs) -> Figure:
    """Burn sizes with their limit above, angles to the Sun with the keep-out bands below."""
    mission, fired = runs.plan.mission, [burn for _, burn in runs.plan.solution.executed]
    times = np.array([burn.t_s for burn in fired])
    burns = np.array([burn.dv_m_s for burn in fired])
    sizes = 1000.0 * np.linalg.norm(burns, axis=1)
    angles = np.rad2deg(geometry.angle(burns, mission.sun_direction(times)))
    cone = mission.scenario.battery.delta_v_cone_deg
    limit, window = 1000.0 * mission.scenario.burns.dv_max_m_s, mission.schedule.window_s
    with page(4.2) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True)
        top.vlines(times, 0.0, sizes, color="k", lw=2)
        top.axhline(limit, color="k", ls="--", lw=1)
        look: Look = {"textcoords": "offset points", "ha": "right", "va": "top"}
        top.annotate(f"limit {limit:g} mm/s", (times[-1], limit), (0, -4), **look)
        top.set(ylabel="burn size (mm/s)", ylim=(0.0, 1.12 * limit))
        look = {"ha": "center", "va": "center"}
        box: Look = {"facecolor": "w", "edgecolor": "none", "pad": 1.5}
        for low, way in ((0.0, "the Sun"), (180.0 - cone, "the anti-Sun")):
            hatched: Look = {"facecolor": "0.88", "edgecolor": "0.55", "hatch": "///"}
            bottom.axhspan(low, low + cone, lw=0, **hatched)
            text = f"keep-out: within {cone:g} deg of {way}"
            bottom.text(0.5 * times[-1], low + 0.5 * cone, text, bbox=box, **look)
        bottom.set(
            ylabel="angle to the Sun (deg)", xlabel="time past the epoch (s)", ylim=(0.0, 180.0)
        )
        bottom.set_yticks(np.arange(0, 181, 30))
        top.text(float(np.mean(window)), 0.5 * limit, "observation\nwindow", size=8, **look)
        for axes, values in ((top, sizes), (bottom, angles)):
            axes.plot(times, values, "ko", ms=5)
            axes.axvspan(*window, facecolor="0.92", edgecolor="none", zorder=0)
            axes.set_xlim(-0.02 * times[-1], 1.02 * times[-1])
        for axes, values in ((top, sizes), (bottom, angles)):
            marked = np.column_stack([times, values])
            place_labels(axes, marked, [f"{value:.1f}" for value in values], marked)
    return figure


RULES = {
    "slew": ("0.55", "attitude_s"),
    "heating": ("C4", "heating_s"),
    "recharge": ("C2", "recharge_s"),
}
"""Colour of what a mode begins with, and the rule that says how long it takes."""
REST, LIT = "#cfe3ef", "#fbf6c0"
IN_MODE = {
    Mode.DELTA_V: ("slew", "heating"),
    Mode.OBSERVATION: ("slew",),
    Mode.SUN_POINTING: ("slew", "recharge"),
}


def modes(mission: Mission) -> Figure:
    """The attitude modes of a flight, what each begins with, and where burns may be."""
    schedule, scenario, rows = mission.schedule, mission.scenario, list(IN_MODE)
    with page(2.6) as figure:
        axes = figure.subplots()
        for leg in schedule.legs:
            row, begin = rows.index(leg.mode) + 1, leg.start_s
            axes.barh(row, leg.end_s - begin, 0.6, begin, fc=REST, lw=0)
            for name in IN_MODE[leg.mode]:
                colour, rule = RULES[name]
                length = getattr(scenario.schedule, rule)
                axes.barh(row, length, 0.6, begin, fc=colour, lw=0)
                begin += length
        burns = zip(scenario.burns.times_s, schedule.firing_intervals_s, strict=True)
        for time, (early, late) in burns:
            late = min(late, scenario.duration_s + 600.0)
            axes.plot(
                [early, late], [0.0, 0.0], color=BURN, lw=5.0, alpha=0.35, solid_capstyle="butt"
            )
            axes.plot(time, 0.0, "v", color=BURN, ms=7)
        axes.axvspan(*schedule.window_s, fc=LIT, lw=0, zorder=0)
        for name, (colour, _) in RULES.items():
            axes.barh(0, 0, fc=colour, label=name)
        axes.barh(0, 0, fc=REST, label="rest of the mode")
        axes.barh(0, 0, fc=LIT, label="observation window")
        axes.plot([], [], "v", color=BURN, label="burn, and its legal times")
        axes.set_yticks(range(len(rows) + 1), ["burns", *rows])
        axes.invert_yaxis()
        axes.set(xlabel="time past the epoch (s)", xlim=(-600.0, scenario.duration_s + 600.0))
        legend(figure, 3)
    return figure
