"""Draw how near to the optimum of P2 each method is after how many of the processor's seconds."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from paper_figs.drawing import legend, page
from paper_figs.inputs import Row, Source, numbers

SOURCE = Source("accuracy", "python -m experiments accuracy", {"accuracy.csv": "error"})
LEAST = 1e-9
"""Smallest error that is shown, below what two solvers agree on."""


def draw(rows: list[Row]) -> Figure:
    """A panel a problem; a mark is an iteration, a full one the end."""
    problems = list(dict.fromkeys(row["problem"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    with page(3.2) as figure:
        panels = figure.subplots(1, len(problems), sharey=True, squeeze=False)[0]
        for axes, problem in zip(panels, problems, strict=True):
            for number, method in enumerate(methods):
                own = [r for r in rows if (r["problem"], r["method"]) == (problem, method)]
                seconds = numbers(own, "processor_s")
                errors = np.maximum(numbers(own, "error"), LEAST)
                look = {"color": f"C{number}", "marker": "P" if "IPOPT" in method else "o"}
                axes.plot(seconds, errors, ms=3, mfc="none", lw=1.0, label=method, **look)
                axes.plot(seconds[-1:], errors[-1:], ms=5, **look)
            axes.set(xscale="log", yscale="log", title=problem)
            axes.xaxis.set_major_formatter("{x:g}")
        panels[0].set_ylabel("merit over the least, less one (-)")
        figure.supxlabel("seconds of the processor from the solution of P3", fontsize="medium")
        legend(figure, 3)
    return figure


def caption(rows: list[Row]) -> str:
    """Describe the figure."""
    del rows
    return (
        "Error of the flown burns against the processor's seconds, building of the program included, "
        "for P2 from one solution of P3: a mark is a run that stops after one iteration more, the last "
        f"one is full. Errors below {LEAST:g} are shown there."
    )
