"""Where the panels cannot carry the load."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from formulations.arrays import Array
from paper_figs.drawing import legend, page
from paper_figs.inputs import Row, Source, numbers

SOURCE = Source(
    "battery_cones",
    "python -m experiments battery_cones",
    {"battery_cones.csv": "half_angle_deg", "battery_cones_samples.csv": "power_w"},
)
COLOURS = ("k", "tab:red")
"""Of the two loads' boundaries, as in the paper."""


@dataclass(frozen=True)
class BatteryCones:
    """What the study found.

    Attributes:
        direction: sampled positions on the unit sphere, Sun-North frame, shape (n, 3).
        power_w: best generation there, shape (n,).
        cones: a dictionary per mode and calibration.
    """

    direction: Array
    power_w: Array
    cones: list[Row]

    @property
    def calibrated(self) -> list[Row]:
        """The modes' cones with the housekeeping taken off."""
        return [cone for cone in self.cones if cone["calibrated"] == "true"]

    @property
    def uncalibrated(self) -> list[Row]:
        """The modes' cones as the panels give them."""
        return [cone for cone in self.cones if cone["calibrated"] == "false"]


def read(folder: Path) -> BatteryCones:
    """Read the study's folder.

    Raises:
        InputError: if a file is missing or unusable.
    """
    cones, samples = SOURCE.read(folder)
    direction = np.stack([numbers(samples, axis) for axis in "xyz"], axis=1)
    return BatteryCones(direction, numbers(samples, "power_w"), cones)


def draw(found: BatteryCones) -> Figure:
    """Both halves of the sphere as seen along the Sun line, and generation against the angle to it."""
    with page(5.9) as figure:
        grid = figure.add_gridspec(2, 2, height_ratios=(1.5, 1.0))
        halves = [figure.add_subplot(grid[0, k]) for k in range(2)]
        titles = (
            "sunward half, seen from the Sun",
            "anti-sunward half, same view",
        )
        for axes, sign, title in zip(halves, (1.0, -1.0), titles, strict=True):
            points = _half(axes, found, sign)
            axes.set_title(title, loc="left")
        halves[0].set_ylabel("z, to the pole (km)")
        bar = figure.colorbar(points, ax=halves, shrink=0.7)
        bar.set_label("best generation (W)")
        _profile(figure.add_subplot(grid[1, :]), found)
        legend(figure, 2)
    return figure


def _half(axes: Axes, found: BatteryCones, sign: float) -> PathCollection:
    seen = sign * found.direction[:, 0] > 0.0
    y, z = found.direction[seen, 1], found.direction[seen, 2]
    points = axes.scatter(
        y, z, c=found.power_w[seen], s=7.0, cmap="cividis", lw=0, rasterized=True,
        vmin=0.0, vmax=float(found.power_w.max()),
    )  # fmt: skip
    for cone, colour in zip(found.calibrated, COLOURS, strict=True):
        angle = float(cone["half_angle_deg"])
        label = f"{float(cone['load_w']):.0f} W, {cone['mode']}: {angle:.1f} deg"
        radius = np.sin(np.deg2rad(angle))
        axes.add_patch(Circle((0.0, 0.0), radius, fill=False, ec="w", lw=3.0))
        axes.add_patch(Circle((0.0, 0.0), radius, fill=False, ec=colour, lw=1.5))
        axes.plot([], [], color=colour, lw=1.5, label=label)
    axes.grid(visible=False)
    axes.set(
        xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), aspect="equal", xlabel="y, across the Sun (km)"
    )
    return points


def _profile(axes: Axes, found: BatteryCones) -> None:
    angle = np.rad2deg(np.arccos(np.clip(found.direction[:, 0], -1.0, 1.0)))
    axes.plot(angle, found.power_w, ".", ms=1.5, color="0.45", rasterized=True)
    for cone, colour in zip(found.calibrated, COLOURS, strict=True):
        half = float(cone["half_angle_deg"])
        axes.axhline(float(cone["load_w"]), color=colour, lw=1.0, ls="--")
        for edge in (half, 180.0 - half):
            axes.axvline(edge, color=colour, lw=1.0)
    axes.set(xlabel="angle of the position to the Sun line (deg)", ylabel="best generation (W)")
    axes.set(xlim=(0.0, 180.0), ylim=(0.0, None))
    axes.set_xticks(np.arange(0, 181, 30))
    axes.annotate("shadow", (171.0, 0.0), (0, 4), ha="center", textcoords="offset points")


def caption(found: BatteryCones) -> str:
    """What the figure shows."""
    plain = " and ".join(f"{float(cone['half_angle_deg']):.2f} deg" for cone in found.uncalibrated)
    fitted = " and ".join(f"{float(cone['half_angle_deg']):.2f} deg" for cone in found.calibrated)
    loads = " and ".join(f"{float(cone['load_w']):.0f} W" for cone in found.calibrated)
    return (
        f"Generation of the five panels at {len(found.power_w)} random positions on a sphere of 1 km "
        "about the asteroid's centre, the bottom face to nadir and the rotation about it that "
        "generates most; 0 in the asteroid's shadow. Circles and vertical lines: the two cones in "
        f"which generation less housekeeping is below {loads}, {fitted}; without housekeeping the "
        f"panels alone give {plain}. Dashed below: the loads."
    )
