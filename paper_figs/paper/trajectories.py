"""Draw the flight projected on the three J2000 planes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator, MultipleLocator

from formulations.arrays import Array
from paper_figs.drawing import BURN, HALO, LEGEND_PT, draw_burns, page
from paper_figs.inputs import Flown, Runs
from paper_figs.labels import place_labels
from paper_figs.paper.observed import SEED, planned_positions
from scp_recon.monte_carlo.sampling import sample_positions

PATHS, TIMES = 60, 600
SIGMAS = ((2.0, "0.87", "2 sigma"), (1.0, "0.7", "1 sigma"))
ARROW, SHORT, MARGIN, TICKS = 0.12, 0.01, 0.06, 7
"""The largest burn's arrow over the longest side, what part of it is no arrow, what is left free around
all that is drawn, and ticks at most."""
AXES = ("x", "y", "z")
PLANES = ((1, 2), (0, 2), (1, 0))
"""Horizontal and vertical axis of each panel, placed so that neighbours share one."""


@dataclass(frozen=True)
class Paths:
    """Positions, J2000, km.

    Attributes:
        times_s: of the plan and the reference, shape (n,).
        plan, reference: without errors, shape (n, 3).
        sampled: of sampled flights, shape (flights, nodes, 3).
        window: of the plan at the window's edges, shape (2, 3).
    """

    times_s: Array
    plan: Array
    reference: Array
    sampled: Array
    window: Array


def paths(runs: Runs) -> Paths:
    """Fly the paths to draw."""
    mission, burns = runs.plan.mission, runs.plan.solution.burns_m_s
    times = np.linspace(0.0, mission.times_s[-1], TIMES)
    edges = np.array(mission.schedule.window_s)
    policy = runs.plan.solution.corrections
    sampled = sample_positions(mission, burns, mission.times_s, PATHS, SEED, policy)
    return Paths(
        times,
        planned_positions(mission, burns, times) / 1000.0,
        planned_positions(mission, runs.reference.solution.burns_m_s, times) / 1000.0,
        sampled.transpose(1, 0, 2) / 1000.0,
        planned_positions(mission, burns, edges) / 1000.0,
    )


def draw(runs: Runs) -> Figure:
    """Front, side and top view as in a technical drawing, the legend in the free corner."""
    flown = paths(runs)
    limits = limits_km(runs, flown)
    spans = [high - low for low, high in limits]
    locator = MaxNLocator(TICKS, steps=[1, 2, 5, 10])
    step = float(np.diff(locator.tick_values(0.0, max(spans)))[0])
    with page(5.95) as figure:
        panels = figure.subplots(
            2, 2, width_ratios=(spans[1], spans[0]), height_ratios=(spans[2], spans[0])
        )
        corner = panels[1, 1]
        shown = list(zip(panels.flat, PLANES, strict=False))
        for axes, plane in shown:
            _panel(axes, runs, flown, list(plane))
            across, up = plane
            axes.set(
                xlabel=f"J2000 {AXES[across]} (km)",
                ylabel=f"J2000 {AXES[up]} (km)",
                xlim=limits[across],
                ylim=limits[up],
                aspect="equal",
            )
            axes.xaxis.set_major_locator(MultipleLocator(step))
            axes.yaxis.set_major_locator(MultipleLocator(step))
            axes.set_axisbelow(True)
        for axes, plane in shown:
            _number(axes, runs.plan, list(plane), ARROW * max(spans))
        corner.axis("off")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        corner.legend(handles, labels, loc="center", borderaxespad=0.0, fontsize=LEGEND_PT)
    return figure


def limits_km(runs: Runs, flown: Paths) -> list[tuple[float, float]]:
    """Limits of each coordinate: paths, flights, the widest band, the keep-out sphere, and room."""
    safe = runs.plan.mission.scenario.safety.radius_min_m / 1000.0
    nodes = runs.plan.solution.nodes
    variance = np.diagonal(np.array(nodes.covariance), axis1=1, axis2=2)[:, :3]
    band = max(sigmas for sigmas, *_ in SIGMAS) * np.sqrt(variance) / 1000.0
    mean = np.array(nodes.state)[:, :3] / 1000.0
    drawn = np.vstack(
        [
            *(flown.plan, flown.reference, flown.sampled.reshape(-1, 3)),
            *(mean - band, mean + band, np.full(3, safe), np.full(3, -safe)),
        ]
    )
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    room = MARGIN * float((high - low).max())
    return list(zip((low - room).tolist(), (high + room).tolist(), strict=True))


def _panel(axes: Axes, runs: Runs, flown: Paths, pair: list[int]) -> None:
    _dispersions(axes, runs.plan, flown.times_s, flown.plan[:, pair], pair)
    lines = LineCollection(
        list(flown.sampled[..., pair]), colors="0.35", linewidths=0.3, alpha=0.6, zorder=2
    )
    axes.add_collection(lines)
    axes.plot([], [], color="0.35", lw=0.6, label=f"{PATHS} sampled flights")
    axes.plot(*flown.plan[:, pair].T, "k-", lw=1.4, label="plan", zorder=4)
    label = runs.reference.label.replace(" (", "\n(")
    axes.plot(*flown.reference[:, pair].T, "k:", lw=1.4, label=label, zorder=4)
    _bodies(axes, runs)
    low, high = np.array(limits_km(runs, flown)).T
    _burns(axes, runs.plan, pair, ARROW * float((high - low).max()))
    edges = flown.window[:, pair].T
    axes.plot(*edges, "s", mfc="w", mec="k", ms=5, zorder=6, label="window opens, closes")


def _dispersions(axes: Axes, flown: Flown, times: Array, path: Array, pair: list[int]) -> None:
    """Draw ellipses of the planned covariance along the path, dense enough for a band."""
    nodes, stored = flown.mission.times_s, np.array(flown.solution.nodes.covariance)
    covariance = np.empty((len(times), 2, 2))
    for i in range(2):
        for j in range(2):
            covariance[:, i, j] = np.interp(times, nodes, stored[:, pair[i], pair[j]])
    variance, direction = np.linalg.eigh(covariance)
    deviation = np.sqrt(np.maximum(variance, 0.0)) / 1000.0
    angles = np.rad2deg(np.arctan2(direction[:, 1, 1], direction[:, 0, 1]))
    for sigmas, shade, name in SIGMAS:
        ellipses = EllipseCollection(
            2.0 * sigmas * deviation[:, 1],
            2.0 * sigmas * deviation[:, 0],
            angles,
            units="xy",
            offsets=path,
            offset_transform=axes.transData,
            facecolors=shade,
            edgecolors="none",
            zorder=1,
        )
        axes.add_collection(ellipses)
        axes.fill([], [], color=shade, label=name)


def _bodies(axes: Axes, runs: Runs) -> None:
    """Draw the sphere through the site, and the keep-out sphere."""
    mission = runs.plan.mission
    radius = float(np.linalg.norm(mission.site.position_body)) / 1000.0
    safe = mission.scenario.safety.radius_min_m / 1000.0
    name = mission.scenario.body.name
    body = Circle(
        (0.0, 0.0), radius, facecolor="0.93", edgecolor="k", lw=0.8, hatch="....", zorder=0.6,
        label=f"{name}, sphere through the site",
    )  # fmt: skip
    ring = Circle(
        (0.0, 0.0), safe, fill=False, edgecolor="k", ls="--", lw=0.8, zorder=0.6,
        label=f"closest allowed, {safe:g} km",
    )  # fmt: skip
    axes.add_patch(body)
    axes.add_patch(ring)


def _burns(axes: Axes, flown: Flown, pair: list[int], arrow_km: float) -> None:
    """Numbered dots and arrows in proportion to the impulses."""
    starts, arrows = _arrows(flown, pair, arrow_km)
    draw_burns(axes, starts, arrows, SHORT * arrow_km)
    label = f"burns {', '.join(_numbers(flown))}, arrows to scale"
    axes.plot(*starts.T, "o", color=BURN, ms=4.5, zorder=7, label=label)


def _number(axes: Axes, flown: Flown, pair: list[int], arrow_km: float) -> None:
    """The burns' numbers at their arrows' tips."""
    starts, arrows = _arrows(flown, pair, arrow_km)
    numbers = _numbers(flown)
    look = {"color": BURN, "fontweight": "bold", "path_effects": HALO, "zorder": 7}
    place_labels(axes, starts + arrows, numbers, np.vstack([starts, starts + arrows]), **look)


def _numbers(flown: Flown) -> list[str]:
    """Of the burns that are not zero."""
    return [str(number) for number, _ in flown.solution.executed]


def _arrows(flown: Flown, pair: list[int], arrow_km: float) -> tuple[Array, Array]:
    """Positions of the burns that are not zero and their arrows, km, shape (m, 2) each."""
    burns = flown.solution.burns_m_s
    fired = burns.any(axis=1)
    arrows = arrow_km * burns[fired][:, pair] / max(np.linalg.norm(burns, axis=1).max(), 1e-12)
    nodes = flown.mission.burn_nodes[fired]
    return np.array(flown.solution.nodes.state)[nodes][:, pair] / 1000.0, arrows


def caption(runs: Runs) -> str:
    """Describe the figure."""
    solution, mission = runs.plan.solution, runs.plan.mission
    sizes = [1000.0 * float(np.linalg.norm(burn.dv_m_s)) for _, burn in solution.executed]
    listed = ", ".join(f"{size:.1f}" for size in sizes)
    return (
        "The plan (solid) and the "
        f"{runs.reference.label} (dotted) projected on the y-z, x-z and x-y planes of the "
        f"{mission.scenario.body.name}-centred J2000 frame. Shaded: union of the ellipses of one "
        "(dark) and two (light) standard deviations of the plan's position covariance at all times; "
        "by that covariance 68.3 % and 95.4 % of the flights lie within them across the path. Thin "
        f"lines: {PATHS} flights with sampled errors, nonlinear dynamics. Squares: the observation "
        f"window opens and closes. Arrows: the burns of {listed} mm/s, lengths in proportion. "
        "The dotted disc is the sphere through the site, "
        f"{np.linalg.norm(mission.site.position_body):.0f} m; the dashed circle the closest allowed "
        f"distance from the centre, {mission.scenario.safety.radius_min_m:g} m."
    )
