"""Draw emission, phase and site distance over time."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from paper_figs.drawing import legend, page, shade_bands
from paper_figs.inputs import Runs
from paper_figs.paper.observed import SAMPLES, observed

BEFORE_AND_AFTER_S = 1500.0
"""Shown on either side of the window."""


def draw(runs: Runs) -> Figure:
    """Three histories with their spread, limits in the window, and the reference flight."""
    mission = runs.plan.mission
    first, last = mission.schedule.window_s
    times = np.linspace(first - BEFORE_AND_AFTER_S, last + BEFORE_AND_AFTER_S, 107)
    distance, emission, phase = observed(runs.plan.solution, times)
    others = observed(runs.reference.solution, times, samples=1)
    with page(5.6) as figure:
        panels = figure.subplots(3, 1, sharex=True)
        order = ((emission, others[1]), (phase, others[2]), (distance, others[0]))
        for axes, (quantity, other) in zip(panels, order, strict=True):
            shade_bands(axes, times, quantity.sampled, "worst ")
            axes.plot(times, quantity.plan, "k-", lw=1.4, label="plan")
            axes.plot(times, other.plan, "k:", lw=1.4, label=runs.reference.label)
            for bound in quantity.limits:
                axes.hlines(bound, first, last, color="k", ls="--", lw=1.2, label="limit")
            for edge in (first, last):
                axes.axvline(edge, color="0.4", lw=0.8)
            axes.set(ylabel=quantity.label, xlim=(times[0], times[-1]))
            axes.margins(y=0.1)
            axes.set_axisbelow(True)
        panels[0].annotate(
            f"observation window, {last - first:.0f} s", (0.5, 1.0), (0, 2), ha="center",
            xycoords="axes fraction", textcoords="offset points",
        )  # fmt: skip
        panels[-1].set_xlabel("time (s)")
        legend(figure, 5)
    return figure


def caption(runs: Runs) -> str:
    """Describe the figure."""
    first, last = runs.plan.mission.schedule.window_s
    return (
        "Emission, phase and site distance of the plan (solid) and of the "
        f"{runs.reference.label} (dotted, without errors). Bands: 68.3 % (worst 1 sigma, dark) and "
        f"95.4 % (worst 2 sigma, light) of {SAMPLES} flights sampled about the plan lie between "
        "their edges, which are the 15.87 % and 84.13 %, and the 2.28 % and 97.72 % quantiles at "
        "each time. Dashed: limits, which hold in the observation window only, "
        f"{first:.0f} to {last:.0f} s, between the vertical lines. Phase has no upper limit."
    )
