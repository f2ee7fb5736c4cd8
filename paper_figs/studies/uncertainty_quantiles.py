"""How normal positions are, by source: `python -m paper_figs.studies.uncertainty_quantiles RUNS FILE`.

Drawn from what `python -m experiments.uncertainty_sources` wrote into the folder RUNS.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper_figs.drawing import LEGEND_PT, STYLE, WIDTH_IN, command_from
from paper_figs.inputs import read_csv
from paper_figs.studies.uncertainty_sources import COMMAND, FOLDER, TABLE, Row

QUANTILES = "uncertainty_quantiles.csv"
SHOWN = ("initial_state", "chemical_thruster")
AXES = ("x", "y", "z")
REACH = 5.5
"""Standard deviations shown."""

__all__ = ["COMMAND", "FOLDER", "caption", "draw", "read"]


@dataclass(frozen=True)
class Found:
    """Quantiles, and the table with the tests; a dictionary per row."""

    quantiles: list[Row]
    table: list[Row]

    def tested(self, source: str) -> Row:
        """The source's row of the table; its path-only one, the first."""
        return next(row for row in self.table if row["source"] == source)


def read(folder: Path) -> Found:
    """Read the study's folder.

    Raises:
        InputError: if a file is missing or unusable.
    """
    return Found(
        read_csv(folder, QUANTILES, "observed", COMMAND), read_csv(folder, TABLE, "rms_m", COMMAND)
    )


def draw(found: Found) -> Figure:
    """A quantile-quantile panel per source and axis, J2000, with the line through the quartiles."""
    with style.context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 4.8), layout="constrained")
        panels = figure.subplots(len(SHOWN), len(AXES), sharex=True, sharey=True)
        for line, source in zip(panels, SHOWN, strict=True):
            for axes, axis in zip(line, AXES, strict=True):
                _panel(axes, found, source, axis)
        for axes in panels[-1]:
            axes.set_xlabel("normal quantile (sigma)")
        for axes in panels[:, 0]:
            axes.set_ylabel("sampled quantile (sigma)")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=LEGEND_PT)
    return figure


def _panel(axes: Axes, found: Found, source: str, axis: str) -> None:
    points = np.array(
        [
            [float(row["expected"]), float(row["observed"])]
            for row in found.quantiles
            if (row["source"], row["axis"]) == (source, axis)
        ]
    )
    test = found.tested(source)
    axes.plot(*points.T, "o", ms=2.0, color="k", label="sampled flights")
    quartiles = np.array([-0.6745, 0.6745])
    ends = np.interp(quartiles, *points.T)
    slope = float(np.diff(ends)[0] / np.diff(quartiles)[0])
    axes.axline((0.0, float(ends.mean())), slope=slope, color="tab:red", lw=1.0, ls="--",
                label="through the quartiles")  # fmt: skip
    axes.plot(quartiles, ends, color="tab:blue", lw=2.0, label="between them")
    axes.set_title(f"{test['label']}, {axis}", loc="left")
    p_value = f"p = {float(test[f'p_value_{axis}']):.1g}"
    axes.text(0.96, 0.06, p_value, ha="right", transform=axes.transAxes)
    ticks = np.arange(-4, 5, 2)
    axes.set(xticks=ticks, yticks=ticks)
    axes.set(xlim=(-REACH, REACH), ylim=(-REACH, REACH), aspect="equal")


def caption(found: Found) -> str:
    """What the figure shows."""
    words = []
    for source in SHOWN:
        test = found.tested(source)
        straight = min(float(test[f"correlation_{axis}"]) for axis in AXES)
        words.append(f"{test['label']} (1 sigma {test['sigma']}): {straight:.4f}")
    flights = found.tested(SHOWN[0])["flights"]
    return (
        f"Quantiles of the final position in J2000, standardised, of {flights} flights with one "
        "source of uncertainty each, against those of a normal variable. Dashed: the line through the "
        "first and third quartiles, solid between them. p-values are those of Shapiro and Wilk's test "
        "of at most 5000 flights, which rejects small departures too. Smallest "
        f"correlation of the quantiles, 1 on a straight line: {'; '.join(words)}."
    )


if __name__ == "__main__":
    sys.exit(command_from(read, draw, __doc__))
