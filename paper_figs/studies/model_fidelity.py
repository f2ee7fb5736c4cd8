"""Draw the errors of cruder models of the dynamics."""

from __future__ import annotations

from itertools import pairwise

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper_figs.drawing import LEGEND_PT, page
from paper_figs.inputs import Row, Source, Tables, numbers
from scp_recon.results.pictures import HOUR_S

SOURCE = Source(
    "model_fidelity",
    "python -m experiments model_fidelity",
    {"model_fidelity.csv": "terminal_m", "model_fidelity_history.csv": "distance_m"},
)
TOGETHER = "together"

SHOWN = (
    ("none", "k", ":"),
    ("cannonball", "k", "-"),
    ("degree 0", "tab:blue", ":"),
    ("J2", "tab:blue", "-"),
    ("impulsive", "tab:orange", "-"),
)
"""Models whose distance is drawn over time, with their looks."""

WORDS = {"none": "no light pressure", "degree 0": "point mass"}
"""For models whose names say too little."""


def draw(found: Tables) -> Figure:
    """Every model's distance at the end, left, and that of some over the flight, right."""
    table, history = found
    with page(4.4) as figure:
        left, right = figure.subplots(1, 2)
        _at_the_end(left, table)
        _over_time(right, history, float(table[0]["limit_m"]))
    return figure


def _at_the_end(axes: Axes, table: list[Row]) -> None:
    single = [row for row in table if row["effect"] != TOGETHER]
    effects = list(dict.fromkeys(row["effect"] for row in single))
    pairs = dict.fromkeys((row["effect"], row["model"]) for row in single)
    names = sorted(pairs, key=lambda name: effects.index(name[0]))
    at = {name: k for k, name in enumerate(names)}
    flights = dict.fromkeys(row["flight"] for row in single)
    for flight, marker in zip(flights, ("o", "s"), strict=False):
        rows = [row for row in single if row["flight"] == flight]
        values = numbers(rows, "terminal_m")
        places = [at[row["effect"], row["model"]] for row in rows]
        fills = ["k" if row["lowest_that_passes"] == "true" else "none" for row in rows]
        axes.scatter(values, places, marker=marker, c=fills, ec="k", s=28, lw=0.9, zorder=3)
        axes.plot([], [], marker, mfc="none", mec="k", ms=5, label=flight)
    axes.axvspan(float(table[0]["limit_m"]), 1e6, facecolor="0.9", edgecolor="none")
    edges = [k for k, (one, two) in enumerate(pairwise(names)) if one[0] != two[0]]
    for edge in edges:
        axes.axhline(edge + 0.5, color="0.6", lw=0.8)
    words = [WORDS.get(model, model) for _, model in names]
    axes.set_yticks(range(len(names)), words)
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="distance at the end (m)", xlim=(1e-5, 3e2))
    axes.set_title("filled: lowest fidelity that passes", loc="left")
    axes.legend(
        loc="upper left", fontsize=LEGEND_PT, frameon=True, edgecolor="none", framealpha=1.0
    )


def _over_time(axes: Axes, history: list[Row], limit_m: float) -> None:
    flight = history[0]["flight"]
    for model, colour, dashes in SHOWN:
        rows = [r for r in history if (r["flight"], r["model"]) == (flight, model)]
        hours, label = numbers(rows, "t_s") / HOUR_S, WORDS.get(model, model)
        distance = numbers(rows, "distance_m")
        axes.plot(hours, distance, color=colour, ls=dashes, lw=1.2, label=label)
    axes.axhline(limit_m, color="tab:red", lw=1.0, ls="--", label=f"{limit_m:g} m")
    axes.set(xlabel="time (h)", ylabel="distance from the truth (m)", xlim=(0.0, None))
    axes.set(yscale="log", ylim=(1e-2, 30.0))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_title(f"over time, {flight}", loc="left")
    axes.legend(loc="lower right", fontsize=LEGEND_PT)


def caption(found: Tables) -> str:
    """Describe the figure."""
    table = found[0]
    named = [
        f"{row['effect']} of the {row['flight']}: {row['model']} ({float(row['terminal_m']):.2g} m)"
        for row in table
        if row["lowest_that_passes"] == "true"
    ]
    together = [
        f"{row['model']} on the {row['flight']} {float(row['terminal_m']):.2g} m"
        for row in table
        if row["effect"] == TOGETHER
    ]
    return (
        "Left: distance at the end of the flight between a truth (degree-8 field, light on the "
        "vehicle's plates, finite burns) and the same with one effect modelled more crudely; filled is "
        f"the lowest fidelity that stays within {float(table[0]['limit_m']):g} m (shaded: beyond): "
        f"{'; '.join(named)}. Several at once: {'; '.join(together)}. Right: some of them over time."
    )
