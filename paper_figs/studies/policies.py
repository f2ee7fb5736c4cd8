"""Draw three policies over the required probability and over the measurement's error."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import ndtri

from formulations.arrays import Array
from paper_figs.drawing import legend, page
from paper_figs.inputs import Row, Source, numbers

SOURCE = Source("policies", "python -m experiments policies", {"policies.csv": "dv99_m_s"})
MARKS = {
    "open": ("s-", "tab:red", "as planned"),
    "feedback": ("o-", "tab:blue", "corrected by gains"),
    "replan": ("D-", "tab:green", "planned again"),
}
FIGURES = {
    "whole_flight": (100.0, "whole flights that hold (%)"),
    "dv99_m_s": (1e3, "delta-v, 99 % (mm/s)"),
    "final_sigma_m": (1.0, "final dispersion (m)"),
}
"""Factor and name of each column."""
POSITION_M = 10.0
"""Error of the measurement that others are multiples of."""


def draw(rows: list[Row]) -> Figure:
    """Probability, delta-v and dispersion: above over the probability, below over the error."""
    flown = [row for row in rows if row["dv99_m_s"]]
    usual = [row for row in flown if float(row["scale"]) == 1.0]
    at = next(row["asked"] for row in flown if float(row["scale"]) != 1.0)
    over_error = [row for row in flown if row["asked"] == at]
    ticks = sorted({float(row["asked"]) for row in usual})
    with page(4.6) as figure:
        panels = figure.subplots(2, 3)
        for (above, below), (name, (factor, words)) in zip(panels.T, FIGURES.items(), strict=True):
            for policy in MARKS:
                own = [row for row in usual if row["policy"] == policy]
                bars(above, ndtri(numbers(own, "asked")), own, name, factor)
                own = [row for row in over_error if row["policy"] == policy]
                if policy == "open":
                    below.axhline(factor * float(own[0][name]), color=MARKS[policy][1], lw=1.0)
                else:
                    bars(below, POSITION_M * numbers(own, "scale"), own, name, factor)
            above.set_xticks(ndtri(ticks), [f"{p:g}" for p in ticks], fontsize=6)
            above.set(xlabel="required probability (-)", ylabel=words)
            below.set(xlabel=f"measured to (m), for {at}", ylabel=words, xscale="log")
        legend(figure, 3)
    return figure


def bars(axes: Axes, x: Array, rows: list[Row], name: str, factor: float) -> None:
    """Draw a policy's figure with its intervals, in the order of x."""
    mark, colour, label = MARKS[rows[0]["policy"]]
    order = np.argsort(x)
    ends = (factor * numbers(rows, name + end)[order] for end in ("_low", "", "_high"))
    low, y, high = ends
    style: dict[str, Any] = {"color": colour, "ms": 3, "lw": 1.0, "capsize": 2, "label": label}
    axes.errorbar(x[order], y, (y - low, high - y), fmt=mark, **style)


def caption(rows: list[Row]) -> str:
    """Describe the figure and its finding."""
    most = max(float(row["final_sigma_m"]) for row in rows if row["policy"] == "replan")
    return (
        "Whole flights that keep every limit, 99 % of the commanded delta-v, and the root of the "
        "summed variances of the final position, by flights, with 95 % intervals: above against the "
        "probability that was required of the plan, below against the error of the measured position, "
        "with that of the velocity alike. Burns that are planned again meet the final state within "
        f"{most:.0f} m, 1 sigma, whatever that costs."
    )
