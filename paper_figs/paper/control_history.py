"""Draw the burns over time and their angle to the Sun line."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from formulations.arrays import Array
from paper_figs.drawing import page
from paper_figs.inputs import Runs
from paper_figs.labels import place_labels
from scp_recon.physics import geometry


def draw(runs: Runs) -> Figure:
    """Burn sizes with their limit above, angles to the Sun with the keep-out band below."""
    mission, fired = runs.plan.mission, [burn for _, burn in runs.plan.solution.executed]
    times = np.array([burn.t_s for burn in fired])
    burns = np.array([burn.dv_m_s for burn in fired])
    sizes = 1000.0 * np.linalg.norm(burns, axis=1)
    angles = np.rad2deg(geometry.angle(burns, mission.sun_direction(times)))
    cone = mission.scenario.battery.delta_v_cone_deg
    limit = 1000.0 * mission.scenario.burns.dv_max_m_s
    with page(4.2) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True)
        top.vlines(times, 0.0, sizes, color="k", lw=2)
        top.plot(times, sizes, "ko", ms=5)
        top.axhline(limit, color="k", ls="--", lw=1)
        top.annotate(
            f"limit {limit:g} mm/s", (times[-1], limit), (0, -4), ha="right", va="top",
            textcoords="offset points",
        )  # fmt: skip
        top.set(ylabel="burn size (mm/s)", ylim=(0.0, 1.12 * limit))
        for low, high in ((0.0, cone), (180.0 - cone, 180.0)):
            bottom.axhspan(low, high, facecolor="0.88", edgecolor="0.55", hatch="///", lw=0)
        bottom.plot(times, angles, "ko", ms=5)
        for angle, way in ((0.5 * cone, "the Sun"), (180.0 - 0.5 * cone, "the anti-Sun")):
            box = {"facecolor": "w", "edgecolor": "none", "pad": 1.5}
            middle = 0.5 * times[-1]
            text = f"keep-out: within {cone:g} deg of {way}"
            bottom.text(middle, angle, text, ha="center", va="center", bbox=box)
        bottom.set(ylabel="angle to the Sun (deg)", xlabel="time (s)", ylim=(0.0, 180.0))
        bottom.set_yticks(np.arange(0, 181, 30))
        _shade(top, runs, times)
        _shade(bottom, runs, times)
        window = np.mean(mission.schedule.window_s)
        top.text(
            float(window), 0.5 * limit, "observation\nwindow", ha="center", va="center", size=8
        )
        for axes, values in ((top, sizes), (bottom, angles)):
            marked = np.column_stack([times, values])
            place_labels(axes, marked, [f"{value:.1f}" for value in values], marked)
    return figure


def _shade(axes: Axes, runs: Runs, times: Array) -> None:
    """The observation window."""
    first, last = runs.plan.mission.schedule.window_s
    axes.axvspan(first, last, facecolor="0.92", edgecolor="none", zorder=0)
    axes.set_xlim(-0.02 * times[-1], 1.02 * times[-1])


def caption(runs: Runs) -> str:
    """Describe the figure."""
    scenario, solution = runs.plan.mission.scenario, runs.plan.solution
    first, last = runs.plan.mission.schedule.window_s
    return (
        f"Control history of the plan ({solution.problem}, {solution.init} start, "
        f"{solution.total_dv_m_s:.5f} m/s in {len(solution.executed)} burns). Above: size of each "
        f"impulse, and the limit of {1000 * scenario.burns.dv_max_m_s:g} mm/s. Below: angle between "
        f"each impulse and the direction from {scenario.body.name} to the Sun; hatched are the two "
        f"cones of {scenario.battery.delta_v_cone_deg:g} deg about the Sun line that the battery keeps "
        f"burns out of. Lightly shaded: the observation window, {first:.0f} to {last:.0f} s."
    )
