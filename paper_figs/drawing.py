"""Draw what several figures share: bands, burns with their names, axes; save figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from scipy.special import ndtri

from formulations.arrays import Array
from scp_recon.files import check_ending, unwritable, write_atomically
from scp_recon.reports.histories import History
from scp_recon.reports.pictures import endings, picture

Look = dict[str, Any]
"""Keywords of a style."""

BURN = "C1"
BEYOND_PT = 5.0
"""Distance of words from the point that they name."""


def history(axes: Axes, shown: History, when: tuple[float, float]) -> None:
    """Draw a quantity over time: 1 and 2 sigma of samples, the plan, and limits while they hold."""
    for sigmas, shade in ((2, "0.85"), (1, "0.65")):
        edges = shown.bands[sigmas]
        axes.fill_between(shown.times_s, *edges, color=shade, lw=0, label=f"{sigmas} sigma")
    axes.plot(shown.times_s, shown.planned, color="k", lw=1.3, label="plan")
    for _, bound in shown.limits:
        axes.hlines(bound, *when, color=BURN, ls="--", lw=1.1, label="limit")
    axes.set(xlim=(shown.times_s[0], shown.times_s[-1]))
    axes.margins(y=0.12)


def draw_burns(axes: Axes, starts: Array, arrows: Array, words: Sequence[str]) -> Any:
    """Draw an arrow for each burn, its name beyond its head; shape (m, 2) in data coordinates."""
    axes.plot(*starts.T, "o", color=BURN, ms=3, zorder=7)
    look: Look = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.005, "zorder": 7}
    sides, heights = ("right", "center", "left"), ("top", "center", "bottom")
    for tip, way, text in zip(starts + arrows, arrows, words, strict=True):
        way = way / np.hypot(*way)
        across, up = (1 + np.rint(way)).astype(int)
        axes.annotate(
            text, tuple(tip), tuple(BEYOND_PT * way), textcoords="offset points", color=BURN,
            ha=sides[across], va=heights[up], fontsize=8, fontweight="bold", zorder=8,
            path_effects=[withStroke(linewidth=2.5, foreground="w")],
        )  # fmt: skip
    return axes.quiver(*starts.T, *arrows.T, color=BURN, minlength=0.0, **look)


def probability_axis(axes: Axes, ticks: Sequence[float], label: str, **look: Any) -> None:
    """Label an axis of normal quantiles by their probabilities."""
    axes.set_xticks(ndtri(ticks), [f"{p:g}" for p in ticks], **look)
    axes.set_xlabel(label)


def save(
    figure: Figure, path: Path, dpi: float | None = None, plan_hash: str | None = None
) -> Path:
    """Write a figure in the format of the path's ending, the same bytes every time, whole or not.

    PNG, PDF and SVG keep the plan's hash in their metadata; `dpi` is the style's by default.

    Raises:
        InputError: if the ending is no picture format, or the file cannot be written.
    """
    check_ending(path, "file", *endings())
    content = picture(figure, path.suffix, plan_hash=plan_hash, dpi=dpi)
    try:
        return write_atomically(path, content)
    except OSError as error:
        raise unwritable(path.parent, f"file {path}", error) from None
