"""Draw the pages' concepts: the planner's steps, modes, facets, lifting, exact risk, feedback.

Nothing is computed from a plan; the drawings need no input.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, FancyBboxPatch, Polygon, Rectangle
from scipy.stats import chi

from formulations.arrays import Array
from paper_figs.drawing import BURN, legend, page
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import Mode
from scp_recon.scenario.load import load_scenario

EDGE, FILL, DARK = "0.25", "0.94", "0.8"
SMALL = 7.5
"""Size of the words beside what they explain."""

# --- the planner ----------------------------------------------------------------------------------

STEPS = (
    ("scenario", "one TOML file,\nwith what it inherits"),
    ("mission", "window, schedule,\ngrid, units"),
    ("P3", "no uncertainty,\nfrom the guess"),
    ("facets", "chosen at P3;\nor exact risk"),
    ("P2", "mean and factor of\nthe covariance"),
    ("certification", "of exact risk: rounds\naim, two looks judge"),
    ("verification", "another integrator,\n10,000 flights"),
)
LOOP = (
    ("linearise", "arcs with second\nderivatives"),
    ("convex program", "CVXPY, compiled once;\nClarabel"),
    ("trial flight", "Newton closes\nthe defects"),
    ("ratio test", "step and radius;\nstop?"),
)


def planner() -> Figure:
    """The one way through, and the iteration of its two stages below."""
    with page(3.5, 9.2) as figure:
        axes = figure.subplots()
        wide, tall, step = 1.24, 0.82, 1.5
        for k, (name, words) in enumerate(STEPS):
            _box(
                axes,
                (k * step, 2.2),
                (wide, tall),
                name,
                words,
                DARK if name in ("P3", "P2") else FILL,
            )
            if k:
                _arrow(axes, ((k - 1) * step + wide / 2, 2.2), (k * step - wide / 2, 2.2))
        centres = [(1.5 + 2.0 * k, 0.35) for k in range(len(LOOP))]
        for k, ((name, words), centre) in enumerate(zip(LOOP, centres, strict=True)):
            _box(axes, centre, (1.55, tall), name, words, "w")
            if k:
                _arrow(axes, (centres[k - 1][0] + 0.775, 0.35), (centre[0] - 0.775, 0.35))
        back = -0.42
        ends = (centres[-1][0], -0.06), (centres[0][0], -0.06)
        axes.plot(
            [ends[0][0], ends[0][0], ends[1][0]], [ends[0][1], back, back], color=EDGE, lw=1.0
        )
        _arrow(axes, (ends[1][0], back), ends[1])
        axes.text(4.5, back - 0.06, "until stationary", ha="center", va="top", size=SMALL)
        axes.add_patch(
            FancyBboxPatch(
                (0.5, -0.75), 8.0, 1.68, boxstyle="round,pad=0.02", fill=False, ec="0.55", ls="--"
            )
        )
        axes.text(0.55, 0.98, "an iteration of either stage", size=SMALL, color="0.35", va="bottom")
        for stage in (2, 4):
            axes.plot([stage * step] * 2, [2.2 - tall / 2, 0.95], color="0.55", lw=1.0, ls="--")
        _curve(axes, (4 * step - 0.2, 2.62), (3 * step, 2.62), "again, on request")
        _curve(axes, (5 * step, 2.62), (4 * step + 0.2, 2.62), "another aim")
        axes.set(xlim=(-0.75, 9.75), ylim=(-0.85, 3.3), aspect="equal")
        axes.set_axis_off()
    return figure


def _box(
    axes: Axes, at: tuple[float, float], size: tuple[float, float], name: str, words: str, fill: str
) -> None:
    (x, y), (wide, tall) = at, size
    axes.add_patch(
        FancyBboxPatch(
            (x - wide / 2, y - tall / 2), wide, tall, boxstyle="round,pad=0,rounding_size=0.08",
            fc=fill, ec=EDGE, lw=1.0,
        )
    )  # fmt: skip
    axes.text(x, y + 0.22, name, ha="center", va="center", weight="bold", size=9)
    axes.text(x, y - 0.14, words, ha="center", va="center", size=6.5, linespacing=1.15)


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    look = {"arrowstyle": "-|>", "color": EDGE, "lw": 1.0, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=look)


def _curve(axes: Axes, start: tuple[float, float], end: tuple[float, float], words: str) -> None:
    """An arrow back over the boxes."""
    style = {"arrowstyle": "-|>", "color": "0.45", "lw": 1.0, "connectionstyle": "arc3,rad=0.35"}
    axes.annotate("", end, start, arrowprops=style)
    middle = 0.5 * (start[0] + end[0])
    rise = 0.19 * abs(start[0] - end[0])
    axes.text(middle, start[1] + rise, words, ha="center", va="bottom", size=SMALL, color="0.35")


# --- facets of a shell ----------------------------------------------------------------------------


def polytopes() -> Figure:
    """Keep-in, keep-out and the condition of a facet, in a section."""
    with page(3.4, 9.2) as figure:
        left, middle, right = figure.subplots(1, 3)
        _shell(left, "keep in: every facet has to hold")
        corners = _corners(6, 1.0, 0.0)
        left.add_patch(Polygon(corners, fc=DARK, ec="k", lw=1.5))
        left.add_patch(Circle((0, 0), 0.6, fc="w", ec="0.5", ls="--"))
        _craft(left)
        left.text(-0.05, -0.75, "polytope inside", ha="center", size=SMALL)
        _shell(middle, "keep out: the most probable facet has to hold")
        corners = _corners(6, 0.6 / np.cos(np.pi / 6), np.pi / 6)
        middle.add_patch(Rectangle((0.6, -1.2), 1.0, 2.4, fc=DARK, ec="none"))
        middle.add_patch(Polygon(corners, fill=False, ec="0.6", lw=1.5))
        middle.plot([0.6, 0.6], [-1.2, 1.2], "k-", lw=1.8)
        _craft(middle)
        middle.text(0.56, -1.05, "chosen", ha="right", size=SMALL)
        middle.text(-0.05, -0.84, "not used", ha="center", size=SMALL, color="0.45")
        _condition(right)
    return figure


def _corners(count: int, radius: float, first: float) -> Array:
    angles = first + 2.0 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _shell(axes: Axes, title: str) -> None:
    """The shell between two spheres about the site."""
    axes.add_patch(Circle((0, 0), 1.0, fc="none", ec="0.5", ls="--"))
    axes.add_patch(Circle((0, 0), 0.6, fc="none", ec="0.5", ls="--"))
    axes.plot(0.0, 0.0, "k^", ms=5)
    axes.text(0.0, -0.09, "site", ha="center", va="top", size=SMALL)
    axes.set_title(title)
    axes.set(xlim=(-1.12, 1.22), ylim=(-1.17, 1.17), aspect="equal")
    axes.set_axis_off()


def _craft(axes: Axes) -> None:
    for sigmas in (1.0, 2.0):
        axes.add_patch(
            Ellipse((0.75, 0.0), 0.055 * sigmas, 0.11 * sigmas, fill=False, ec=BURN, lw=1.0)
        )
    axes.plot(0.75, 0.0, "o", ms=3, color=BURN)
    axes.plot([0.0, 0.75], [0.0, 0.0], color=BURN, lw=0.8, ls=":")


def _condition(axes: Axes) -> None:
    """The mean stays a multiple of the spread along the normal away from the facet."""
    mean, facet, quantile = np.array([-0.75, -0.1]), 0.35, 2.0
    covariance = np.array([[0.16, 0.04], [0.04, 0.07]])
    axes.axvspan(-2.0, facet, fc=FILL, lw=0)
    axes.plot([facet, facet], [-1.2, 1.2], "k-", lw=1.8)
    angles = np.linspace(0.0, 2.0 * np.pi, 97)
    circle = np.linalg.cholesky(covariance) @ np.stack([np.cos(angles), np.sin(angles)])
    for sigmas in (1.0, quantile):
        axes.plot(*(mean[:, None] + sigmas * circle), color=BURN, lw=1.0)
    axes.plot(*mean, "o", ms=4, color=BURN)
    reach = mean[0] + quantile * float(np.sqrt(covariance[0, 0]))
    axes.plot([reach, reach], [-1.2, 0.8], color=BURN, lw=0.9, ls=":")
    _measure(axes, (mean[0], reach), 0.7, BURN)
    axes.text(0.5 * (mean[0] + reach), 0.75, r"$q\,\|S'a\|$", ha="center", va="bottom", color=BURN)
    _measure(axes, (reach, facet), -1.0, "k")
    axes.text(reach - 0.05, -1.0, "margin", ha="right", va="center", size=SMALL)
    axes.annotate(
        "", (facet + 0.4, 0.3), (facet, 0.3), arrowprops={"arrowstyle": "-|>", "color": "k"}
    )
    axes.text(facet + 0.43, 0.3, r"$a$", va="center")
    axes.text(mean[0], mean[1] - 0.12, r"$\mu$", ha="center", va="top", color=BURN)
    axes.text(facet + 0.06, 1.02, r"$a'r = b$", ha="left")
    axes.set_title(r"a facet:  $a'\mu + q\,\|S'a\| \leq b$")
    axes.set(xlim=(-1.75, 1.05), ylim=(-1.4, 1.2), aspect="equal")
    axes.set_axis_off()


def _measure(axes: Axes, ends: tuple[float, float], height: float, colour: str) -> None:
    """A double arrow along a length."""
    look = {"arrowstyle": "<->", "color": colour, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (ends[1], height), (ends[0], height), arrowprops=look)


# --- lifting --------------------------------------------------------------------------------------


def lifting() -> Figure:
    """How the factor grows at burns, and why a facet is convex in it and not in the covariance."""
    with page(3.1, 9.2) as figure:
        grid = figure.add_gridspec(1, 3, width_ratios=(1.75, 1.0, 1.0))
        _factor(figure.add_subplot(grid[0]))
        variance, deviation = (figure.add_subplot(grid[k]) for k in (1, 2))
        room = np.linspace(0.0, 1.0, 101)
        for axes, edge, name, title in (
            (variance, (1.0 - room) ** 2, r"variance  $a'\Sigma a$", "covariance: not convex"),
            (deviation, 1.0 - room, r"deviation  $\|S'a\|$", "factor: a second-order cone"),
        ):
            axes.fill_between(room, 0.0, edge, fc=DARK, lw=0)
            axes.plot(room, edge, "k-", lw=1.5)
            ends = np.array([[room[20], edge[20]], [1.0, 0.0]])
            axes.plot(*ends.T, "o-", color=BURN, lw=1.0, ms=4)
            axes.plot(*ends.mean(axis=0), "s", mfc="w", mec=BURN, ms=6)
            axes.set(xlabel=r"mean  $a'\mu$", ylabel=name, xlim=(0.0, 1.08), ylim=(0.0, 1.05))
            axes.set_xticks([1.0], ["$b$"])
            axes.set_yticks([])
            axes.grid(visible=False)
            axes.set_title(title)
        variance.annotate(
            "the middle of two\npoints that hold", (0.6, 0.32), (0.42, 0.78), size=SMALL, color=BURN,
            arrowprops={"arrowstyle": "-", "color": BURN, "lw": 0.8},
        )  # fmt: skip
        for axes in (variance, deviation):
            axes.text(0.13, 0.1, "holds", size=SMALL)
    return figure


def _factor(axes: Axes) -> None:
    """Columns of the factor before and after the first burns."""
    names = (r"$S_0$", r"$S_k$", r"$S_N$")
    when = ("start", "after burn 1", "after burns 1, 2")
    left = 0.0
    for k, (name, word) in enumerate(zip(names, when, strict=True)):
        width = 1.2 + 0.6 * k
        axes.add_patch(Rectangle((left, 0.0), 1.2, 1.2, fc=FILL, ec=EDGE))
        label = r"$\Sigma_0^{1/2}$" if k == 0 else r"$A \cdots \Sigma_0^{1/2}$"
        axes.text(left + 0.6, 0.6, label, ha="center", va="center", size=9)
        for burn in range(k):
            x = left + 1.2 + 0.6 * burn
            axes.add_patch(Rectangle((x, 0.0), 0.6, 1.2, fc=DARK, ec=EDGE))
            axes.text(x + 0.3, 0.6, f"burn\n{burn + 1}", ha="center", va="center", size=SMALL)
        axes.text(left + width / 2, 1.28, name, ha="center", va="bottom", size=11)
        axes.text(left + width / 2, -0.1, word, ha="center", va="top", size=SMALL)
        left += width + 0.55
        if k < len(names) - 1:
            _arrow(axes, (left - 0.47, 0.6), (left - 0.08, 0.6))
    for height, size, words in (
        (-0.62, 11, r"$S_{k+1} = [\,A_k S_k,\;\; \beta B\,\mathrm{diag}(\Delta v_i)\,]$"),
        (-1.08, SMALL, r"$\Sigma_k = S_k S_k'$; three columns more at each burn, affine in it"),
    ):
        axes.text(0.5 * (left - 0.55), height, words, ha="center", va="top", size=size)
    axes.set(xlim=(-0.1, left - 0.45), ylim=(-1.45, 1.75), aspect="equal")
    axes.set_axis_off()


# --- attitude modes -------------------------------------------------------------------------------

RULES = {
    "slew": ("0.55", "attitude_s"),
    "heating": ("C1", "heating_s"),
    "recharge": ("C2", "recharge_s"),
}
"""Colour of what a mode begins with, and the rule that says how long it takes."""
IN_MODE = {
    Mode.DELTA_V: ("slew", "heating"),
    Mode.OBSERVATION: ("slew",),
    Mode.SUN_POINTING: ("slew", "recharge"),
}


def modes() -> Figure:
    """The attitude modes of the default flight, what each begins with, and where burns may be."""
    mission = Mission.from_scenario(load_scenario())
    schedule, scenario = mission.schedule, mission.scenario
    rows = list(IN_MODE)
    with page(2.6) as figure:
        axes = figure.subplots()
        for leg in schedule.legs:
            row, begin = rows.index(leg.mode) + 1, leg.start_s
            axes.barh(row, leg.end_s - begin, 0.6, begin, fc="C0", alpha=0.25, lw=0)
            for name in IN_MODE[leg.mode]:
                colour, rule = RULES[name]
                length = getattr(scenario.schedule, rule)
                axes.barh(row, length, 0.6, begin, fc=colour, lw=0)
                begin += length
        for time, (early, late) in zip(
            scenario.burns.times_s, schedule.firing_intervals_s, strict=True
        ):
            late = min(late, scenario.duration_s + 600.0)
            axes.plot([early, late], [0.0, 0.0], color=BURN, lw=5.0, alpha=0.35)
            axes.plot(time, 0.0, "v", color=BURN, ms=7)
        axes.axvspan(*schedule.window_s, fc="gold", alpha=0.3, lw=0)
        for name, (colour, _) in RULES.items():
            axes.barh(0, 0, fc=colour, label=name)
        axes.barh(0, 0, fc="C0", alpha=0.25, label="rest of the mode")
        axes.barh(0, 0, fc="gold", alpha=0.3, label="window")
        axes.plot([], [], "v", color=BURN, label="burn, and its legal times")
        axes.set_yticks(range(len(rows) + 1), ["burns", *rows])
        axes.invert_yaxis()
        axes.set(xlabel="time past the epoch (s)", xlim=(-600.0, scenario.duration_s + 600.0))
        legend(figure, 3)
    return figure


# --- exact risk -----------------------------------------------------------------------------------

INNER, OUTER = 0.6, 1.0
"""Radii of the shell in which the spacecraft has to be."""
SPREAD = np.array([[0.2, 0.05], [0.05, 0.3]])
"""A factor of the covariance."""


def directions() -> Figure:
    """Lines through the mean, the parts of them that keep the limits, and one line's probability."""
    mean, lines, shown = np.array([0.78, 0.12]), 8, 1
    s = np.linspace(-3.5, 3.5, 1401)
    density = 0.5 * chi.pdf(abs(s), len(mean))
    with page(3.2, 8.4) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.15))
        for radius, shade in ((OUTER, FILL), (INNER, "w")):
            left.add_patch(Circle((0, 0), radius, fc=shade, ec="k", lw=1.3))
        angles = np.linspace(0.0, 2.0 * np.pi, 97)
        circle = SPREAD @ np.stack([np.cos(angles), np.sin(angles)])
        for sigmas in (1.0, 2.0):
            left.plot(*(mean[:, None] + sigmas * circle), color="0.45", lw=0.9, ls="--")
        for k, angle in enumerate(np.pi * (np.arange(lines) + 0.5) / lines):
            path = mean + s[:, None] * (SPREAD @ [np.cos(angle), np.sin(angle)])
            radius = np.linalg.norm(path, axis=1)
            kept = (radius >= INNER) & (radius <= OUTER)
            wide = 2.6 if k == shown else 1.0
            left.plot(*path.T, color=BURN, lw=0.5 * wide)
            left.plot(*np.where(kept[:, None], path, np.nan).T, color="C2", lw=wide)
            if k == shown:
                left.text(*path[-1], "this line", size=SMALL, ha="center", va="bottom")
                right.fill_between(s, density, where=kept, fc="C2", alpha=0.6, lw=0)
                right.fill_between(s, density, where=~kept, fc=BURN, alpha=0.3, lw=0)
        left.plot(*mean, "ko", ms=4)
        left.text(0.0, 0.0, "keep out", ha="center", va="center", size=SMALL)
        left.text(-0.8, 0.0, "keep in", ha="center", va="center", size=SMALL, rotation=90)
        left.set(xlim=(-1.05, 1.6), ylim=(-1.05, 1.3), aspect="equal")
        left.set_title("lines through the mean; green: all limits hold")
        left.set_axis_off()
        right.plot(s, density, "k-", lw=1.2)
        right.set(xlabel="distance from the mean (sigma)", ylabel="density (1/sigma)")
        right.set(xlim=(-3.5, 3.5), ylim=(0.0, 0.35))
        right.set_title("this line's probability: the green area")
    return figure


# --- feedback -------------------------------------------------------------------------------------


def closed_loop() -> Figure:
    """Dispersion and knowledge along one axis: measured at a cut-off, corrected at a burn."""
    cut_off, burn, end = 0.4, 0.55, 1.0
    times = np.linspace(0.0, end, 501)
    start, error = np.diag([0.02, 0.35]) ** 2, np.diag([0.03, 0.08]) ** 2
    open_loop = np.array([_coasted(start, t) for t in times])
    before = _coasted(start, cut_off)
    gain = before @ np.linalg.inv(before + error)
    # The correction turns the estimated state towards the plan's position at the end.
    turn = np.array([[1.0, 0.0], [-1.0 / (end - burn), 0.0]])
    estimated = turn @ _coasted(gain @ before, burn - cut_off) @ turn.T
    left = before - gain @ before
    corrected = _coasted(left, burn - cut_off) + estimated
    knowledge, closed = open_loop.copy(), open_loop.copy()
    for k, t in enumerate(times):
        if t >= cut_off:
            knowledge[k] = _coasted(left, t - cut_off)
        if t >= burn:
            closed[k] = _coasted(corrected, t - burn)
    with page(2.6) as figure:
        axes = figure.subplots()
        for covariance, colour, dashes, name in (
            (open_loop, "0.45", "--", "dispersion, open loop"),
            (closed, BURN, "-", "dispersion, with feedback"),
            (knowledge, "C0", ":", "error of the estimate"),
        ):
            sigma = np.sqrt(covariance[:, 0, 0])
            axes.plot(times, sigma, color=colour, ls=dashes, lw=1.8, label=name)
        top = float(np.sqrt(open_loop[-1, 0, 0]))
        for time, words in (
            (0.0, "burn 1"),
            (cut_off, "cut-off:\nmeasured"),
            (burn, "burn 2:\ncorrected"),
        ):
            axes.axvline(time, color="0.75", lw=0.9)
            axes.text(time + 0.01, top, words, size=SMALL, va="top")
        axes.annotate("", (burn, 0.6 * top), (cut_off, 0.6 * top), arrowprops={"arrowstyle": "<->"})
        axes.text(0.5 * (cut_off + burn), 0.62 * top, "lead", size=SMALL, ha="center")
        axes.set(xlabel="time", ylabel="position, 1 sigma", xticks=[], yticks=[], xlim=(-0.02, end))
        axes.set_ylim(bottom=0.0)
        legend(figure, 3)
    return figure


def _coasted(covariance: Array, time: float) -> Array:
    """A covariance of position and velocity along one axis, after a coast."""
    flow = np.array([[1.0, time], [0.0, 1.0]])
    return flow @ covariance @ flow.T
