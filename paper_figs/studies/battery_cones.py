"""Draw the positions at which the panels cannot carry the load."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from paper_figs.drawing import legend, page
from paper_figs.inputs import Row, Source, Tables, numbers

SOURCE = Source(
    "battery_cones",
    "python -m experiments battery_cones",
    {"battery_cones.csv": "half_angle_deg", "battery_cones_samples.csv": "power_w"},
)
COLOURS = ("k", "tab:red")
"""Of the two loads' boundaries, as in the paper."""


def _calibrated(cones: list[Row]) -> list[Row]:
    """The modes' cones calibrated by the housekeeping power."""
    return [cone for cone in cones if cone["calibrated"] == "true"]


def draw(found: Tables) -> Figure:
    """Both halves of the sphere as seen along the Sun line, and generation against the angle to it."""
    with page(5.9) as figure:
        grid = figure.add_gridspec(2, 2, height_ratios=(1.5, 1.0))
        halves = [figure.add_subplot(grid[0, k]) for k in range(2)]
        titles = "sunward half, seen from the Sun", "anti-sunward half, same view"
        for axes, sign, title in zip(halves, (1.0, -1.0), titles, strict=True):
            points = _half(axes, found, sign)
            axes.set_title(title, loc="left")
        halves[0].set_ylabel("z, to the pole (km)")
        bar = figure.colorbar(points, ax=halves, shrink=0.7)
        bar.set_label("best generation (W)")
        _profile(figure.add_subplot(grid[1, :]), found)
        legend(figure, 2)
    return figure


def _half(axes: Axes, found: Tables, sign: float) -> PathCollection:
    cones, samples = found
    x, y, z, power_w = (numbers(samples, column) for column in ("x", "y", "z", "power_w"))
    seen = sign * x > 0.0
    points = axes.scatter(
        y[seen], z[seen], c=power_w[seen], s=7.0, cmap="cividis", lw=0, rasterized=True,
        vmin=0.0, vmax=float(power_w.max()),
    )  # fmt: skip
    for cone, colour in zip(_calibrated(cones), COLOURS, strict=True):
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


def _profile(axes: Axes, found: Tables) -> None:
    cones, samples = found
    angle = np.rad2deg(np.arccos(np.clip(numbers(samples, "x"), -1.0, 1.0)))
    axes.plot(angle, numbers(samples, "power_w"), ".", ms=1.5, color="0.45", rasterized=True)
    for cone, colour in zip(_calibrated(cones), COLOURS, strict=True):
        half = float(cone["half_angle_deg"])
        axes.axhline(float(cone["load_w"]), color=colour, lw=1.0, ls="--")
        for edge in (half, 180.0 - half):
            axes.axvline(edge, color=colour, lw=1.0)
    axes.set(xlabel="angle of the position to the Sun line (deg)", ylabel="best generation (W)")
    axes.set(xlim=(0.0, 180.0), ylim=(0.0, None))
    axes.set_xticks(np.arange(0, 181, 30))
    axes.annotate("shadow", (171.0, 0.0), (0, 4), ha="center", textcoords="offset points")


def caption(found: Tables) -> str:
    """Describe the figure."""
    cones, samples = found
    calibrated = _calibrated(cones)
    raw = [cone for cone in cones if cone not in calibrated]
    fitted, plain = (
        " and ".join(f"{float(cone['half_angle_deg']):.2f} deg" for cone in some)
        for some in (calibrated, raw)
    )
    loads = " and ".join(f"{float(cone['load_w']):.0f} W" for cone in calibrated)
    return (
        f"Generation of the five panels at {len(samples)} random positions on a sphere of 1 km "
        "about the asteroid's centre, the bottom face to nadir and the rotation about it that "
        "generates most; 0 in the asteroid's shadow. Circles and vertical lines: the two cones in "
        f"which generation less housekeeping is below {loads}, {fitted}; without housekeeping the "
        f"panels alone give {plain}. Dashed below: the loads."
    )
