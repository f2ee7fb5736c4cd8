"""Battery and pointing, where the spacecraft's simulation of the plan is there."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scp_recon.report.content import palette
from scp_recon.report.content.histories import Bound
from scp_recon.report.content.subject import Subject
from scp_recon.report.panels import (
    Trace,
    axis_name,
    chart,
    curve,
    limit_line,
    shade_window,
    stacked,
)
from scp_recon.spacecraft.guidance import CONTROL_PERIOD_S
from scp_recon.spacecraft.record import Record

Array = npt.NDArray[np.float64]

BINS = 700
"""Parts of the time, of all simulations together, each shown by two points."""
LEAST_DEG = 1e-4
"""Of the errors shown, on a logarithmic axis."""
PANELS = ("state of charge (%)", "power (W)", "pointing error (deg)", "wheel speed (rad/s)")


def craft_chart(subjects: Sequence[Subject]) -> dict[str, Any] | None:
    """State of charge, power, attitude error and wheels over time; none without a simulation."""
    flown = [(s, s.record) for s in subjects if s.record is not None]
    if not flown:
        return None
    layout = stacked(PANELS)
    shade_window(layout, flown[0][0].mission.schedule.window_s, len(PANELS))
    data: list[Trace] = []
    for number, (subject, record) in enumerate(flown):
        before = "" if len(flown) == 1 else f"{subject.name}: "
        data += _curves(record, before, number, BINS // len(flown))
        floor = 100.0 * record.summary.floor_charge
        limit_line(layout, Bound("floor: at least", floor), 0)
    layout[axis_name("y", 2).replace("y", "yaxis")] |= {
        "type": "log",
        "exponentformat": "power",
        "nticks": 5,
    }
    layout["yaxis"]["range"] = [0, 104]
    return chart("craft", "Battery and pointing in the simulation", data, layout)


def _curves(record: Record, before: str, number: int, bins: int) -> list[Trace]:
    times, arrays = record.arrays["t_s"].astype(float), record.arrays
    data: list[Trace] = []

    def add(values: Array, name: str, panel: int, which: int) -> None:
        dash = palette.DASHES[which % len(palette.DASHES)]
        colour = (which if not before else number) % len(palette.PLANS)
        data.append(
            curve(
                *thinned(times, np.asarray(values, dtype=float), bins),
                before + name,
                colour,
                panel,
                dash=dash,
            )
        )

    for i, charge in enumerate(100.0 * arrays["state_of_charge"].T):
        add(charge, f"battery {i + 1}", 0, i)
    add(arrays["panel_w"].reshape(len(times), -1).sum(axis=1), "generated", 1, 2)
    add(arrays["consumed_w"].reshape(len(times), -1).sum(axis=1), "consumed", 1, 3)
    error = np.rad2deg(arrays["pointing_error_rad"].astype(np.float64))
    seconds = CONTROL_PERIOD_S * np.arange(len(error))
    points = thinned(seconds, np.asarray(np.maximum(error, LEAST_DEG), dtype=float), bins)
    data.append(curve(*points, f"{before}attitude against its command", number, 2))
    for i, speed in enumerate(arrays["wheel_speed_rad_s"].T):
        add(speed, f"wheel {i + 1}", 3, i)
    return data


def thinned(
    times: npt.NDArray[Any], values: npt.NDArray[Any], bins: int = BINS
) -> tuple[Array, Array]:
    """Least and largest value of even parts, each at its time: no peak is lost."""
    if len(times) <= 2 * bins:
        return times, values
    edges = np.linspace(0, len(times), bins + 1).astype(int)
    kept = sorted(
        {
            low + int(pick(values[low:high]))
            for low, high in itertools.pairwise(edges)
            for pick in (np.argmin, np.argmax)
        }
    )
    return times[kept], values[kept]
