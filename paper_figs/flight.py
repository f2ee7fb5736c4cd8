"""Draw a plan: its path, burns and modes, what it observes, where flights end, its polytopes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Polygon
from matplotlib.ticker import MaxNLocator
from scipy.interpolate import interp1d
from scipy.spatial import ConvexHull, HalfspaceIntersection
from scipy.stats import norm

from formulations.arrays import Array
from formulations.problem.facets import inner_facets, outer_facets, paper_ball
from formulations.problem.regions import Ball, Halfspaces
from paper_figs.drawing import BURN, Look, draw_burns, history
from paper_figs.inputs import Runs
from scp_recon.display import mm_s
from scp_recon.mission.constraints import companion_distance_m
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import Mode
from scp_recon.monte_carlo.limits import measured
from scp_recon.monte_carlo.sampling import Flyer, flown_mission
from scp_recon.monte_carlo.summary import COMPONENTS
from scp_recon.physics import geometry
from scp_recon.physics.frames import sun_north_to_j2000
from scp_recon.reports.histories import History, observed_over
from scp_recon.reports.pictures import legend, page, plain
from scp_recon.results.comparison import path_of
from scp_recon.results.solution import Solution, require_whole_flight

SAMPLES, SEED = 2000, 1
PATHS_SHOWN, PATHS = 150, 60
"""Sampled flights seen from the Sun, and on the planes of J2000."""
ARROW, PLANE_ARROW = 0.2, 0.12
"""The largest burn's arrow over the extent of what is drawn, seen from the Sun and on planes."""
TIMES = 600
SIGMAS = ((2.0, "0.87", "2 sigma"), (1.0, "0.7", "1 sigma"))
PLANES = ((1, 2), (0, 2), (1, 0))
"""Horizontal and vertical axis of each panel, placed so that neighbours share one."""
BEFORE_AND_AFTER_S = 1500.0
"""Time shown before the window and after it, s."""
BINS = 34
"""Bins across the window, of about a hundred seconds each."""
TURN = np.linspace(0.0, 2.0 * np.pi, 181)
FAR = 10.0
"""Length of the half-plane that a facet allows, over its distance."""
REACH = 4.0
"""Standard deviations shown; the outermost of the quantiles lies at 2.3 of a normal variable's."""


def observed(solution: Solution, times_s: Array, samples: int | None = None) -> list[History]:
    """Site distance, emission and phase at times of the flight, shape (n,), with sampled flights."""
    mission, count = solution.mission, samples or SAMPLES
    burns, policy = solution.burns_m_s, solution.corrections
    sampled = Flyer(mission, burns, policy, seed=SEED).first_positions(times_s, count)
    planned = measured(mission, times_s, path_of(solution)(times_s))
    flown = measured(flown_mission(mission, SEED, count), times_s, sampled)
    return observed_over(mission, times_s, planned, flown)


def flyby(solution: Solution) -> Figure:
    """The path seen from the Sun with sampled flights; the observation geometry in the window.

    Raises:
        InputError: for a plan made in flight.
    """
    require_whole_flight(solution.scenario, "solution")
    mission = solution.mission
    seen = seen_from_sun(mission, np.array(solution.nodes.state)[:, :3])
    across, up = np.ptp(np.vstack([seen, np.zeros(2)]), axis=0)
    with page(1.2 + 3.5 * min(up / across, 1.0), 8.6) as figure:
        path, *histories = figure.subplots(1, 4, width_ratios=(3.0, 1.0, 1.0, 1.0))
        _path(path, mission, solution)
        window = mission.schedule.window_s
        for axes, shown in zip(
            histories, observed(solution, np.linspace(*window, 61)), strict=True
        ):
            history(axes, shown, window)
            axes.set_title(shown.title, size=8)
            axes.xaxis.set_major_locator(MaxNLocator(2))
        histories[1].set_xlabel("time past the epoch (s)")
        path.set_title(
            f"{plain(mission.scenario.site.name)} on {plain(mission.scenario.body.name)}: "
            f"{mm_s(solution.total_dv_m_s, 1)} in {len(solution.executed)} burns",
            fontweight="bold",
        )
        legend(figure, 7, columnspacing=1.2, handlelength=1.6)
    return figure


def seen_from_sun(mission: Mission, vectors: Array) -> Array:
    """Sun-North Y and Z in km; the Sun is behind the viewer, so Y points right."""
    to_frame = sun_north_to_j2000(mission.sun_direction(0.0), mission.rotation.pole)
    return (vectors @ to_frame)[..., 1:] / 1000.0


def _executed(solution: Solution) -> tuple[Array, Array, list[str]]:
    """Positions, m, and sizes, m/s, of the burns that are not zero, J2000, and their numbers."""
    fired = solution.burns_m_s.any(axis=1)
    places = np.array(solution.nodes.state)[solution.mission.burn_nodes[fired], :3]
    return places, solution.burns_m_s[fired], [str(number) for number, _ in solution.executed]


def _path(axes: Axes, mission: Mission, solution: Solution) -> None:
    seen, times, burns = partial(seen_from_sun, mission), mission.times_s, solution.burns_m_s
    samples = Flyer(mission, burns, solution.corrections, seed=SEED).first_positions(
        times, PATHS_SHOWN
    )
    axes.plot(*np.moveaxis(seen(samples), -1, 0), color="0.7", lw=0.4, alpha=0.6, zorder=1)
    axes.plot([], [], color="0.6", lw=1, label=f"{PATHS_SHOWN} sampled flights")
    mean, window = seen(np.array(solution.nodes.state)[:, :3]), mission.window_nodes
    axes.plot(*mean.T, color="k", lw=1.2, label="plan", zorder=3)
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
    starts, sizes, numbers = _executed(solution)
    largest = float(np.linalg.norm(sizes, axis=1).max(initial=1e-12))
    scale = ARROW * float(np.ptp(mean, axis=0).max()) / largest
    words = [
        f"{n}: {1e3 * np.linalg.norm(dv):.0f} mm/s" for n, dv in zip(numbers, sizes, strict=True)
    ]
    arrows = draw_burns(axes, seen(starts), 1000.0 * scale * seen(sizes), words)
    size = float(f"{500.0 * largest:.1g}")
    axes.quiverkey(arrows, 0.76, 0.06, 1e-3 * scale * size, f"{size:g} mm/s", labelpos="E")
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
    corners = seen_from_sun(mission, mission.scene.solid.vertices_m @ axes.T)
    return Polygon(corners[ConvexHull(corners).vertices], **look)


def trajectories(runs: Runs) -> Figure:
    """Front, side and top view as in a technical drawing, J2000, the legend in the free corner."""
    solution, mission = runs.plan.solution, runs.plan.solution.mission
    times = np.linspace(0.0, mission.times_s[-1], TIMES)
    plan, reference = (path_of(s)(times) / 1e3 for s in (solution, runs.reference.solution))
    edges = path_of(solution)(np.array(mission.schedule.window_s)) / 1e3
    burns, policy = solution.burns_m_s, solution.corrections
    sampled = Flyer(mission, burns, policy, seed=SEED).first_positions(mission.times_s, PATHS) / 1e3
    starts, sizes, numbers = _executed(solution)
    safe = np.full((1, 3), mission.scenario.safety.radius_min_m / 1e3)
    spans = np.ptp(np.vstack([reference, *sampled, safe, -safe]), axis=0) + PLANE_ARROW
    largest = np.linalg.norm(sizes, axis=1).max(initial=1e-12)
    arrows = PLANE_ARROW * spans.max() * sizes / largest
    sides: Look = {"width_ratios": spans[[1, 0]], "height_ratios": spans[[2, 0]]}
    with page(5.95) as figure:
        panels = figure.subplots(2, 2, **sides)
        for axes, pair in zip(panels.flat, map(list, PLANES), strict=False):
            _dispersions(axes, solution, times, plan[:, pair], pair)
            look: Look = {"colors": "0.35", "linewidths": 0.3, "alpha": 0.6, "zorder": 2}
            axes.add_collection(LineCollection(list(sampled[..., pair].swapaxes(0, 1)), **look))
            axes.plot([], [], color="0.35", lw=0.6, label=f"{PATHS} sampled flights")
            axes.plot(*plan[:, pair].T, "k-", lw=1.4, label="plan", zorder=4)
            axes.plot(*reference[:, pair].T, "k:", lw=1.4, label=runs.reference.label, zorder=4)
            _spheres(axes, mission)
            draw_burns(axes, starts[:, pair] / 1e3, arrows[:, pair], numbers)
            axes.plot([], [], "o", color=BURN, ms=3, label="burns, arrows to scale")
            look = {"mfc": "w", "mec": "k", "ms": 5, "zorder": 6}
            axes.plot(*edges[:, pair].T, "s", label="window opens, closes", **look)
            across, up = (f"J2000 {'xyz'[axis]} (km)" for axis in pair)
            axes.set(xlabel=across, ylabel=up, aspect="equal", adjustable="datalim")
        panels[1, 1].axis("off")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        panels[1, 1].legend(handles, labels, loc="center", borderaxespad=0.0)
    return figure


def _dispersions(
    axes: Axes, solution: Solution, times: Array, path: Array, pair: list[int]
) -> None:
    """Draw ellipses of the planned covariance along the path, dense enough for a band."""
    stored = np.array(solution.nodes.covariance)[:, pair][:, :, pair]
    covariance = interp1d(solution.nodes.t_s, stored, axis=0)(times)
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
    solution, mission = runs.plan.solution, runs.plan.solution.mission
    times = np.array([burn.t_s for _, burn in solution.executed])
    _, burns, _ = _executed(solution)
    sizes = 1000.0 * np.linalg.norm(burns, axis=1)
    angles = np.rad2deg(geometry.angle(burns, mission.sun_direction(times)))
    cone = mission.scenario.battery.delta_v_cone_deg
    limit, window = 1000.0 * mission.scenario.burns.dv_max_m_s, mission.schedule.window_s
    with page(4.2) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True)
        top.vlines(times, 0.0, sizes, color="k", lw=2)
        top.axhline(limit, color="k", ls="--", lw=1, label=f"limit {limit:g} mm/s")
        top.set(ylabel="burn size (mm/s)", ylim=(0.0, 1.12 * limit))
        look: Look = {"facecolor": "0.88", "edgecolor": "0.55", "hatch": "///", "lw": 0}
        bottom.axhspan(0.0, cone, label=f"keep-out: within {cone:g} deg of the Sun line", **look)
        bottom.axhspan(180.0 - cone, 180.0, **look)
        bottom.set(ylabel="angle to the Sun (deg)", ylim=(0.0, 180.0))
        bottom.set_yticks(np.arange(0, 181, 30))
        for axes, values in ((top, sizes), (bottom, angles)):
            axes.plot(times, values, "ko", ms=5)
            axes.axvspan(*window, facecolor="0.92", lw=0, zorder=0, label="observation window")
            axes.set_xlim(-0.03 * times[-1], 1.05 * times[-1])
            for time, value in zip(times, values, strict=True):
                axes.annotate(f"{value:.1f}", (time, value), (6, 4), textcoords="offset points")
        bottom.set_xlabel("time past the epoch (s)")
        legend(figure, 3)
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
        end = scenario.duration_s + 600.0
        look: Look = {"lw": 5.0, "alpha": 0.35, "color": BURN}
        burns = zip(scenario.burns.times_s, schedule.firing_intervals_s, strict=True)
        for time, (early, late) in burns:
            axes.plot([early, min(late, end)], [0.0, 0.0], solid_capstyle="butt", **look)
            axes.plot(time, 0.0, "v", color=BURN, ms=7)
        axes.axvspan(*schedule.window_s, fc=LIT, lw=0, zorder=0)
        for name, (colour, _) in RULES.items():
            axes.barh(0, 0, fc=colour, label=name)
        axes.barh(0, 0, fc=REST, label="rest of the mode")
        axes.barh(0, 0, fc=LIT, label="observation window")
        axes.plot([], [], "v", color=BURN, label="burn, and its legal times")
        axes.set_yticks(range(len(rows) + 1), ["burns", *rows])
        axes.invert_yaxis()
        axes.set(xlabel="time past the epoch (s)", xlim=(-600.0, end))
        legend(figure, 3)
    return figure


def observation_histories(runs: Runs) -> Figure:
    """Distance, emission and phase with their spread, limits in the window, and the reference."""
    first, last = runs.plan.solution.mission.schedule.window_s
    times = np.linspace(first - BEFORE_AND_AFTER_S, last + BEFORE_AND_AFTER_S, 107)
    plan, reference = (
        observed(runs.plan.solution, times),
        observed(runs.reference.solution, times, 1),
    )
    with page(5.6) as figure:
        panels = figure.subplots(3, 1, sharex=True)
        for axes, own, other in zip(panels, plan, reference, strict=True):
            history(axes, own, (first, last))
            axes.plot(times, other.planned, "k:", lw=1.4, label=runs.reference.label)
            for edge in (first, last):
                axes.axvline(edge, color="0.4", lw=0.8)
            axes.set_ylabel(own.title)
        panels[0].set_title(f"observation window, {last - first:.0f} s")
        panels[-1].set_xlabel("time past the epoch (s)")
        legend(figure, 5)
    return figure


def observation_times(runs: Runs) -> Figure:
    """Times for which flights keep limits: the plan's filled, the reference's in outline."""
    first, last = runs.plan.solution.mission.schedule.window_s
    edges = np.linspace(0.0, last - first, BINS + 1)
    plan: Look = {"histtype": "stepfilled", "fc": "0.75", "ec": "k", "lw": 0.6}
    reference: Look = {"histtype": "step", "ec": "k", "ls": "--", "lw": 1.2}
    with page(4.6) as figure:
        panels = figure.subplots(2, 1, sharex=True, sharey=True)
        for axes, name in zip(panels, ("emission", "site_distance"), strict=True):
            words = []
            for (label, _, summary), look in ((runs.plan, plan), (runs.reference, reference)):
                held = summary.held_s[name]
                # Bins are coarser than the summary's.
                middles = np.array(held.histogram.start) + 0.5 * held.histogram.bin
                share = 100.0 * np.array(held.histogram.count) / summary.samples
                inside = np.clip(middles, edges[0], edges[-1])
                axes.hist(inside, edges, weights=share, label=label, log=True, **look)
                whole = 100.0 * held.throughout.estimate.value
                words.append(f"{label}: {whole:.1f} % throughout the window".replace("\n", " "))
            box: Look = {"facecolor": "w", "edgecolor": "none", "alpha": 0.9, "pad": 1.0}
            at: Look = {"transform": axes.transAxes, "ha": "center", "va": "top"}
            axes.text(0.5, 0.96, "\n".join(words), bbox=box, **at)
            axes.set_title(f"{name.replace('_', ' ')} limits held", loc="left")
            axes.set(ylabel="share of flights (%)", xlim=(edges[0], edges[-1]), ylim=(None, 200.0))
            axes.yaxis.set_major_formatter("{x:g}")
        panels[-1].set_xlabel("time held in the observation window (s)")
        legend(figure, 2)
    return figure


def terminal_normality(runs: Runs) -> Figure:
    """A quantile-quantile panel per component of the final state, J2000."""
    tests = runs.plan.summary.terminal.normality
    with page(4.8) as figure:
        panels = figure.subplots(2, 3, sharex=True, sharey=True)
        for axes, name in zip(panels.flat, COMPONENTS, strict=True):
            test, reach = tests[name], (-REACH, REACH)
            axes.axline((0.0, 0.0), slope=1.0, color="0.5", lw=1.0, ls="--", label="normal")
            expected = norm.ppf(test.levels)
            axes.plot(expected, test.quantiles, "o", ms=2.5, color="k", label="sampled flights")
            axes.set_title(f"{name}: p-value {test.p_value:.1g}", loc="left")
            axes.set(xlim=reach, ylim=reach, aspect="equal")
            axes.set(xlabel="normal quantile (sigma)", ylabel="sampled quantile (sigma)")
            axes.label_outer()
        legend(figure, 2)
    return figure


def ball_polytopes(runs: Runs) -> Figure:
    """Keep-in on the left and keep-out on the right, in the plane of the widest spread.

    Where the upper limit is closest to binding; with exact risk that is the joint constraint's node.
    Polytopes are the paper's where the plan has tangent planes alone.
    """
    solution, mission = runs.plan.solution, runs.plan.solution.mission
    names = "site_distance_max", "site_distance"
    worst = next(c.worst_t_s for c in solution.constraints if c.name in names)
    node = int(np.argmin(np.abs(mission.times_s - worst)))
    site = geometry.track(mission.site, mission.rotation, mission.times_s[[node]]).position[0]
    line = np.array(solution.nodes.state[node])[:3] - site
    covariance = np.array(solution.nodes.covariance[node])[:3, :3]
    sight = line / np.linalg.norm(line)
    across = np.eye(3) - np.outer(sight, sight)
    widest = np.linalg.eigh(across @ covariance @ across)[1][:, -1]
    frame = np.stack([sight, widest, np.cross(sight, widest)], axis=1)
    own, limits = mission.polytopes, mission.scenario.observation
    polytopes = own if own.ball else replace(own, ball=paper_ball())
    least, most = limits.site_distance_min_m, limits.site_distance_max_m
    point, spread = frame.T @ line, frame.T @ covariance @ frame
    with page(4.0) as figure:
        panels = figure.subplots(1, 2, subplot_kw={"aspect": "equal"})
        for axes, place, radius in zip(
            panels, (inner_facets, outer_facets), (most, least), strict=True
        ):
            planes = place(Ball(site[None], radius), polytopes, (site + line)[None])
            normal = np.concatenate([plane.normal for plane in planes])
            offset = np.concatenate([plane.offset for plane in planes]) - normal @ site
            section = Halfspaces(normal @ frame, offset)
            if radius == most:
                _keep_in(axes, section)
            else:
                _keep_out(axes, section, point, spread)
            circle = radius * np.stack([np.cos(TURN), np.sin(TURN)])
            axes.plot(*circle, "C0--", lw=1.2, label="sphere of the limit")
            _spread(axes, point, spread)
            axes.plot(0.0, 0.0, "k^", ms=5, label="site")
            words = "in: at most" if radius == most else "out: at least"
            axes.set_title(f"keep {words} {radius:g} m from the site")
            reach = 1.08 * most * np.array([-1.0, 1.0])
            axes.set(xlabel="to the spacecraft (m)", ylabel="across (m)", xlim=reach, ylim=reach)
        legend(figure, 3, "outside lower center")
    return figure


def _section(planes: Halfspaces) -> Array:
    """Section of a polytope around the origin, its corners in order about it, shape (n, 2)."""
    equations = np.column_stack([planes.normal[:, :2], -planes.offset])
    found = HalfspaceIntersection(equations, np.zeros(2)).intersections
    _, first = np.unique(found.round(3), axis=0, return_index=True)
    found = found[np.sort(first)]
    return found[np.argsort(np.arctan2(found[:, 1], found[:, 0]))]


def _keep_in(axes: Axes, planes: Halfspaces) -> None:
    """Draw the polytope inside: all facets must hold."""
    label = f"inside, {len(planes.offset)} facets: all have to hold"
    look: Look = {"facecolor": "0.88", "edgecolor": "k", "lw": 1.4}
    axes.add_patch(Polygon(_section(planes), label=label, **look))


def _keep_out(axes: Axes, planes: Halfspaces, point: Array, covariance: Array) -> None:
    """Draw the polytope outside and the half-plane beyond its most probable facet, which must hold."""
    spread = np.einsum("mi,ij,mj->m", planes.normal, covariance, planes.normal)
    chosen = int(np.argmax((planes.normal @ point - planes.offset) / np.sqrt(spread)))
    normal, offset = planes.normal[chosen, :2], planes.offset[chosen]
    foot = normal * offset / (normal @ normal)
    along = FAR * np.array([-foot[1], foot[0]])
    line = np.stack([foot - along, foot + along])
    look: Look = {"facecolor": "0.88", "edgecolor": "none"}
    beyond = np.vstack([line, line[::-1] + FAR * foot])
    axes.add_patch(Polygon(beyond, label="allowed by the facet chosen", **look))
    axes.plot(*line.T, "k-", lw=1.8, label="facet chosen: it has to hold")
    ring = _section(planes)
    label = f"outside, {len(planes.offset)} facets: one has to hold"
    axes.plot(*np.vstack([ring, ring[:1]]).T, color="C2", lw=1.4, label=label)


def _spread(axes: Axes, point: Array, covariance: Array) -> None:
    """The spacecraft with one and two standard deviations."""
    factor = np.linalg.cholesky(covariance[:2, :2])
    for sigmas, dashes in ((1.0, "-"), (2.0, ":")):
        ellipse = point[:2, None] + sigmas * factor @ np.stack([np.cos(TURN), np.sin(TURN)])
        axes.plot(*ellipse, color="C1", ls=dashes, lw=1.2, label=f"{sigmas:g} sigma")
    axes.plot(*point[:2], "o", color="C1", ms=4, label="spacecraft")
