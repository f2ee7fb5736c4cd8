"""How normal the final state is: `python -m paper_figs.paper.terminal_normality`."""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import sys

import numpy as np
from matplotlib import style
from matplotlib.figure import Figure
from scipy.stats import norm

from paper_figs.drawing import LEGEND_PT, STYLE, WIDTH_IN, command
from paper_figs.inputs import Runs
from scp_recon.monte_carlo.summary import COMPONENTS

REACH = 4.0
"""Standard deviations shown; the outermost of the quantiles lies at 2.3 of a normal variable's."""


def draw(runs: Runs) -> Figure:
    """A quantile-quantile panel per component of the final state, J2000."""
    normality = runs.plan.summary.terminal.normality
    with style.context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 4.8), layout="constrained")
        panels = figure.subplots(2, 3, sharex=True, sharey=True)
        for axes, name in zip(panels.flat, COMPONENTS, strict=True):
            test = normality[name]
            expected = norm.ppf(test.levels)
            axes.axline((0.0, 0.0), slope=1.0, color="0.5", lw=1.0, ls="--", label="normal")
            axes.plot(expected, test.quantiles, "o", ms=2.5, color="k", label="sampled flights")
            axes.set_title(f"{name}: p-value {test.p_value:.1g}", loc="left")
            axes.set(xlim=(-REACH, REACH), ylim=(-REACH, REACH), aspect="equal")
        for axes in panels[-1]:
            axes.set_xlabel("normal quantile (sigma)")
        for axes in panels[:, 0]:
            axes.set_ylabel("sampled quantile (sigma)")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=2, fontsize=LEGEND_PT)
    return figure


def caption(runs: Runs) -> str:
    """What the figure shows."""
    normality = runs.plan.summary.terminal.normality
    kept = next(iter(normality.values())).samples
    worst = max(
        float(np.abs(np.array(test.quantiles) - norm.ppf(test.levels)).max())
        for test in normality.values()
    )
    return (
        f"Quantiles of the plan's final state in J2000, standardised, against those of a normal "
        f"variable: every per cent from 1 to 99, of {kept} flights with initial-state and execution "
        "errors together (the paper shows the two apart). Dashed: where a normal variable's lie. The "
        "p-values are those of D'Agostino and Pearson's test, which at this sample size rejects small "
        f"departures too; the largest here is {worst:.2f} sigma."
    )


if __name__ == "__main__":
    sys.exit(command(draw, __doc__))
