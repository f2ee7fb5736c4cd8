"""Pictures of a campaign: curves along its axes, or a map of its sites on a chart and on the shape."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.dates import DateFormatter
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from scp_recon.campaign.study.axes import EPOCH, LATITUDE, LONGITUDE
from scp_recon.campaign.view.globe import draw_globe
from scp_recon.campaign.view.labels import COLOURS, COST, GREYS, MARKS, MEASURES, label, told
from scp_recon.campaign.view.outcome import FEASIBLE, CampaignResults

WIDTH_IN, DPI = 7.0, 120
LINES_MAX, PANELS_MAX = 12, 4
"""Values of a second and a third axis of which each has its curve and its panels."""
TICKS_MAX, ACROSS = 8, 6
"""Ticks of a logarithmic axis, and curves that a line of the legend names."""


def figures(results: CampaignResults) -> dict[str, Figure]:
    """All pictures that a campaign's axes allow, by name; none where nothing differs in numbers."""
    found = {}
    if results.is_map:
        found = {"map": draw_map(results), "globe": draw_globe(results)}
    elif results.varies:
        found = {"curves": draw_curves(results)}
    return found


def draw_map(results: CampaignResults) -> Figure:
    """Delta-v and probability at each site by longitude and latitude; marks where there is no plan.

    Of several cases at a site it is the cheapest.
    """
    results = results.by_site
    table, ends = results.table, np.array(results.ends)
    figure = Figure(figsize=(WIDTH_IN, 6.6), layout="constrained", dpi=DPI)
    rows = figure.subplots(2, 1, sharex=True, sharey=True)
    good = table[ends == FEASIBLE]
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
            there = table[ends == end]
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
    handles, labels = rows[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    return figure


def draw_curves(results: CampaignResults) -> Figure:
    """Delta-v and probability along the axis with most values, curves by another, panels by a third.

    Only cases with a verified plan have points: a curve ends where there is none. Of cases that differ
    in a fourth entry, or in text, the cheapest is drawn.
    """
    along, by, panels = axes_of(results)
    table = results.table[np.array(results.ends) == FEASIBLE]
    values = [None] if panels is None else _some(results, panels, PANELS_MAX)
    figure = Figure(figsize=(WIDTH_IN, 5.6), layout="constrained", dpi=DPI)
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
            grid[0, place].set_title(f"{label(panels)}: {told(value)}", fontsize=9)
    if panels is not None and (left_out := _left_out(results, panels, values)):
        figure.supxlabel(f"panels for{left_out}", fontsize=8)
    if by is not None:
        left_out = _left_out(results, by, lines)
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(
            handles,
            labels,
            title=f"{label(by)},{left_out}" if left_out else label(by),
            loc="outside upper center",
            ncols=len(labels) if len(labels) <= ACROSS else -(-len(labels) // 2),
            frameon=False,
        )
    return figure


def axes_of(results: CampaignResults) -> tuple[str, str | None, str | None]:
    """The entries by which curves run, differ, and stand in panels: in order of how many values."""
    counts = {entry: results.table[entry].nunique() for entry in results.varies}
    ordered = sorted(counts, key=lambda entry: -counts[entry])
    first, second, third, *_ = *ordered, None, None
    assert first is not None
    return first, second, third


def cheapest(rows: Any, along: str) -> Any:
    """Of the rows at each value of an entry the cheapest, in its order."""
    return rows.sort_values(COST).drop_duplicates(along).sort_values(along)


def _numbers(column: Any) -> Any:
    if column.dtype.kind in "if":
        return column
    return [datetime.fromisoformat(text) for text in column]


def _ticks(axes: Axes, results: CampaignResults, entry: str) -> None:
    """A logarithmic axis where its values are at even ratios, with ticks at some of them."""
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
    """So many values of an entry at most, from the least to the greatest."""
    return _spread(sorted(results.table[entry].unique()), most)


def _left_out(results: CampaignResults, entry: str, shown: Sequence[Any]) -> str:
    """How many of an entry's values are shown, if not all are."""
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
    return {"marker": mark, "ms": size, "lw": 1.0, "color": shade, "label": told(value)}


def _east(longitude: Any) -> Any:
    return np.asarray(longitude, dtype=float) % 360.0
