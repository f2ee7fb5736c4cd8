"""Draw quantiles of the final position against a normal variable's, by source of error."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper_figs.drawing import label_outer, legend, page
from paper_figs.inputs import Row, Source, Tables, numbers

SOURCE = Source(
    "uncertainty_sources",
    "python -m experiments uncertainty_sources",
    {"uncertainty_quantiles.csv": "observed", "uncertainty_sources.csv": "rms_m"},
)
SHOWN = ("initial_state", "chemical_thruster")
AXES = ("x", "y", "z")
REACH = 5.5
"""Standard deviations shown."""


def _tested(found: Tables, source: str) -> Row:
    """The source's row of the table with the tests; its path-only one, the first."""
    return next(row for row in found[1] if row["source"] == source)


def draw(found: Tables) -> Figure:
    """A quantile-quantile panel per source and axis, J2000, with the line through the quartiles."""
    with page(4.8) as figure:
        panels = figure.subplots(len(SHOWN), len(AXES), sharex=True, sharey=True)
        for line, source in zip(panels, SHOWN, strict=True):
            for axes, axis in zip(line, AXES, strict=True):
                _panel(axes, found, source, axis)
        label_outer(panels, "normal quantile (sigma)", "sampled quantile (sigma)")
        legend(figure, 3)
    return figure


def _panel(axes: Axes, found: Tables, source: str, axis: str) -> None:
    own = [row for row in found[0] if (row["source"], row["axis"]) == (source, axis)]
    points = np.stack([numbers(own, name) for name in ("expected", "observed")], axis=1)
    test = _tested(found, source)
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


def caption(found: Tables) -> str:
    """Describe the figure."""
    words = []
    for source in SHOWN:
        test = _tested(found, source)
        straight = min(float(test[f"correlation_{axis}"]) for axis in AXES)
        words.append(f"{test['label']} (1 sigma {test['sigma']}): {straight:.4f}")
    flights = _tested(found, SHOWN[0])["flights"]
    return (
        f"Quantiles of the final position in J2000, standardised, of {flights} flights with one "
        "source of uncertainty each, against those of a normal variable. Dashed: the line through the "
        "first and third quartiles, solid between them. p-values are those of Shapiro and Wilk's test "
        "of at most 5000 flights, which rejects small departures too. Smallest "
        f"correlation of the quantiles, 1 on a straight line: {'; '.join(words)}."
    )
