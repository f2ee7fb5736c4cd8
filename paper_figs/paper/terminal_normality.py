"""Draw quantiles of the final state against those of a normal variable."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import norm

from paper_figs.drawing import label_outer, legend, page
from paper_figs.inputs import Runs
from scp_recon.monte_carlo.summary import COMPONENTS

REACH = 4.0
"""Standard deviations shown; the outermost of the quantiles lies at 2.3 of a normal variable's."""


def draw(runs: Runs) -> Figure:
    """A quantile-quantile panel per component of the final state, J2000."""
    normality = runs.plan.summary.terminal.normality
    with page(4.8) as figure:
        panels = figure.subplots(2, 3, sharex=True, sharey=True)
        for axes, name in zip(panels.flat, COMPONENTS, strict=True):
            test = normality[name]
            expected = norm.ppf(test.levels)
            axes.axline((0.0, 0.0), slope=1.0, color="0.5", lw=1.0, ls="--", label="normal")
            axes.plot(expected, test.quantiles, "o", ms=2.5, color="k", label="sampled flights")
            axes.set_title(f"{name}: p-value {test.p_value:.1g}", loc="left")
            axes.set(xlim=(-REACH, REACH), ylim=(-REACH, REACH), aspect="equal")
        label_outer(panels, "normal quantile (sigma)", "sampled quantile (sigma)")
        legend(figure, 2)
    return figure


def caption(runs: Runs) -> str:
    """Describe the figure."""
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
