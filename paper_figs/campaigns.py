"""Draw the campaigns of `experiments maps`: sites, errors, a year and sizes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pandas import DataFrame as Table
from pandas import to_datetime

from paper_figs.drawing import Look
from scp_recon.campaigns.axes import EPOCH, LATITUDE, LONGITUDE
from scp_recon.campaigns.outcome import (
    CHANCE,
    COST,
    FEASIBLE,
    NO_MISSION,
    CampaignResults,
    read_campaign,
)
from scp_recon.results.pictures import legend, page

CAMPAIGNS = {
    "studies_map": "reconnaissance_map",
    "gallery/ryugu_map": "ryugu_map",
    "studies_errors": "errors",
    "studies_year": "asteroid_year",
    "studies_sizes": "sizes",
}
"""Folder of each picture's campaign."""
MEASURES = ((COST, 1e3, "delta-v (mm/s)"), (CHANCE, 1.0, "lowest probability (-)"))
"""Columns, with their factors and names."""
BURN, INITIAL = "uncertainty.execution_error", "uncertainty.initial_sigma_fraction"
LARGEST, LEAST = "burns.dv_max_m_s", "safety.radius_min_m"
MARKS = ("o", "s", "^", "D")
INITIALS_SHOWN = 3
"""Largest initial errors with a curve of their own; below them delta-v hardly changes."""


def read_campaigns(folder: Path) -> dict[str, CampaignResults]:
    """The campaigns in a folder, those that have run, by the pictures' names.

    Raises:
        InputError: if results are unusable.
    """
    found = {name: folder / one for name, one in CAMPAIGNS.items()}
    return {name: read_campaign(place) for name, place in found.items() if place.is_dir()}


def campaigns(found: dict[str, CampaignResults]) -> dict[str, Figure]:
    """The pictures by name."""
    drawn = {"studies_errors": errors, "studies_year": year, "studies_sizes": sizes}
    return {name: drawn.get(name, sites)(results) for name, results in found.items()}


def sites(results: CampaignResults) -> Figure:
    """Delta-v and lowest probability of each site by longitude and latitude."""
    results = results.by_site
    good, table = results.ending(FEASIBLE), results.table
    none = results.ending(NO_MISSION)
    others = table.drop(index=good.index.union(none.index))
    with page(6.2) as figure:
        panels = figure.subplots(2, 1, sharex=True, sharey=True)
        for axes, (column, factor, words) in zip(panels, MEASURES, strict=True):
            look: Look = {"s": 36, "edgecolors": "0.2", "linewidths": 0.4, "cmap": "viridis"}
            label = f"plan verified: {len(good)}"
            points = axes.scatter(*_where(good), c=factor * good[column], label=label, **look)
            axes.plot(*_where(others), "x", color="0.3", ms=5, label=f"no plan: {len(others)}")
            axes.plot(
                *_where(none), "+", color="C1", ms=6, label=f"no lighting window: {len(none)}"
            )
            axes.set(xlim=(0, 360), ylim=(-90, 90), ylabel="latitude (deg)")
            axes.set_xticks(range(0, 361, 60))
            axes.set_yticks(range(-90, 91, 30))
            figure.colorbar(points, ax=axes, label=words, pad=0.01)
        panels[-1].set_xlabel("east longitude (deg)")
        legend(figure, 3)
    return figure


def _where(rows: Table) -> tuple[Any, Any]:
    return rows[LONGITUDE] % 360.0, rows[LATITUDE]


def errors(results: CampaignResults) -> Figure:
    """Curves over the execution error, of the smallest and the largest initial errors."""
    good, every = results.ending(FEASIBLE), sorted(results.table[BURN].unique())
    initial = sorted(results.table[INITIAL].unique())
    with page(4.6) as figure:
        panels = figure.subplots(2, 1, sharex=True)
        for mark, size in zip(MARKS, [initial[0], *initial[-INITIALS_SHOWN:]], strict=True):
            own = good[good[INITIAL] == size].sort_values(BURN)
            label = f"initial error {100.0 * size:.2g} %"
            _curves(panels, 100.0 * own[BURN], own, {"marker": mark, "label": label})
        panels[-1].set(xscale="log", xlabel="execution error, 1 sigma (% of the burn, logarithmic)")
        panels[-1].set_xticks([100.0 * x for x in every], [f"{100.0 * x:.2g}" for x in every])
        panels[-1].minorticks_off()
        _no_plan(panels, [100.0 * x for x in every if x not in set(good[BURN])])
        legend(figure, 4)
    return figure


def year(results: CampaignResults) -> Figure:
    """Curves over the epoch; delta-v from zero, as it hardly changes."""
    good = results.ending(FEASIBLE).sort_values(EPOCH)
    with page(4.0) as figure:
        panels = figure.subplots(2, 1, sharex=True)
        _curves(panels, to_datetime(good[EPOCH]), good, {"marker": "o", "ms": 4})
        panels[0].set_ylim(0.0, 1.1e3 * good[COST].max())
        panels[1].set_ylim(None, 1.005)
        panels[1].set_xlabel("epoch (TDB)")
    return figure


def sizes(results: CampaignResults) -> Figure:
    """Curves over the least radius, one for each largest burn, of the cheaper battery cone."""
    good = results.ending(FEASIBLE).sort_values(COST).drop_duplicates([LARGEST, LEAST])
    with page(4.4) as figure:
        panels = figure.subplots(2, 1, sharex=True)
        groups = good.sort_values(LEAST).groupby(LARGEST)
        for number, ((size, own), mark) in enumerate(zip(groups, MARKS, strict=False)):
            look: Look = {"ms": 9 - 3 * number, "ls": ("-", "--", ":")[number % 3]}
            label = f"largest burn {1e3 * size:g} mm/s"
            _curves(
                panels, own[LEAST], own, {"marker": mark, "mfc": "none", "label": label, **look}
            )
        panels[-1].set_xlabel("least distance allowed from the centre (m)")
        none = {*results.table[LEAST]} - {*good[LEAST]}
        panels[-1].set_xticks(sorted(results.table[LEAST].unique()))
        _no_plan(panels, sorted(none))
        legend(figure, 3)
    return figure


def _curves(panels: Any, x: Any, rows: Table, look: Look) -> None:
    """A curve of each measure."""
    for axes, (column, factor, words) in zip(panels, MEASURES, strict=True):
        axes.plot(x, factor * rows[column], **look)
        axes.set_ylabel(words)


def _no_plan(panels: list[Axes], places: list[float]) -> None:
    """Say where no curve has a verified plan."""
    for axes in panels:
        for x in places:
            axes.axvline(x, color="0.6", lw=1.0, ls=":")
            at: Look = {"xycoords": ("data", "axes fraction"), "rotation": 90, "fontsize": 8}
            axes.annotate("no verified plan", (x, 0.5), color="0.3", ha="right", va="center", **at)
            axes.margins(x=0.05)
