"""What each source of uncertainty does: `python -m paper_figs.studies.uncertainty_sources RUNS FILE`.

Drawn from what `python -m experiments.uncertainty_sources` wrote into the folder RUNS.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import sys
from pathlib import Path

import numpy as np
from matplotlib import style
from matplotlib.figure import Figure

from paper_figs.drawing import LEGEND_PT, STYLE, WIDTH_IN, command_from
from paper_figs.inputs import read_csv

FOLDER = "uncertainty_sources"
TABLE = "uncertainty_sources.csv"
COMMAND = "python -m experiments.uncertainty_sources"

Row = dict[str, str]


def read(folder: Path) -> list[Row]:
    """Read the study's table, a dictionary per set of sources.

    Raises:
        InputError: if it is missing or unusable.
    """
    return read_csv(folder, TABLE, "rms_m", COMMAND)


def draw(rows: list[Row]) -> Figure:
    """Dispersion at the end of the flight by source, with intervals, on a logarithmic scale."""
    spread = [row for row in rows if float(row["rms_m"]) > 0.0]
    with style.context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 0.9 + 0.34 * len(spread)), layout="constrained")
        axes = figure.subplots()
        for engine, marker in zip(_engines(spread), ("o", "s"), strict=False):
            places = [k for k, row in enumerate(spread) if row["flown_by"] == engine]
            values, low, high = (
                [float(spread[k][column]) for k in places]
                for column in ("rms_m", "rms_m_low", "rms_m_high")
            )
            ends = (
                [value - end for value, end in zip(values, low, strict=True)],
                [end - value for value, end in zip(values, high, strict=True)],
            )
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
        figure.legend(loc="outside upper center", ncols=2, fontsize=LEGEND_PT)
    return figure


def _engines(rows: list[Row]) -> list[str]:
    return list(dict.fromkeys(row["flown_by"] for row in rows))


def _decades(rows: list[Row]) -> tuple[float, float]:
    """Whole powers of ten around all intervals."""
    low = min(float(row["rms_m_low"]) for row in rows)
    high = max(float(row["rms_m_high"]) for row in rows)
    return 10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high))


def caption(rows: list[Row]) -> str:
    """What the figure shows."""
    listed = [
        f"{row['label']} {float(row['rms_m']):.3g} m" for row in rows if float(row["rms_m"]) > 0.0
    ]
    return (
        "Root mean square distance of the final positions from that of the flight without errors, with "
        "95 % intervals, for each source of uncertainty alone and for several together. Sources of the "
        "path are flown in the planner's dynamics, the others in the simulation of the whole "
        f"spacecraft: {'; '.join(listed)}."
    )


if __name__ == "__main__":
    sys.exit(command_from(read, draw, __doc__))
