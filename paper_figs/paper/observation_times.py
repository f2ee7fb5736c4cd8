"""Draw the distribution of the times for which emission and site distance keep their limits."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from formulations.arrays import Array
from paper_figs.drawing import legend, page
from paper_figs.inputs import Flown, Runs
from scp_recon.monte_carlo.summary import Summary

BINS = 34
"""Of the window's length: a hundred seconds each."""

CONSTRAINTS = (("emission", "emission limits held"), ("site_distance", "site distance limits held"))


def draw(runs: Runs) -> Figure:
    """A panel per constraint, the plan's flights filled and the reference's in outline."""
    first, last = runs.plan.mission.schedule.window_s
    edges = np.linspace(0.0, last - first, BINS + 1)
    with page(4.6) as figure:
        panels = figure.subplots(2, 1, sharex=True, sharey=True)
        for axes, (name, title) in zip(panels, CONSTRAINTS, strict=True):
            _panel(axes, runs, name, edges)
            axes.set_title(title, loc="left")
            axes.set(ylabel="share of flights (%)", yscale="log", xlim=(edges[0], edges[-1]))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.set_axisbelow(True)
        panels[-1].set_xlabel("time held in the observation window (s)")
        legend(figure, 2)
    return figure


def _panel(axes: Axes, runs: Runs, name: str, edges: Array) -> None:
    least = 100.0 / max(runs.plan.summary.samples, runs.reference.summary.samples)
    looks: tuple[tuple[Flown, dict[str, Any]], ...] = (
        (runs.plan, {"fill": True, "facecolor": "0.75", "edgecolor": "k", "lw": 0.6}),
        (runs.reference, {"fill": False, "edgecolor": "k", "ls": "--", "lw": 1.2}),
    )
    words = []
    for flown, look in looks:
        shares = 100.0 * rebinned(flown.summary, name, edges) / flown.summary.samples
        axes.stairs(shares, edges, label=flown.label, baseline=0.5 * least, **look)
        whole = flown.summary.held_s[name].throughout.estimate.value
        words.append(f"{flown.label}: {100 * whole:.1f} % throughout the window")
    axes.set_ylim(0.5 * least, 200.0)
    box = {"facecolor": "w", "edgecolor": "none", "alpha": 0.9, "pad": 1.0}
    axes.text(
        0.5, 0.96, "\n".join(words), transform=axes.transAxes, ha="center", va="top", bbox=box
    )


def rebinned(summary: Summary, name: str, edges: Array) -> Array:
    """Flights by time held, in coarser bins than the summary's, shape (len(edges) - 1,)."""
    histogram = summary.held_s[name].histogram
    middles = np.array(histogram.start) + 0.5 * histogram.bin
    inside = np.clip(middles, edges[0], edges[-1])
    return np.histogram(inside, edges, weights=histogram.count)[0]


def caption(runs: Runs) -> str:
    """Describe the figure."""
    first, last = runs.plan.mission.schedule.window_s
    return (
        "Distribution of the time in which the emission limits (above) and the site distance limits "
        f"(below) are held, of {runs.plan.summary.samples} flights of the plan (filled) and "
        f"{runs.reference.summary.samples} of the {runs.reference.label} (dashed outline); bins of "
        f"{(last - first) / BINS:.0f} s, logarithmic scale. The last bin ends at the window's "
        f"{last - first:.0f} s and contains the flights that hold the limits throughout."
    )
