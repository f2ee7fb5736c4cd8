"""The flyby at a glance: `python -m paper_figs.flyby runs/latest docs/flyby.png`.

Left the path seen from the Sun with sampled flights, right what the instruments see in the
observation window, with the spread of the samples about the plan.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint, run_command, show_written

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from rich.console import Console

from paper_figs.drawing import BANDS, STYLE, plain, save
from paper_figs.paper.observed import SEED, observed
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.sampling import sample_positions
from scp_recon.physics import geometry
from scp_recon.physics.frames import sun_north_to_j2000
from scp_recon.solution.file import Solution, read_solution
from scp_recon.solution.parent import require_whole_flight

Array = npt.NDArray[np.float64]

PATHS_SHOWN = 150


def draw(solution: Solution) -> Figure:
    """The figure of a solution; nothing is written."""
    mission = Mission.from_scenario(solution.scenario)
    with style.context(STYLE):
        figure = Figure(figsize=(10, 4.4), layout="constrained")
        grid = figure.add_gridspec(3, 2, width_ratios=(1.15, 1.0))
        path = figure.add_subplot(grid[:, 0])
        histories = [figure.add_subplot(grid[row, 1]) for row in range(3)]
        _draw_path(path, mission, solution)
        _draw_histories(histories, mission, solution)
        figure.suptitle(
            f"{plain(mission.scenario.site.name)} on {plain(mission.scenario.body.name)}: "
            f"{solution.problem}, "
            f"{solution.total_dv_m_s:.4f} m/s in {len(solution.burns)} burns",
            fontweight="bold",
        )
    return figure


def _draw_path(axes: Axes, mission: Mission, solution: Solution) -> None:
    to_frame = sun_north_to_j2000(mission.sun_direction(0.0), mission.rotation.pole)

    def seen(position: Array) -> Array:
        """Sun-North Y and Z in km; the Sun is behind the viewer, so Y points right."""
        return (position @ to_frame)[..., 1:] / 1000.0

    times = mission.times_s
    samples = seen(sample_positions(mission, solution.burns_m_s, times, PATHS_SHOWN, SEED))
    axes.plot(samples[..., 0], samples[..., 1], color="0.75", lw=0.4, alpha=0.5, zorder=1)
    axes.plot([], [], color="0.6", lw=1, label=f"{PATHS_SHOWN} sampled flights")
    mean = seen(np.array(solution.nodes.state)[:, :3])
    axes.plot(*mean.T, color="k", lw=1.2, label="plan", zorder=3)
    window = mission.window_nodes
    axes.plot(*mean[window].T, color="C0", lw=4, solid_capstyle="butt", label="window", zorder=3)
    track = geometry.track(mission.site, mission.rotation, times[window])
    axes.plot(*seen(track.position).T, color="C1", lw=3, label="site in the window", zorder=3)
    radius = float(np.linalg.norm(mission.site.position_body)) / 1000.0
    axes.add_patch(Circle((0.0, 0.0), radius, facecolor="0.9", edgecolor="0.4", zorder=2))
    burns = seen(solution.burns_m_s) * 1000.0
    largest = np.linalg.norm(burns, axis=1).max()
    for number, (node, burn) in enumerate(zip(mission.burn_nodes, burns, strict=True), start=1):
        start = mean[node]
        axes.annotate(
            "",
            start + 0.4 * burn / largest,
            start,
            arrowprops={"arrowstyle": "-|>", "color": "C3", "lw": 1.5},
            zorder=4,
        )
        # Beside upright arrows on the side away from the body, below those that lie.
        side = np.sign(start[0])
        lies = abs(burn[0]) > 2.0 * abs(burn[1])
        axes.annotate(
            f"{number}: {np.linalg.norm(solution.burns_m_s[number - 1]) * 1000.0:.0f} mm/s",
            start,
            (0.0, -16.0) if lies else (14.0 * side, 4.0),
            textcoords="offset points",
            color="C3",
            ha="center" if lies else "left" if side > 0.0 else "right",
        )
    axes.set(xlabel="Sun-North Y (km), seen from the Sun", ylabel="Sun-North Z (km)")
    axes.set_aspect("equal")
    axes.margins(0.12)
    axes.legend(ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _draw_histories(panels: Sequence[Axes], mission: Mission, solution: Solution) -> None:
    first, last = mission.schedule.window_s
    times = np.linspace(first, last, 61)
    quantities = observed(mission, solution.burns_m_s, times)
    for axes, quantity in zip(panels, quantities, strict=True):
        for low, high, shade, name in BANDS:
            edges = np.percentile(quantity.sampled, (low, high), axis=1)
            axes.fill_between(times, *edges, color=shade, lw=0, label=name)
        axes.plot(times, quantity.plan, color="k", lw=1.2, label="plan")
        for bound in quantity.limits:
            if bound is not None:
                axes.axhline(bound, color="C3", ls="--", lw=1)
        axes.set(ylabel=quantity.label, xlim=(first, last))
        axes.margins(y=0.12)
        if axes is not panels[-1]:
            axes.tick_params(labelbottom=False)
    panels[-1].set_xlabel("time (s)")
    panels[0].plot([], [], color="C3", ls="--", lw=1, label="limit")
    panels[0].legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw a solution's picture to a file whose ending chooses the format."""
    p = argparse.ArgumentParser(prog="python -m paper_figs.flyby", description=__doc__)
    p.add_argument("solution", type=Path, metavar="DIR", help="folder with a solution.json")
    p.add_argument("picture", type=Path, metavar="FILE", help="e.g. flyby.png or flyby.svg")
    options = p.parse_args(arguments)

    def work(console: Console) -> int:
        solution = read_solution(options.solution)
        require_whole_flight(solution.scenario, "solution")
        path = save(draw(solution), options.picture, dpi=140, plan_hash=solution.plan_hash)
        show_written(console, path)
        return 0

    return run_command(work)


if __name__ == "__main__":
    sys.exit(main())
