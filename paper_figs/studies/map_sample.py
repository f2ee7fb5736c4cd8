"""Draw the sampled sites that have a plan, open loop or with feedback, and its delta-v."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from formulations.arrays import Array
from paper_figs.drawing import legend, page
from paper_figs.inputs import Row, Source, numbers

SOURCE = Source(
    "map_sample", "python -m experiments maps --sample", {"sample.csv": "site.latitude_deg"}
)
TRUE = "true"
OPEN, MORE, NONE = "planned open loop", "planned with feedback alone", "no plan"


def of_ends(rows: list[Row], *, feedback: bool) -> dict[str, list[Row]]:
    """Rows by what was found: open loop, or with feedback where that finds nothing."""
    found = dict[str, list[Row]]({OPEN: [], MORE: [], NONE: []})
    for row in rows:
        gained = feedback and row["corrected"] == TRUE
        found[OPEN if row["open"] == TRUE else MORE if gained else NONE].append(row)
    return found


def draw(rows: list[Row]) -> Figure:
    """Two maps by longitude and latitude, in the colour of the delta-v's 99 %."""
    costs = numbers([row for row in rows if row["corrected"] == TRUE], "dv99_m_s")
    span = (float(costs.min()), float(costs.max())) if len(costs) else (0.0, 1.0)
    with page(3.2) as figure:
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        for axes, feedback in zip(panels, (False, True), strict=True):
            found = of_ends(rows, feedback=feedback)
            for end, mark in ((OPEN, "o"), (MORE, "D")):
                points = sites(axes, found[end], mark, end, span)
            axes.plot(*where(found[NONE]), "x", color="0.45", ms=4, label=NONE)
            many = len(rows) - len(found[NONE])
            said = "with feedback" if feedback else "open loop"
            axes.set_title(f"{said}: {many} of {len(rows)} sites", fontsize="medium")
            axes.set(xlim=(0, 360), ylim=(-90, 90), xlabel="east longitude (deg)")
            axes.set_xticks(range(0, 361, 90))
            axes.set_yticks(range(-90, 91, 30))
        panels[0].set_ylabel("latitude (deg)")
        figure.colorbar(points, ax=panels, label="99 % quantile of delta-v (m/s)", pad=0.01)
        legend(figure, 3)
    return figure


def where(rows: list[Row]) -> tuple[Array, Array]:
    """East longitudes from 0 to 360 and latitudes, deg."""
    return numbers(rows, "site.longitude_deg") % 360.0, numbers(rows, "site.latitude_deg")


def sites(
    axes: Axes, rows: list[Row], mark: str, end: str, span: tuple[float, float]
) -> PathCollection:
    """Marks of sites in the colour of their cost."""
    cost = numbers(rows, "dv99_m_s")
    return axes.scatter(
        *where(rows),
        c=cost,
        vmin=span[0],
        vmax=span[1],
        cmap="viridis",
        marker=mark,
        s=30,
        edgecolors="0.2",
        linewidths=0.4,
        zorder=3,
        label=end,
    )


def caption(rows: list[Row]) -> str:
    """Describe the figure and its finding."""
    alone, with_feedback = (
        len(rows) - len(of_ends(rows, feedback=feedback)[NONE]) for feedback in (False, True)
    )
    return (
        "Sites of a seeded sample of the map of Bennu that have a plan in which whole flights keep "
        f"every limit with 0.90 by the normal law: {alone} of {len(rows)} open loop, {with_feedback} "
        "with burns corrected by a measurement of 10 m and 0.5 mm/s. Colour: 99 % of the commanded "
        "delta-v of flights; sites with a plan open loop show its cost in both maps."
    )
