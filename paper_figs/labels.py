"""Place words beside points so that they overlap neither each other nor the drawing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.text import Annotation, Text
from matplotlib.transforms import Bbox

from formulations.arrays import Array

AWAY_PT = (9.0, 16.0, 26.0, 38.0, 52.0, 70.0)
"""Distances from a point at which words are tried, the nearest first."""
WAYS = 16
"""Directions at each distance."""
ON_WORDS, OFF_PAGE, ON_POINT = 1000.0, 300.0, 8.0
"""Costs of overlapping other words, of leaving the axes and of covering a point; a distance costs its
length."""
ROOM_PX = 2.0


def place_labels(
    axes: Axes, points: Array, words: Sequence[str], avoid: Array, **style: Any
) -> list[Annotation]:
    """Write words beside points; words far from their point get a line to it.

    Each is placed in turn where it costs least; the layout must be final except for small changes.

    Args:
        axes: axes with everything else drawn.
        points: in data coordinates, shape (n, 2).
        words: one for each point.
        avoid: points that should stay visible, in data coordinates, shape (m, 2).
        style: style of the words.
    """
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.draw_without_rendering()
    taken = [_words(text) for text in axes.texts if text.get_text()]
    keep = axes.transData.transform(avoid) if len(avoid) else np.zeros((0, 2))
    found = []
    for point, text in zip(points, words, strict=True):
        line = {"arrowstyle": "-", "color": style.get("color", "k"), "lw": 0.6, "shrinkB": 3}
        note = axes.annotate(
            text, tuple(point), (0, 0), textcoords="offset points", arrowprops=line, **style
        )
        size = _words(note)
        at = axes.transData.transform(point)
        scale = figure.dpi / 72.0
        costs = []
        for offset, across, up in _places():
            box = _box(at + scale * np.array(offset), (size.width, size.height), across, up)
            cost = _cost(box, axes.bbox, taken, keep) + float(np.hypot(*offset))
            costs.append((cost, offset, across, up, box))
        _, offset, across, up, box = min(costs, key=lambda each: each[0])
        note.set(ha=across, va=up)
        note.xyann = offset
        if note.arrow_patch is not None and np.hypot(*offset) <= AWAY_PT[1]:
            note.arrow_patch.set_visible(False)
        taken.append(box)
        found.append(note)
    return found


def _words(text: Text) -> Bbox:
    """Extent of words, without an annotation's arrow."""
    box = text.get_window_extent()
    return super(Annotation, text).get_window_extent() if isinstance(text, Annotation) else box


def _box(at: Array, size: tuple[float, float], across: str, up: str) -> Bbox:
    """Box of words anchored at a point, with room around them, in pixels."""
    (width, height), x, y = size, float(at[0]), float(at[1])
    left = {"left": x, "center": x - 0.5 * width, "right": x - width}[across]
    low = {"bottom": y, "center": y - 0.5 * height, "top": y - height}[up]
    return Bbox.from_bounds(left, low, width, height).padded(ROOM_PX)


def _places() -> list[tuple[tuple[float, float], str, str]]:
    """Offsets from the point, and the words' alignment there."""
    places = []
    for away in AWAY_PT:
        for way in np.arange(WAYS) * 2.0 * np.pi / WAYS:
            x, y = float(np.cos(way)), float(np.sin(way))
            across = "left" if x > 0.3 else "right" if x < -0.3 else "center"
            up = "bottom" if y > 0.3 else "top" if y < -0.3 else "center"
            places.append(((away * x, away * y), across, up))
    return places


def _cost(box: Bbox, page: Bbox, taken: Sequence[Bbox], keep: Array) -> float:
    on_words = sum(bool(box.overlaps(other)) for other in taken)
    inside = (keep > [box.x0, box.y0]).all(axis=1) & (keep < [box.x1, box.y1]).all(axis=1)
    corners = [(box.x0, box.y0), (box.x1, box.y1)]
    off = not all(page.contains(*corner) for corner in corners)
    return ON_WORDS * on_words + OFF_PAGE * off + ON_POINT * int(inside.sum())
