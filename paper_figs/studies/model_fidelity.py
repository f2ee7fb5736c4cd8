"""How good a model the planner needs: `python -m paper_figs.studies.model_fidelity RUNS FILE`.

Drawn from what `python -m experiments.model_fidelity` wrote into the folder RUNS.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper_figs.drawing import LEGEND_PT, STYLE, WIDTH_IN, command_from
from paper_figs.inputs import read_csv

FOLDER = "model_fidelity"
TABLE, HISTORY = "model_fidelity.csv", "model_fidelity_history.csv"
COMMAND = "python -m experiments.model_fidelity"
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

Row = dict[str, str]


@dataclass(frozen=True)
class Fidelity:
    """The study's table, and the distances over time, a dictionary per row."""

    table: list[Row]
    history: list[Row]

    @property
    def flights(self) -> list[str]:
        """What was flown."""
        return list(dict.fromkeys(row["flight"] for row in self.table))

    @property
    def single(self) -> list[Row]:
        """Models of one effect."""
        return [row for row in self.table if row["effect"] != TOGETHER]

    @property
    def limit_m(self) -> float:
        """Within which a model is good enough."""
        return float(self.table[0]["limit_m"])


def read(folder: Path) -> Fidelity:
    """Read the study's folder.

    Raises:
        InputError: if a file is missing or unusable.
    """
    return Fidelity(
        read_csv(folder, TABLE, "terminal_m", COMMAND),
        read_csv(folder, HISTORY, "distance_m", COMMAND),
    )


def draw(found: Fidelity) -> Figure:
    """Every model's distance at the end, left, and that of some over the flight, right."""
    with style.context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 4.4), layout="constrained")
        left, right = figure.subplots(1, 2)
        _at_the_end(left, found)
        _over_time(right, found)
    return figure


def _at_the_end(axes: Axes, found: Fidelity) -> None:
    labels: list[str] = []
    names: list[tuple[str, str]] = []
    for effect in dict.fromkeys(row["effect"] for row in found.single):
        models = dict.fromkeys(row["model"] for row in found.single if row["effect"] == effect)
        names += [(effect, model) for model in models]
        labels += list(models)
    at = {name: k for k, name in enumerate(names)}
    for flight, marker in zip(found.flights, ("o", "s"), strict=False):
        rows = [row for row in found.single if row["flight"] == flight]
        values = [float(row["terminal_m"]) for row in rows]
        places = [at[row["effect"], row["model"]] for row in rows]
        fills = ["k" if row["lowest_that_passes"] == "true" else "none" for row in rows]
        axes.scatter(values, places, marker=marker, c=fills, ec="k", s=28, lw=0.9, zorder=3)
        axes.plot([], [], marker, mfc="none", mec="k", ms=5, label=flight)
    axes.axvspan(found.limit_m, 1e6, facecolor="0.9", edgecolor="none")
    edges = [k for k, (one, two) in enumerate(pairwise(names)) if one[0] != two[0]]
    for edge in edges:
        axes.axhline(edge + 0.5, color="0.6", lw=0.8)
    words = [WORDS.get(label, label) for label in labels]
    axes.set_yticks(range(len(names)), words)
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="distance at the end (m)", xlim=(1e-5, 3e2))
    axes.set_title("filled: lowest fidelity that passes", loc="left")
    axes.legend(
        loc="upper left", fontsize=LEGEND_PT, frameon=True, edgecolor="none", framealpha=1.0
    )


def _over_time(axes: Axes, found: Fidelity) -> None:
    flight = found.flights[0]
    for model, colour, dashes in SHOWN:
        rows = [r for r in found.history if (r["flight"], r["model"]) == (flight, model)]
        hours = [float(row["t_s"]) / 3600.0 for row in rows]
        distance = [float(row["distance_m"]) for row in rows]
        label = WORDS.get(model, model)
        axes.plot(hours, distance, color=colour, ls=dashes, lw=1.2, label=label)
    axes.axhline(found.limit_m, color="tab:red", lw=1.0, ls="--", label=f"{found.limit_m:g} m")
    axes.set(xlabel="time (h)", ylabel="distance from the truth (m)", xlim=(0.0, None))
    axes.set(yscale="log", ylim=(1e-2, 30.0))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_title(f"over time, {flight}", loc="left")
    axes.legend(loc="lower right", fontsize=LEGEND_PT)


def caption(found: Fidelity) -> str:
    """What the figure shows."""
    named = [
        f"{row['effect']} of the {row['flight']}: {row['model']} ({float(row['terminal_m']):.2g} m)"
        for row in found.table
        if row["lowest_that_passes"] == "true"
    ]
    together = [
        f"{row['model']} on the {row['flight']} {float(row['terminal_m']):.2g} m"
        for row in found.table
        if row["effect"] == "together"
    ]
    return (
        "Left: distance at the end of the flight between a truth (degree-8 field, light on the "
        "vehicle's plates, finite burns) and the same with one effect modelled more crudely; filled is "
        f"the lowest fidelity that stays within {found.limit_m:g} m (shaded: beyond): "
        f"{'; '.join(named)}. Several at once: {'; '.join(together)}. Right: some of them over time."
    )


if __name__ == "__main__":
    sys.exit(command_from(read, draw, __doc__))
