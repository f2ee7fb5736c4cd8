"""Draw power and charge of a simulated flight."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper_figs.drawing import ABOVE, LEGEND_PT, page
from paper_figs.studies.flight_record import SOURCE, mark_burns, read
from scp_recon.results.pictures import HOUR_S
from scp_recon.simulation.record import Record

__all__ = ["SOURCE", "caption", "draw", "read"]

COLOURS = ("k", "tab:blue", "tab:orange", "tab:green", "tab:red")
DASHES = ("-", "-", "-", "-", "--")
"""The last two panels are equal: the one is seen through the other."""


def draw(record: Record) -> Figure:
    """Generation and consumption, each panel with its maximum, state of charge."""
    time = record.arrays["t_s"] / HOUR_S
    with page(6.0) as figure:
        top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(2, 2.4, 1.2))
        top.plot(time[1:], record.arrays["panel_w"].sum(axis=1)[1:], color="k", label="generated")
        top.plot(time, record.arrays["consumed_w"], color="tab:red", lw=1.0, label="consumed")
        top.set(ylabel="power (W)", ylim=(0.0, None))
        top.legend(**ABOVE, ncols=2)
        _panels(middle, record)
        charge = 100.0 * record.arrays["state_of_charge"]
        for i, look in enumerate(("-", "--")[: charge.shape[1]]):
            bottom.plot(time, charge[:, i], look, color=COLOURS[i], label=f"battery {i + 1}")
        floor = 100.0 * record.summary.floor_charge
        bottom.axhline(floor, color="0.4", ls=":", lw=1.0)
        bottom.annotate("floor", (0.0, floor), (4, 3), textcoords="offset points")
        bottom.set(ylabel="charge (%)", ylim=(0.0, 112.0), xlabel="time (h)")
        bottom.legend(loc="center right", fontsize=LEGEND_PT)
        bottom.set_xlim(0.0, float(time[-1]))
        for axes in (top, middle, bottom):
            mark_burns(axes, record)
    return figure


def _panels(axes: Axes, record: Record) -> None:
    time, power = record.arrays["t_s"] / HOUR_S, record.arrays["panel_w"]
    peaks = record.arrays["panel_peak_w"]
    for i, (peak, colour, dash) in enumerate(zip(peaks.tolist(), COLOURS, DASHES, strict=False)):
        axes.plot(time[1:], power[1:, i], dash, color=colour, lw=1.2, label=f"SP{i + 1}")
        axes.axhline(peak, color=colour, ls=":", lw=1.0)
    axes.set(ylabel="power of each panel (W)", ylim=(-4.0, 1.08 * float(peaks.max())))
    axes.legend(**ABOVE, ncols=len(peaks))


def caption(record: Record) -> str:
    """Describe the figure."""
    generated = record.arrays["panel_w"].sum(axis=1)[1:]
    ratio = generated / record.arrays["consumed_w"][1:]
    return (
        f"Power of the simulated flight, seed {record.summary.seed}. From above: generation and "
        "consumption; each panel against the most it can give with the Sun along its normal "
        "(dotted), SP4 and SP5 being equal; charge of the two batteries with its floor. Dotted "
        "upright: burns. Generation is "
        f"{np.min(ratio):.1f} to {np.max(ratio):.1f} times consumption; the least charge is "
        f"{100.0 * record.summary.least_charge:.1f} %."
    )
