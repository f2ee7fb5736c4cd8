"""Draw a campaign's results: curves along its axes, or its sites on a map and on the shape."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize, to_rgba
from matplotlib.dates import DateFormatter
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from scipy.spatial import KDTree

from formulations.arrays import Array
from scp_recon.bodies.surface import direction_of
from scp_recon.campaigns.axes import EPOCH, LATITUDE, LONGITUDE
from scp_recon.campaigns.outcome import (
    COLOURS,
    COST,
    DELTA_V,
    FEASIBLE,
    GREYS,
    MARKS,
    MEASURES,
    CampaignResults,
    axes_of,
    cheapest,
    in_words,
    label,
)
from scp_recon.reports.surfaces import Shape, shape_of
from scp_recon.results.pictures import legend, sheet

DPI = 120
LINES_MAX, PANELS_MAX = 12, 4
"""Values of a second and a third axis of which each has its curve and its panels."""
TICKS_MAX, ACROSS = 8, 6
"""Ticks of a logarithmic axis, and curves that a line of the legend names."""
VIEWS = {
    "from 0 E": (0.0, 0.0),
    "from 90 E": (0.0, 90.0),
    "from north": (90.0, 0.0),
    "from 180 E": (0.0, 180.0),
    "from 270 E": (0.0, 270.0),
    "from south": (-90.0, 0.0),
}
"""Latitude and longitude of the eye, far away."""
DARKEST = 0.55
"""Share of a colour that is left where a facet is seen edge on."""


def figures(results: CampaignResults) -> dict[str, Figure]:
    """Draw all pictures that a campaign's axes allow, by name; none if no axis has numbers."""
    found = {}
    if results.is_map:
        found = {"map": draw_map(results), "globe": draw_globe(results)}
    elif results.varies:
        found = {"curves": draw_curves(results)}
    return found


def draw_map(results: CampaignResults) -> Figure:
    """Map delta-v and probability by longitude and latitude, with marks where there is no plan.

    Of several cases at a site the cheapest is shown.
    """
    results = results.by_site
    figure, good = sheet(6.6, dpi=DPI), results.ending(FEASIBLE)
    rows = figure.subplots(2, 1, sharex=True, sharey=True)
    for axes, (column, name) in zip(rows, MEASURES, strict=True):
        points = axes.scatter(
            _east(good[LONGITUDE]),
            good[LATITUDE],
            c=good[column],
            cmap=COLOURS,
            s=44,
            edgecolors="0.2",
            linewidths=0.4,
            zorder=3,
        )
        figure.colorbar(points, ax=axes, label=name, pad=0.01)
        for end, mark in MARKS.items():
            there = results.ending(end)
            if len(there):
                axes.scatter(
                    _east(there[LONGITUDE]),
                    there[LATITUDE],
                    marker=mark,
                    s=22,
                    color=GREYS[end],
                    label=f"{end}: {len(there)}",
                )
        axes.set(xlim=(0, 360), ylim=(-90, 90), ylabel="latitude (deg)")
        axes.set_xticks(range(0, 361, 60))
        axes.set_yticks(range(-90, 91, 30))
        axes.grid(color="0.92")
        axes.set_axisbelow(True)
    rows[0].scatter([], [], s=44, color="0.55", label=f"{FEASIBLE}: {len(good)}")
    rows[1].set(xlabel="east longitude (deg)")
    legend(figure, len(rows[0].get_legend_handles_labels()[1]), frameon=False)
    return figure


def draw_curves(results: CampaignResults) -> Figure:
    """Draw delta-v and probability along the longest axis, curves by another, panels by a third.

    Only cases with a verified plan have points. Of cases that differ in a fourth entry, or in text,
    the cheapest is drawn.
    """
    along, by, panels = axes_of(results)
    table = results.ending(FEASIBLE)
    values = [None] if panels is None else _some(results, panels, PANELS_MAX)
    figure = sheet(5.6, dpi=DPI)
    grid = figure.subplots(2, len(values), sharex=True, sharey="row", squeeze=False)
    lines = [None] if by is None else _some(results, by, LINES_MAX)
    scattered = results.scatters(along)
    for place, value in enumerate(values):
        here = table if panels is None else table[table[panels] == value]
        for row, (column, name) in enumerate(MEASURES):
            axes = grid[row, place]
            for number, line in enumerate(lines):
                part = cheapest(here if by is None else here[here[by] == line], along)
                style = _style(number, len(lines), line) | ({"ls": "none"} if scattered else {})
                axes.plot(_numbers(part[along]), part[column], **style)
            _ticks(axes, results, along)
            axes.grid(color="0.92")
            if place == 0:
                axes.set(ylabel=name)
            if row == 1:
                axes.set(xlabel=label(along))
                axes.tick_params(axis="x", labelrotation=30 if along == EPOCH else 0)
        if panels is not None:
            grid[0, place].set_title(f"{label(panels)}: {in_words(value)}", fontsize=9)
    if panels is not None and (left_out := _left_out(results, panels, values)):
        figure.supxlabel(f"panels for{left_out}", fontsize=8)
    if by is not None:
        left_out = _left_out(results, by, lines)
        title = f"{label(by)},{left_out}" if left_out else label(by)
        across = len(lines) if len(lines) <= ACROSS else -(-len(lines) // 2)
        legend(figure, across, title=title, frameon=False)
    return figure


def _numbers(column: Any) -> Any:
    if column.dtype.kind in "if":
        return column
    return [datetime.fromisoformat(text) for text in column]


def _ticks(axes: Axes, results: CampaignResults, entry: str) -> None:
    """Make an axis logarithmic, with ticks at some values, where its values are at even ratios."""
    if entry == EPOCH:
        axes.xaxis.set_major_formatter(DateFormatter("%Y-%m"))  # type: ignore[no-untyped-call]  # Matplotlib's
        return
    values = np.sort(results.table[entry].unique())
    if len(values) < 3 or values[0] <= 0.0:
        return
    ratios = np.diff(np.log(values))
    if np.ptp(ratios) < 0.01 * ratios.mean():
        some = _spread(values.tolist(), TICKS_MAX)
        axes.set_xscale("log")
        axes.set_xticks(some, [f"{value:.2g}" for value in some])
        axes.xaxis.set_minor_locator(NullLocator())


def _some(results: CampaignResults, entry: str, most: int) -> list[Any]:
    """At most `most` values of an entry, from the least to the greatest."""
    return _spread(sorted(results.table[entry].unique()), most)


def _left_out(results: CampaignResults, entry: str, shown: Sequence[Any]) -> str:
    """Note of how many of an entry's values are shown; empty if all are."""
    count = results.table[entry].nunique()
    return f" {len(shown)} of {count} values" if len(shown) < count else ""


def _spread(values: Sequence[Any], most: int) -> list[Any]:
    if len(values) <= most:
        return list(values)
    return [values[round(i)] for i in np.linspace(0, len(values) - 1, most)]


def _style(number: int, count: int, value: Any) -> dict[str, Any]:
    if value is None:
        return {"marker": "o", "ms": 3, "lw": 0.8, "color": "#0072B2"}
    share = number / max(count - 1, 1)
    shade, mark = colormaps[COLOURS](share / 1.1), "osD^vP*X<>hp"[number % 12]
    size = 6.5 - 3.5 * share  # so that curves that lie on each other are seen
    return {"marker": mark, "ms": size, "lw": 1.0, "color": shade, "label": in_words(value)}


def _east(longitude: Any) -> Any:
    return np.asarray(longitude, dtype=float) % 360.0


def draw_globe(results: CampaignResults) -> Figure:
    """Draw the surface in the colours of its nearest sites' delta-v; grey without a verified plan."""
    results = results.by_site
    shape = shape_of(results.base)
    rows = results.table
    directions = np.array(
        [direction_of(*at) for at in zip(rows[LATITUDE], rows[LONGITUDE], strict=True)]
    )
    sites = shape.radius(directions)[:, None] * directions
    costs = rows[COST].to_numpy(dtype=float)
    ends = np.array(results.ends)
    known = costs[ends == FEASIBLE]
    limits = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    scale = ScalarMappable(Normalize(*limits), COLOURS)
    colours = scale.to_rgba(np.where(ends == FEASIBLE, costs, np.nan))
    for end, grey in GREYS.items():
        colours[ends == end] = to_rgba(grey)
    figure = sheet(5.0, dpi=120)
    grid = figure.subplots(2, 3)
    for axes, (name, eye) in zip(grid.flat, VIEWS.items(), strict=True):
        _view(axes, shape, sites, colours, eye)
        axes.set_title(name, fontsize=9)
    figure.colorbar(scale, ax=grid, label=DELTA_V, shrink=0.8)
    for end in dict.fromkeys(ends):
        if end in GREYS:
            grid.flat[0].scatter([], [], marker="s", color=GREYS[end], label=end)
    legend(figure, 3, "outside lower center", frameon=False)
    return figure


def _view(axes: Axes, shape: Shape, sites: Array, colours: Array, eye: tuple[float, float]) -> None:
    """Draw the facets that face the eye, from the farthest to the nearest."""
    towards = direction_of(*eye)
    up = np.array([0.0, 0.0, 1.0]) if abs(eye[0]) < 89.0 else direction_of(0.0, eye[1] + 180.0)
    up = up * (1.0 if eye[0] > -89.0 else -1.0)
    right = np.cross(up, towards)
    corners = shape.vertices_m[shape.facets]
    middles = corners.mean(axis=1)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = across @ towards / np.maximum(np.linalg.norm(across, axis=1), 1e-300)
    seen = np.flatnonzero(facing > 0.0)
    seen = seen[np.argsort(middles[seen] @ towards)]
    nearest = KDTree(sites).query(middles[seen])[1]
    shades = colours[nearest].copy()
    shades[:, :3] *= (DARKEST + (1.0 - DARKEST) * facing[seen])[:, None]
    flat = np.stack([corners[seen] @ right, corners[seen] @ up], axis=2)
    axes.add_collection(
        PolyCollection(list(flat), facecolors=shades, edgecolors=shades, lw=0.3, rasterized=True)
    )
    front = sites[sites @ towards > 0.0]
    axes.plot(front @ right, front @ up, "o", ms=1.5, color="k", mew=0)
    reach = 1.05 * shape.size_m
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)
