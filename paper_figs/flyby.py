"""Draw a flyby at a glance.

On the left the path seen from the Sun with sampled flights; on the right the observation geometry in
the window, with the spread of the samples about the plan.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Polygon
from scipy.spatial import ConvexHull

from formulations.arrays import Array
from paper_figs.drawing import BURN, draw_burns, page, shade_bands
from paper_figs.labels import place_labels
from paper_figs.paper.observed import SEED, observed
from scp_recon.mission.constraints import companion_distance_m
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.sampling import sample_positions
from scp_recon.physics import geometry
from scp_recon.physics.frames import sun_north_to_j2000
from scp_recon.results.pictures import plain
from scp_recon.results.read import read_solution
from scp_recon.results.solution import Solution, require_whole_flight

PATHS_SHOWN = 150
ARROW, SHORT = 0.2, 1e-3
"""Arrow of the largest burn over the extent of the path, and km below which there is no arrow."""


def read(folder: Path) -> Solution:
    """The solution in a folder, of a whole flight.

    Raises:
        InputError: if there is none, or it is a plan made in flight.
    """
    solution = read_solution(folder)
    require_whole_flight(solution.scenario, "solution")
    return solution


def draw(solution: Solution) -> Figure:
    """The figure of a solution; nothing is written."""
    mission = solution.mission
    with page(4.4, 10.0) as figure:
        grid = figure.add_gridspec(3, 2, width_ratios=(1.15, 1.0))
        path = figure.add_subplot(grid[:, 0])
        histories = [figure.add_subplot(grid[row, 1]) for row in range(3)]
        _draw_path(path, mission, solution)
        _draw_histories(histories, mission, solution)
        figure.suptitle(
            f"{plain(mission.scenario.site.name)} on {plain(mission.scenario.body.name)}: "
            f"{solution.problem}, "
            f"{solution.total_dv_m_s:.4f} m/s in {len(solution.executed)} burns",
            fontweight="bold",
        )
        _name_burns(path, mission, solution)
    return figure


def seen_from_sun(mission: Mission, vectors: Array) -> Array:
    """Sun-North Y and Z in km; the Sun is behind the viewer, so Y points right."""
    to_frame = sun_north_to_j2000(mission.sun_direction(0.0), mission.rotation.pole)
    return (vectors @ to_frame)[..., 1:] / 1000.0


def _arrows(mission: Mission, solution: Solution) -> tuple[Array, Array]:
    """Positions of the burns that are not zero and their arrows, km, shape (m, 2) each."""
    states, fired = np.array(solution.nodes.state)[:, :3], solution.burns_m_s.any(axis=1)
    burns = seen_from_sun(mission, solution.burns_m_s[fired])
    extent = float(np.ptp(states, axis=0).max()) / 1000.0
    arrows = ARROW * extent * burns / max(np.linalg.norm(burns, axis=1).max(), 1e-12)
    return seen_from_sun(mission, states[mission.burn_nodes[fired]]), arrows


def _name_burns(axes: Axes, mission: Mission, solution: Solution) -> None:
    """Write number and size beside each burn."""
    starts, arrows = _arrows(mission, solution)
    path = seen_from_sun(mission, np.array(solution.nodes.state)[:, :3])
    sizes = {number: 1000.0 * np.linalg.norm(burn.dv_m_s) for number, burn in solution.executed}
    words = [f"{number}: {size:.0f} mm/s" for number, size in sizes.items()]
    along = (starts + np.linspace(0.0, 1.0, 9)[:, None, None] * arrows).reshape(-1, 2)
    place_labels(axes, starts, words, np.vstack([path, along]), color=BURN)


def _draw_path(axes: Axes, mission: Mission, solution: Solution) -> None:
    seen, times = partial(seen_from_sun, mission), mission.times_s
    burns, policy = solution.burns_m_s, solution.corrections
    samples = seen(sample_positions(mission, burns, times, PATHS_SHOWN, SEED, policy))
    axes.plot(samples[..., 0], samples[..., 1], color="0.75", lw=0.4, alpha=0.5, zorder=1)
    axes.plot([], [], color="0.6", lw=1, label=f"{PATHS_SHOWN} sampled flights")
    mean = seen(np.array(solution.nodes.state)[:, :3])
    axes.plot(*mean.T, color="k", lw=1.2, label="plan", zorder=3)
    window = mission.window_nodes
    axes.plot(*mean[window].T, color="C0", lw=4, solid_capstyle="butt", label="window", zorder=3)
    track = geometry.track(mission.site, mission.rotation, times[window])
    axes.plot(*seen(track.position).T, color="C1", lw=3, label="site in the window", zorder=3)
    axes.add_patch(_body(mission))
    _draw_companion(axes, mission)
    draw_burns(axes, *_arrows(mission, solution), SHORT)
    axes.set(xlabel="Sun-North Y (km), seen from the Sun", ylabel="Sun-North Z (km)")
    axes.set_aspect("equal")
    axes.margins(0.12)
    axes.legend(ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _draw_companion(axes: Axes, mission: Mission) -> None:
    """Draw the companion's path, and the keep-out ball about it at the middle of the window."""
    companion = mission.scene.companion
    if companion is None:
        return
    way = seen_from_sun(mission, companion.position(mission.times_s))
    amid = seen_from_sun(mission, companion.position(np.mean(mission.schedule.window_s)))
    radius = companion_distance_m(mission.scenario) / 1e3
    axes.plot(*way.T, color="C2", lw=1, ls=":", label="companion, kept clear")
    axes.add_patch(Circle(tuple(amid), radius, facecolor="none", edgecolor="C2", zorder=2))


def _body(mission: Mission) -> Patch:
    """The body's outline in the middle of the window; a circle where its shape is not known."""
    look: dict[str, Any] = {"facecolor": "0.9", "edgecolor": "0.4", "zorder": 2}
    body = mission.scenario.body
    if body.solid is None and body.radii_m is None:
        return Circle((0.0, 0.0), float(np.linalg.norm(mission.site.position_body)) / 1e3, **look)
    axes = mission.rotation.body_to_j2000(np.mean(mission.schedule.window_s))
    corners = seen_from_sun(mission, mission.solid.vertices_m @ axes.T)
    return Polygon(corners[ConvexHull(corners).vertices], **look)


def _draw_histories(panels: Sequence[Axes], mission: Mission, solution: Solution) -> None:
    first, last = mission.schedule.window_s
    times = np.linspace(first, last, 61)
    quantities = observed(solution, times)
    for axes, quantity in zip(panels, quantities, strict=True):
        shade_bands(axes, times, quantity.sampled)
        axes.plot(times, quantity.plan, color="k", lw=1.2, label="plan")
        for bound in quantity.limits:
            axes.axhline(bound, color="C3", ls="--", lw=1)
        axes.set(ylabel=quantity.label, xlim=(first, last))
        axes.margins(y=0.12)
        axes.set_axisbelow(True)
        if axes is not panels[-1]:
            axes.tick_params(labelbottom=False)
    panels[-1].set_xlabel("time (s)")
    panels[0].plot([], [], color="C3", ls="--", lw=1, label="limit")
    panels[0].legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
