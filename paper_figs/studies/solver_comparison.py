"""Draw the comparison of solvers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from formulations.arrays import Array
from paper_figs.drawing import LEGEND_PT, legend, page
from paper_figs.inputs import Row, Source
from scp_recon.monte_carlo.estimates import proportion

COLOURS = {"scvx": "C0", "ptr": "C1", "scvx-star": "C2", "hard": "C3", "elastic": "C4"}
MARKERS = {"CLARABEL": "o", "ECOS": "s", "QOCO": "^", "SCS": "D", "IPOPT": "*", "UNO": "P"}
OTHER = "X"
SOURCE = Source("comparison", "python -m experiments compare_solvers", {"comparison.csv": "group"})
PROFILED = {"scenarios": "P2 from one P3 solution", "random": "random scenarios, cold"}
"""Groups of problems with performance profiles, and their titles."""
COLOURS_MAX = 10
"""Number of colours; methods beyond it have them again, dashed."""
SAME = 1e-4
"""Relative difference of total delta-v within which two ends are the same optimum."""


def solved(row: Row) -> bool:
    """Whether P2 converged."""
    return row["status"] == "converged" and row["problem"] == "P2"


def draw_times(rows: Sequence[Row]) -> Figure:
    """Processor time from the straight line to the end of P2."""
    cold = [row for row in rows if row["group"] == "matrix" and row["start"] == "cold"]
    chosen = [row for row in cold if row["scenario"] == "recon_b"]
    forms = list(dict.fromkeys(row["formulation"] for row in chosen))
    with page(0.55 * len(forms) + 1.6) as figure:
        axes = figure.subplots()
        for row in chosen:
            y = float(len(forms) - 1 - forms.index(row["formulation"]))
            y += 0.14 * (1 - list(COLOURS).index(row["algorithm"]) % 3)
            colour = COLOURS[row["algorithm"]]
            axes.plot(
                float(row["cpu_s"]),
                y,
                MARKERS.get(row["solver"], OTHER),
                color=colour,
                markerfacecolor=colour if solved(row) else "none",
                markersize=6,
            )
        axes.set(xscale="log", xlabel="seconds of the processor from the straight line, P3 and P2")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set_yticks(range(len(forms)), forms[::-1])
        _keys(axes, chosen)
    return figure


def _keys(axes: Axes, rows: Sequence[Row]) -> None:
    """Colours are algorithms, markers solvers, hollow what was not solved."""
    for name in dict.fromkeys(row["algorithm"] for row in rows):
        axes.plot([], [], "o", color=COLOURS[name], label=name)
    for name in dict.fromkeys(row["solver"] for row in rows):
        axes.plot([], [], MARKERS.get(name, OTHER), color="0.3", label=name)
    axes.plot([], [], "o", color="0.3", markerfacecolor="none", label="not solved")
    axes.legend(fontsize=LEGEND_PT, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def draw_guesses(rows: Sequence[Row]) -> Figure:
    """Random guesses: shares solved with intervals, at the first try below, and where they end."""
    chosen = [row for row in rows if row["group"] == "guesses"]
    methods = list(dict.fromkeys(row["method"] for row in chosen))[::-1]
    best = min((float(row["total_dv_m_s"]) for row in chosen if solved(row)), default=np.nan)
    with page(0.42 * len(methods) + 1.5) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        for y, method in enumerate(methods):
            tries = [row for row in chosen if row["method"] == method]
            ends = np.array([float(row["total_dv_m_s"]) for row in tries if solved(row)])
            at_once = sum(solved(row) and not row["first_status"] for row in tries)
            for count, level, colour in ((len(ends), y, "C0"), (at_once, y - 0.2, "C1")):
                share, height = proportion(count, len(tries)), [level, level]
                left.plot(
                    [share.low, share.high], height, color=colour, solid_capstyle="butt", lw=4
                )
                left.plot(share.value, level, "o", color="k", markersize=4, clip_on=False)
            at_best = int((ends <= best * (1.0 + SAME)).sum())
            right.plot(ends / best - 1.0, np.full(len(ends), y), "|", color="C0", markersize=12)
            right.annotate(
                f"{at_best} of {len(tries)} at the best",
                (1.0, y),
                xycoords=("axes fraction", "data"),
                ha="right",
                va="bottom",
                fontsize=LEGEND_PT,
            )
        left.set(xlim=(0.0, 1.0), xlabel="share solved, 95 % interval")
        left.set_yticks(range(len(methods)), methods)
        left.set_ylim(-0.5, len(methods) - 0.2)
        for name, colour in (("solved", "C0"), ("at the first try", "C1")):
            left.plot([], [], color=colour, lw=4, label=name)
        left.legend(fontsize=LEGEND_PT, loc="upper left")
        right.set(xlabel="total delta-v over the best, less one")
        span = max(1e-3, right.get_xlim()[1])
        right.set_xlim(-0.1 * span, 1.1 * span)
        right.xaxis.set_major_locator(MaxNLocator(4))
    return figure


def draw_scenarios(rows: Sequence[Row]) -> Figure:
    """Delta-v against probability and execution error, of methods with several scenarios."""
    chosen = [
        row for row in rows if row["group"] == "scenarios" and row["algorithm"] != "unguarded"
    ]
    counts = Counter(row["method"] for row in chosen)
    methods = [method for method, count in counts.items() if count > 1]
    panels = (
        ("p_chance", 0.7, "required probability (-)"),
        ("beta", 0.08, "execution error, 1 sigma (-)"),
    )
    with page(3.4) as figure:
        both = figure.subplots(1, 2, sharey=True)
        for axes, (name, default, label) in zip(both, panels, strict=True):
            for number, method in enumerate(methods):
                points = [
                    (
                        _value(row["scenario"], name, default),
                        float(row["total_dv_m_s"]),
                        solved(row),
                    )
                    for row in chosen
                    if row["method"] == method and row["scenario"].startswith((f"{name}=", "recon"))
                ]
                _line(axes, sorted(points), method, f"C{number}", max(11.0 - 1.4 * number, 3.0))
            axes.set_xlabel(label)
        both[0].set_ylabel("total delta-v (m/s)")
        both[0].plot([], [], "x", color="0.3", label="not solved")
        legend(figure, 3)
    return figure


def draw_profiles(rows: Sequence[Row]) -> Figure:
    """Share of the problems that a method solves within a multiple of the least processor time."""
    groups = [group for group in PROFILED if any(row["group"] == group for row in rows)]
    methods = list(dict.fromkeys(row["method"] for row in rows if row["group"] in groups))
    with page(3.4) as figure:
        panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
        for axes, group in zip(panels, groups, strict=True):
            of_group = [row for row in rows if row["group"] == group]
            for method, (ratios, share) in profiles(of_group).items():
                number = methods.index(method)
                look = "--" if number >= COLOURS_MAX else "-"
                axes.step(ratios, share, look, where="post", color=f"C{number}", label=method)
            axes.set(xscale="log", ylim=(0.0, 1.02), title=PROFILED[group])
            axes.xaxis.set_major_formatter("{x:g}")
        panels[0].set_ylabel("share solved")
        figure.supxlabel("processor time over the least of all methods", fontsize="medium")
        legend(figure, 3)
    return figure


def profiles(rows: Sequence[Row]) -> dict[str, tuple[Array, Array]]:
    """Ratios to the least time, and shares solved within them, of methods that got every problem."""
    best = _least(filter(solved, rows), "total_dv_m_s")
    ended = [
        row
        for row in filter(solved, rows)
        if float(row["total_dv_m_s"]) <= (1 + SAME) * best[row["scenario"]]
    ]
    least = _least(ended, "cpu_s")
    found = {}
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        if {row["scenario"] for row in own} >= least.keys():
            ratios = sorted(
                float(row["cpu_s"]) / least[row["scenario"]] for row in own if row in ended
            )
            found[method] = np.array(ratios), np.arange(1, len(ratios) + 1) / len(least)
    return found


def _least(rows: Iterable[Row], column: str) -> dict[str, float]:
    found: dict[str, float] = {}
    for row in rows:
        found[row["scenario"]] = min(float(row[column]), found.get(row["scenario"], np.inf))
    return found


def _value(scenario: str, name: str, default: float) -> float:
    return float(scenario.removeprefix(f"{name}=")) if "=" in scenario else default


def _line(
    axes: Axes, points: list[tuple[float, float, bool]], label: str, colour: str, size: float
) -> None:
    """Markers of falling size, so that methods that agree show through each other."""
    if not points:
        return
    x, y, done = map(np.array, zip(*points, strict=True))
    axes.plot(x[done], y[done], "o", color=colour, markersize=size, markerfacecolor="none")
    axes.plot(x[~done], y[~done], "x", color=colour, markersize=6)
    axes.plot([], [], "o", color=colour, markerfacecolor="none", label=label)


FIGURES: dict[str, tuple[str, Callable[[Sequence[Row]], Figure]]] = {
    "comparison_times": ("matrix", draw_times),
    "comparison_profiles": ("scenarios", draw_profiles),
    "comparison_guesses": ("guesses", draw_guesses),
    "comparison_scenarios": ("scenarios", draw_scenarios),
}
"""By name, with the group of rows that each needs."""


def draw(rows: Sequence[Row]) -> dict[str, Figure]:
    """Draw the figures of the groups in the table."""
    groups = {row["group"] for row in rows}
    return {name: one(rows) for name, (group, one) in FIGURES.items() if group in groups}
