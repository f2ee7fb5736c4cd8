"""Set the style of all figures; draw bands, burns, axes and labels; save figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from scipy.special import ndtri

from formulations.arrays import Array
from scp_recon.files import check_ending, unwritable, write_atomically
from scp_recon.results.pictures import endings, picture

Look = dict[str, Any]
"""Keywords of a style."""

ABOVE: Look = {
    "loc": "lower left",
    "bbox_to_anchor": (0.0, 1.0),
    "borderaxespad": 0.1,
}
"""Where a legend hides nothing."""

BANDS = ((2.28, 97.72, "0.85", "2 sigma"), (15.87, 84.13, "0.65", "1 sigma"))
"""Percentiles between which a normal variable lies with 95.4 % and 68.3 % probability."""

BURN = "C1"

AWAY_PT = (9.0, 16.0, 26.0, 38.0, 52.0, 70.0)
"""Distances from a point at which words are tried, the nearest first."""
WAYS = 16
"""Directions at each distance."""
ON_WORDS, OFF_PAGE, ON_POINT = 1000.0, 300.0, 8.0
"""Costs of overlapping other words, of leaving the axes and of covering a point; a distance costs its
length."""
ROOM_PX = 2.0


def history(
    axes: Axes, times: Array, sampled: Array, plan: Array, limits: Sequence[float], when: Any
) -> None:
    """Draw a quantity over time: 1 and 2 sigma of samples, the plan, limits.

    Args:
        axes: where.
        times: s, shape (n,).
        sampled: samples, shape (n, samples).
        plan: without errors, shape (n,).
        limits: of the quantity.
        when: first and last time at which the limits hold.
    """
    for low, high, shade, name in BANDS:
        edges = np.percentile(sampled, (low, high), axis=1)
        axes.fill_between(times, *edges, color=shade, lw=0, label=name)
    axes.plot(times, plan, color="k", lw=1.3, label="plan")
    for bound in limits:
        axes.hlines(bound, *when, color=BURN, ls="--", lw=1.1, label="limit")
    axes.set(xlim=(times[0], times[-1]))
    axes.margins(y=0.12)
    axes.set_axisbelow(True)


def draw_burns(axes: Axes, starts: Array, arrows: Array) -> Quiver:
    """Draw an arrow for each burn, its head no longer than itself; shape (m, 2) in data coordinates."""
    axes.plot(*starts.T, "o", color=BURN, ms=3, zorder=7)
    look: Look = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.005, "zorder": 7}
    return axes.quiver(*starts.T, *arrows.T, color=BURN, minlength=0.0, **look)


def probability_axis(axes: Axes, ticks: Sequence[float], label: str, **look: Any) -> None:
    """Label an axis of normal quantiles by their probabilities."""
    axes.set_xticks(ndtri(ticks), [f"{p:g}" for p in ticks], **look)
    axes.set_xlabel(label)


def place_labels(
    axes: Axes, points: Array, words: Sequence[str], avoid: Array, **look: Any
) -> None:
    """Write words beside points so that they overlap neither each other nor the drawing.

    Each is placed in turn where it costs least, and gets a line to its point where that is far. The
    layout must be final except for small changes.

    Args:
        axes: axes with everything else drawn.
        points: in data coordinates, shape (n, 2).
        words: one for each point.
        avoid: points that should stay visible, in data coordinates, shape (m, 2).
        look: style of the words.
    """
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.draw_without_rendering()
    taken = [text.get_window_extent() for text in axes.texts if text.get_text()]
    keep, scale = axes.transData.transform(avoid), figure.dpi / 72.0
    line = {"arrowstyle": "-", "color": look.get("color", "k"), "lw": 0.6, "shrinkB": 3}
    for point, text in zip(points, words, strict=True):
        at = tuple(point)
        note = axes.annotate(text, at, (0, 0), textcoords="offset points", arrowprops=line, **look)
        size = Text.get_window_extent(note)  # without the line
        tried = []
        for offset, (across, left), (up, low) in _places():
            x, y = axes.transData.transform(at) + scale * offset
            corner = x - left * size.width, y - low * size.height
            box = Bbox.from_bounds(*corner, size.width, size.height).padded(ROOM_PX)
            cost = _cost(box, axes.bbox, taken, keep) + float(np.hypot(*offset))
            tried.append((cost, box, offset, across, up))
        _, box, offset, across, up = min(tried, key=lambda one: one[0])
        note.set(ha=across, va=up)
        note.xyann = tuple(offset)
        if note.arrow_patch is not None:
            note.arrow_patch.set_visible(bool(np.hypot(*offset) > AWAY_PT[1]))
        taken.append(box)


def _places() -> Iterator[tuple[Array, tuple[str, float], tuple[str, float]]]:
    """Offsets from the point, pt, and the words' alignment there with its share of their size."""
    for away in AWAY_PT:
        for way in np.arange(WAYS) * 2.0 * np.pi / WAYS:
            x, y = np.cos(way), np.sin(way)
            across = ("left", 0.0) if x > 0.3 else ("right", 1.0) if x < -0.3 else ("center", 0.5)
            up = ("bottom", 0.0) if y > 0.3 else ("top", 1.0) if y < -0.3 else ("center", 0.5)
            yield away * np.array([x, y]), across, up


def _cost(box: Bbox, within: Bbox, taken: Sequence[Bbox], keep: Array) -> float:
    inside = (keep > box.min).all(axis=1) & (keep < box.max).all(axis=1)
    off = not all(within.contains(*corner) for corner in (box.min, box.max))
    on_words = sum(bool(box.overlaps(other)) for other in taken)
    return ON_WORDS * on_words + OFF_PAGE * off + ON_POINT * int(inside.sum())


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
