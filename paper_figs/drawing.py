"""Set the style of all figures, draw bands and legends, and save figures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from formulations.arrays import Array
from scp_recon.files import unwritable, write_atomically
from scp_recon.results import pictures
from scp_recon.results.pictures import WIDTH_IN

STYLE = Path(__file__).with_name("style.mplstyle")

LEGEND_PT = 8.0
"""Size of the words in legends."""

ABOVE: dict[str, Any] = {
    "loc": "lower left",
    "bbox_to_anchor": (0.0, 1.0),
    "borderaxespad": 0.1,
    "fontsize": LEGEND_PT,
}
"""Where a legend hides nothing."""

BANDS = ((2.28, 97.72, "0.85", "2 sigma"), (15.87, 84.13, "0.65", "1 sigma"))
"""Percentiles between which a normal variable lies with 95.4 % and 68.3 % probability."""

BURN = "C3"

HALO = [withStroke(linewidth=2.5, foreground="w")]
"""Around text that lies over lines."""


@contextmanager
def page(height_in: float, width_in: float = WIDTH_IN) -> Iterator[Figure]:
    """Yield an empty figure in the common style; draw within the context."""
    with style.context(STYLE):
        yield Figure(figsize=(width_in, height_in), layout="constrained")


def legend(figure: Figure, ncols: int, where: str = "outside upper center") -> None:
    """Add one legend for all panels, each label once, beside the panels."""
    pictures.legend(figure, ncols, where, fontsize=LEGEND_PT)


def shade_bands(axes: Axes, times: Array, sampled: Array, prefix: str = "") -> None:
    """Fill between percentiles of samples, shape (times, samples), at each time."""
    for low, high, shade, name in BANDS:
        edges = np.percentile(sampled, (low, high), axis=1)
        axes.fill_between(times, *edges, color=shade, lw=0, label=f"{prefix}{name}")


def draw_burns(axes: Axes, starts: Array, arrows: Array, shortest: float) -> None:
    """Draw an arrow for each burn that is not too short for one; shape (m, 2) in data coordinates."""
    look = {"arrowstyle": "-|>", "color": BURN, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
    for start, arrow in zip(starts, arrows, strict=True):
        if np.hypot(*arrow) >= shortest:
            axes.annotate("", start + arrow, start, zorder=7, arrowprops=look)


def label_outer(panels: Any, across: str, up: str) -> None:
    """Label a grid of panels that share their axes: below the last row and left of the first column."""
    for axes in panels[-1]:
        axes.set_xlabel(across)
    for axes in panels[:, 0]:
        axes.set_ylabel(up)


def save(
    figure: Figure, path: Path, dpi: float | None = None, plan_hash: str | None = None
) -> Path:
    """Write a figure in the format of the path's ending, the same bytes every time, whole or not.

    PNG, PDF and SVG keep the plan's hash in their metadata; `dpi` is the style's by default.

    Raises:
        InputError: if the ending is no picture format, or the file cannot be written.
    """
    pictures.check_ending("" if path.is_dir() else path.suffix, f"file {path}", "no picture's name")
    with style.context(STYLE):
        return write(path, pictures.picture(figure, path.suffix, plan_hash=plan_hash, dpi=dpi))


def write(path: Path, content: str | bytes) -> Path:
    """Write a file whole or not at all.

    Raises:
        InputError: if it cannot be written.
    """
    try:
        return write_atomically(path, content)
    except OSError as error:
        raise unwritable(path.parent, f"file {path}", error) from None
