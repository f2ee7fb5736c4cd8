"""Whether the schedule's durations hold: `python -m paper_figs.studies.timing_rules RUNS FILE`.

Drawn from what `python -m experiments.timing_rules` wrote into the folder RUNS.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import sys
from dataclasses import dataclass
from pathlib import Path

from matplotlib import style
from matplotlib.figure import Figure

from paper_figs.drawing import LEGEND_PT, STYLE, WIDTH_IN, command_from
from paper_figs.inputs import read_csv

FOLDER = "timing_rules"
TABLE, SLEWS = "timing_rules.csv", "timing_rules_slews.csv"
COMMAND = "python -m experiments.timing_rules"
STEADY = "settled_0.25_deg_s"
"""Column of the slews' table whose largest entry the first rule is about."""

Row = dict[str, str]


@dataclass(frozen=True)
class Timing:
    """The study's rules and slews, a dictionary per row."""

    rules: list[Row]
    slews: list[Row]


def read(folder: Path) -> Timing:
    """Read the study's folder.

    Raises:
        InputError: if a file is missing or unusable.
    """
    return Timing(
        read_csv(folder, TABLE, "measured_s", COMMAND), read_csv(folder, SLEWS, STEADY, COMMAND)
    )


def draw(found: Timing) -> Figure:
    """Measured durations against those of the schedule."""
    with style.context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 2.4), layout="constrained")
        axes = figure.subplots()
        rows = range(len(found.rules))
        measured, allowed = (
            [float(rule[column]) / 60.0 for rule in found.rules]
            for column in ("measured_s", "allowed_s")
        )
        slews = [float(slew[STEADY]) / 60.0 for slew in found.slews]
        axes.barh(rows, allowed, height=0.6, color="0.88", label="schedule")
        axes.plot(slews, [0.0] * len(slews), "|", ms=9, color="k", label="each half turn")
        for holds, colour in (("true", "k"), ("false", "tab:red")):
            chosen = [k for k in rows if found.rules[k]["holds"] == holds]
            label = "measured, holds" if holds == "true" else "measured, too long"
            axes.plot([measured[k] for k in chosen], chosen, "o", color=colour, label=label)
        axes.set_yticks(rows, [f"{rule['name']}:\n{rule['how']}" for rule in found.rules])
        axes.set(xlabel="duration (min)", xlim=(0.0, None))
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        figure.legend(loc="outside upper center", ncols=4, fontsize=LEGEND_PT)
    return figure


def caption(found: Timing) -> str:
    """What the figure shows."""
    listed = [
        f"{rule['name']} ({rule['how']}) {float(rule['measured_s']) / 60.0:.1f} of "
        f"{float(rule['allowed_s']) / 60.0:.0f} min, "
        + ("holds" if rule["holds"] == "true" else "does not hold")
        for rule in found.rules
    ]
    return (
        "Durations of the schedule (bars) and as simulated with all errors (dots; strokes: each half "
        f"turn to steady state, an error that stays below 0.25 deg): {'; '.join(listed)}."
    )


if __name__ == "__main__":
    sys.exit(command_from(read, draw, __doc__))
