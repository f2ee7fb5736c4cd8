"""Draw the frames of `docs/frames.md`."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from formulations.arrays import Array
from paper_figs.drawing import HALO, page
from scp_recon.bodies.surface import direction_of
from scp_recon.physics.frames import Rotation, sun_north_to_j2000, unit

X, Y, Z = np.eye(3)
GREY, BODY, SUN = "0.55", "C0", "C1"


class Drawing:
    """Arrows and arcs in space, seen from a latitude and longitude without perspective."""

    def __init__(self, axes: Axes, latitude_deg: float, longitude_deg: float) -> None:
        self.axes = axes
        towards = direction_of(latitude_deg, longitude_deg)
        right = unit(np.cross(Z, towards))
        self.screen = np.stack([right, np.cross(towards, right)])
        self.towards = towards
        axes.set(xlim=(-1.75, 1.95), ylim=(-1.45, 1.6), aspect="equal")
        axes.set_axis_off()

    def globe(self, pole: Array) -> None:
        """The body as a unit sphere with its equator."""
        turn = np.linspace(0.0, 2.0 * np.pi, 200)
        self.axes.fill(np.cos(turn), np.sin(turn), color="0.94", lw=0)
        self.axes.plot(np.cos(turn), np.sin(turn), color="0.75", lw=0.8)
        one = unit(np.cross(pole, [0.3, 0.5, 0.1]))
        self.arc(one, np.cross(pole, one), 2.0 * np.pi, color="0.7", lw=0.8)

    def arrow(self, to: Array, label: str, color: str = "k", start: Array | None = None) -> None:
        """From the centre, or a start, with its label beyond the head."""
        begin = np.zeros(3) if start is None else start
        tail, head = self.screen @ begin, self.screen @ (begin + to)
        self.axes.annotate(
            "",
            (head[0], head[1]),
            (tail[0], tail[1]),
            arrowprops={"arrowstyle": "-|>", "color": color, "lw": 1.3, "shrinkA": 0, "shrinkB": 0},
        )
        along: Array = head - tail
        along = along / np.hypot(*along)
        side = "left" if along[0] > 0.5 else "right" if along[0] < -0.5 else "center"
        self.text(head + [0.06, 0.12] * along, label, color, side)

    def arc(self, first: Array, second: Array, angle: float, color: str, lw: float = 1.2) -> Array:
        """From a unit vector to another at right angles to it; returns its middle on the screen."""
        turn = np.linspace(0.0, angle, 100)[:, None]
        curve = np.cos(turn) * first + np.sin(turn) * second
        flat = curve @ self.screen.T
        front = curve @ self.towards >= 0.0
        for side, dashes in ((front, "-"), (~front, ":")):
            shown = np.where(side[:, None], flat, np.nan)
            self.axes.plot(*shown.T, color=color, lw=lw, ls=dashes)
        middle: Array = flat[50]
        return middle

    def text(self, at: Array, label: str, color: str = "k", side: str = "center") -> None:
        """A label about a point of the screen, or beside it."""
        self.axes.text(at[0], at[1], label, color=color, ha=side, va="center", path_effects=HALO)


def draw() -> Figure:
    """The figure; nothing is written."""
    with page(6.2) as figure:
        panels = figure.subplots(2, 2).ravel()
        for panel, content in zip(panels, (_fixed, _sun_north, _site, _rtn), strict=True):
            content(panel)
        return figure


def _fixed(axes: Axes) -> None:
    """J2000 and the body-fixed frame, joined by the pole and the angle W."""
    axes.set_title("J2000 (grey) and body-fixed (blue)")
    drawing = Drawing(axes, 22.0, 35.0)
    rotation = Rotation(np.deg2rad(-45.0), np.deg2rad(58.0), np.deg2rad(52.0), 0.0, 0.0)
    matrix = rotation.body_to_j2000(0.0)
    drawing.globe(matrix[:, 2])
    for axis, name in zip((X, Y, Z), "XYZ", strict=True):
        drawing.arrow(1.45 * axis, name, GREY)
    for column, name in enumerate(("x, prime meridian", "y", "z, pole")):
        drawing.arrow(1.3 * matrix[:, column], name, BODY)
    node = np.array([-np.sin(rotation.pole_ra), np.cos(rotation.pole_ra), 0.0])
    drawing.arc(X, Y, 2.0 * np.pi, GREY, 0.7)
    across = np.cross(matrix[:, 2], node)
    drawing.arc(node, across, rotation.meridian, SUN, 2.0)
    turned = 0.5 * rotation.meridian
    drawing.text(
        drawing.screen @ (0.82 * (np.cos(turned) * node + np.sin(turned) * across)), "W", SUN
    )
    drawing.text(drawing.screen @ node + [0.02, -0.14], "node", "0.3")


def _sun_north(axes: Axes) -> None:
    """The Sun-North frame from the direction to the Sun and the pole."""
    axes.set_title("Sun-North")
    drawing = Drawing(axes, 18.0, -50.0)
    pole = direction_of(62.0, -20.0)
    matrix = sun_north_to_j2000(X, pole)
    drawing.globe(pole)
    drawing.arrow(1.3 * pole, "pole", BODY)
    for column, name in enumerate(("X, to the Sun", "Y", "Z")):
        drawing.arrow(1.35 * matrix[:, column], name, SUN)
    x, z = matrix[:, 0], matrix[:, 2]
    drawing.arc(x, z, np.pi, "0.4", 0.9)
    drawing.text(np.array([0.0, -1.3]), "X, Z and the pole lie in one plane", "0.3")


def _site(axes: Axes) -> None:
    """Latitude, longitude, position and normal of a site."""
    axes.set_title("Site, body-fixed")
    drawing = Drawing(axes, 20.0, 25.0)
    latitude, longitude = 48.0, 62.0
    drawing.globe(Z)
    for axis, name in zip((X, Y, Z), ("x", "y", "z, pole"), strict=True):
        drawing.arrow(1.4 * axis, name, BODY)
    foot, site = direction_of(0.0, longitude), direction_of(latitude, longitude)
    east = drawing.arc(X, Y, np.deg2rad(longitude), SUN, 2.0)
    north = drawing.arc(foot, Z, np.deg2rad(latitude), "C2", 2.0)
    drawing.text(east - 0.15 * Y[:2], "longitude", SUN)
    drawing.text(north + 0.36 * X[:2], "latitude", "C2")
    drawing.axes.plot(
        *np.stack([np.zeros(2), drawing.screen @ foot]).T, color="0.6", lw=0.8, ls=":"
    )
    drawing.axes.plot(*np.stack([np.zeros(2), drawing.screen @ site]).T, color="k", lw=1.0)
    drawing.arrow(0.55 * direction_of(58.0, 80.0), "normal", "C3", site)
    drawing.text(drawing.screen @ site + [-0.2, 0.1], "site")


def _rtn(axes: Axes) -> None:
    """Radial, transverse and normal of a state."""
    axes.set_title("Radial, transverse, normal")
    drawing = Drawing(axes, 30.0, -35.0)
    drawing.axes.fill(
        0.28 * np.cos(np.linspace(0, 7, 100)), 0.28 * np.sin(np.linspace(0, 7, 100)), color="0.85"
    )
    normal = unit(np.array([-0.15, -0.1, 1.0]))
    one = unit(np.cross([0.0, 1.0, 0.0], normal))
    two = np.cross(normal, one)
    turn = np.linspace(0.0, 2.0 * np.pi, 200)[:, None]
    orbit = 1.05 * np.cos(turn) * one + 1.05 * np.sin(turn) * two
    drawing.axes.plot(*(orbit @ drawing.screen.T).T, color="0.6", lw=0.9)
    angle = np.deg2rad(-15.0)
    radial = np.cos(angle) * one + np.sin(angle) * two
    at = 1.05 * radial
    drawing.axes.plot(*np.stack([np.zeros(2), drawing.screen @ at]).T, color="0.4", lw=0.9, ls=":")
    for to, name in ((radial, "R"), (np.cross(normal, radial), "T"), (normal, "N")):
        drawing.arrow(0.6 * to, name, "C3", at)
    drawing.text(drawing.screen @ (0.5 * at) + [0.0, 0.13], "r", "0.3")
