"""Draw attitude, actuators and modes of a simulated flight."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from formulations.arrays import Array
from paper_figs.drawing import ABOVE, page
from paper_figs.inputs import unusable
from paper_figs.studies import flight_record
from paper_figs.studies.flight_record import SOURCE, bands, mark_burns
from scp_recon.results.pictures import HOUR_S
from scp_recon.simulation.flight import Actuators
from scp_recon.simulation.record import FILE_NAME, Record

__all__ = ["SOURCE", "caption", "draw", "read"]

COLOURS = ("k", "tab:blue", "tab:orange", "tab:green")
NAMES = ("scalar", "x", "y", "z")
TORQUES = {"thruster": "micro-thrusters", "wheel": "wheels"}
LEAST_MN_M = 1e-3
"""Of torques, which are pulses: below it the axis ends."""


def read(folder: Path) -> Record:
    """Read the simulation file in a folder.

    Raises:
        InputError: as `flight_record.read`; also if it is of before torques were kept.
    """
    record = flight_record.read(folder)
    if not {f"{name}_torque_n_m" for name in TORQUES} <= record.arrays.keys():
        raise unusable(folder / FILE_NAME, folder, SOURCE.command)
    return record


def draw(record: Record) -> Figure:
    """Quaternion and command, the angle between them, torque, speed of the wheels, mode."""
    time = record.arrays["t_s"] / HOUR_S
    with page(7.6) as figure:
        rows = figure.subplots(5, 1, sharex=True, height_ratios=(3, 1.6, 1.9, 1.9, 1.1))
        _attitude(rows[0], record, time)
        error = np.rad2deg(record.arrays["pointing_error_rad"])
        rows[1].semilogy(np.arange(len(error)) / HOUR_S, error, color="k", lw=0.5)
        rows[1].set(ylabel="error (deg)", ylim=(1e-3, 300.0))
        rows[1].set_yticks([1e-2, 1.0, 1e2])
        _torques(rows[2], record, time)
        _wheels(rows[3], record, time)
        _bands(rows[4], record, "mode", dict(enumerate(record.summary.modes)))
        for axes in rows:
            mark_burns(axes, record)
        rows[4].set(xlabel="time (h)", xlim=(0.0, float(time[-1])))
    return figure


def _attitude(axes: Axes, record: Record, time: Array) -> None:
    command = _continuous(record.arrays["command"])
    true = record.arrays["attitude"]
    true = true * np.where(np.einsum("ni,ni->n", true, command) < 0.0, -1.0, 1.0)[:, None]
    for i, (name, colour) in enumerate(zip(NAMES, COLOURS, strict=True)):
        axes.plot(time, true[:, i], color=colour, lw=1.2, label=name)
        axes.plot(time, command[:, i], color=colour, lw=0.9, ls="--")
    axes.plot([], [], color="0.5", lw=0.9, ls="--", label="command")
    axes.set(ylabel="quaternion (body to J2000)", ylim=(-1.05, 1.05))
    axes.legend(**ABOVE, ncols=5)


def _continuous(quaternions: Array) -> Array:
    """The same attitudes with signs that keep neighbours close, shape (n, 4)."""
    turned = np.einsum("ni,ni->n", quaternions[1:], quaternions[:-1]) < 0.0
    signs = np.cumprod(np.where(turned, -1.0, 1.0))
    return quaternions * np.concatenate([[1.0], signs])[:, None]


def _torques(axes: Axes, record: Record, time: Array) -> None:
    """Size of the torque of either actuator, where it acts."""
    for (name, words), colour in zip(TORQUES.items(), ("tab:red", "k"), strict=True):
        size = 1000.0 * np.linalg.norm(record.arrays[f"{name}_torque_n_m"], axis=1)
        acting = np.where(size > LEAST_MN_M, size, np.nan)
        axes.semilogy(time, acting, ".", ms=1.5, color=colour)
        axes.plot([], [], "o", ms=4, color=colour, label=words)
    axes.set(ylabel="torque (mN m)", ylim=(LEAST_MN_M, 30.0))
    axes.set_yticks([1e-3, 1e-2, 1e-1, 1.0, 10.0])
    axes.legend(**ABOVE, ncols=len(TORQUES))


def _wheels(axes: Axes, record: Record, time: Array) -> None:
    """Speed of each wheel, with the dumps of their momentum."""
    dumping = Actuators.BOTH.value
    for start, length in bands(record.arrays["actuators"], record.arrays["t_s"], dumping):
        axes.axvspan(start, start + length, facecolor="0.75", lw=0)
    for i, (speed, colour) in enumerate(
        zip(record.arrays["wheel_speed_rad_s"].T, cycle(COLOURS), strict=False), start=1
    ):
        axes.plot(time, speed, color=colour, lw=1.0, label=f"wheel {i}")
    axes.fill([], [], color="0.75", label="dumping")
    axes.set_ylabel("speed (rad/s)")
    axes.legend(**ABOVE, ncols=6)


def _bands(axes: Axes, record: Record, name: str, labels: dict[int, str]) -> None:
    values, times = record.arrays[name], record.arrays["t_s"]
    for row, value in enumerate(labels):
        axes.broken_barh(
            list(bands(values, times, value)), (row - 0.36, 0.72), facecolor="0.35", lw=0
        )
    axes.set_yticks(range(len(labels)), list(labels.values()))
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.grid(visible=False)


def caption(record: Record) -> str:
    """Describe the figure."""
    summary = record.summary
    camera = summary.window_pointing_deg.camera
    worst = max(burn.pointing_deg for burn in summary.burns)
    return (
        f"Attitude of the simulated flight, seed {summary.seed}. From above: quaternion of the body "
        "(solid) and its command (dashed); angle between the two; size of the torque that wheels and "
        "micro-thrusters exert, means over ten seconds; speed of each wheel, shaded where momentum is "
        "dumped; the mode. Dotted: burns. The camera is within "
        f"{camera.q100:.3f} deg of its command throughout the window, the thrust within "
        f"{worst:.3f} deg of the planned burn when it starts; momentum is dumped "
        f"{summary.dumps} times."
    )
