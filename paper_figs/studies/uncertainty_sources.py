"""Draw the dispersion by source of uncertainty."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from paper_figs.drawing import legend, page
from paper_figs.inputs import Row, Source, numbers

SOURCE = Source(
    "uncertainty_sources",
    "python -m experiments uncertainty_sources",
    {"uncertainty_sources.csv": "rms_m"},
)


def draw(rows: list[Row]) -> Figure:
    """Dispersion at the end of the flight by source, with intervals, on a logarithmic scale."""
    spread = [row for row in rows if float(row["rms_m"]) > 0.0]
    with page(0.9 + 0.34 * len(spread)) as figure:
        axes = figure.subplots()
        engines = dict.fromkeys(row["flown_by"] for row in spread)
        for engine, marker in zip(engines, ("o", "s"), strict=False):
            places = [k for k, row in enumerate(spread) if row["flown_by"] == engine]
            values, low, high = (
                numbers(spread, column)[places] for column in ("rms_m", "rms_m_low", "rms_m_high")
            )
            ends = (values - low, high - values)
            counts = sorted({int(spread[k]["flights"]) for k in places})
            label = f"{engine}, {' or '.join(map(str, counts))} flights"
            axes.errorbar(
                values, places, xerr=ends, label=label,
                fmt=marker, mfc="w", mec="k", ecolor="k", capsize=3,
            )  # fmt: skip
        labels = [f"{row['label']}: {row['sigma']}" for row in spread]
        axes.set_yticks(range(len(spread)), labels)
        axes.set(xscale="log", xlabel="rms distance from the flight without errors at the end (m)")
        axes.set(ylim=(len(spread) - 0.5, -0.5), xlim=_decades(spread))
        legend(figure, 2)
    return figure


def _decades(rows: list[Row]) -> tuple[float, float]:
    """Whole powers of ten around all intervals."""
    low, high = numbers(rows, "rms_m_low").min(), numbers(rows, "rms_m_high").max()
    return 10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high))


def caption(rows: list[Row]) -> str:
    """Describe the figure."""
    listed = [
        f"{row['label']} {float(row['rms_m']):.3g} m" for row in rows if float(row["rms_m"]) > 0.0
    ]
    return (
        "Root mean square distance of the final positions from that of the flight without errors, with "
        "95 % intervals, for each source of uncertainty alone and for several together. Sources of the "
        "path are flown in the planner's dynamics, the others in the simulation of the whole "
        f"spacecraft: {'; '.join(listed)}."
    )
