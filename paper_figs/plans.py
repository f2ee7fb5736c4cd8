"""Draw the studies of plans: what probability, feedback and sites cost, and how solvers compare."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pandas import DataFrame as Table
from scipy.special import ndtri

from formulations.arrays import Array
from paper_figs.drawing import LEGEND_PT, Look, legend, page, probability_axis

FRONTIER = {
    "uniform, paper polytopes": ("s-", "tab:red"),
    "uniform, facets settled": ("v-", "tab:brown"),
    "uniform, tangent spheres": ("^-", "tab:orange"),
    "exact, each node": ("o-", "tab:blue"),
    "exact, whole flights": ("D-", "tab:green"),
    "certified, each node": ("o:", "tab:blue"),
    "certified, whole flights": ("D:", "tab:green"),
}
OPEN = "open loop"
FEEDBACK = {
    OPEN: ("s-", "tab:red"),
    "feedback": ("o-", "tab:blue"),
    "feedback, lead 1 h": ("o:", "tab:cyan"),
    "targeting gain": ("^--", "tab:orange"),
    "targeting gain, lead 1 h": ("v:", "tab:brown"),
    "feedback, limited at the end": ("D-", "tab:green"),
}
ROOM_MM_S = 1.0
"""Margin about all costs but the open loop's, beside which the others would look the same."""
POLICIES = {
    "open": ("s-", "tab:red", "as planned"),
    "feedback": ("o-", "tab:blue", "corrected by gains"),
    "replan": ("D-", "tab:green", "planned again"),
}
QUANTITIES = {
    "whole_flight": (100.0, "whole flights that hold (%)"),
    "dv99_m_s": (1e3, "delta-v, 99 % (mm/s)"),
    "final_sigma_m": (1.0, "final dispersion (m)"),
}
"""Factor and name of each column of the policies."""
POSITION_M = 10.0
"""Error of the usual measurement, of which `scale` gives multiples, m."""
LEAST = 1e-9
"""Smallest error shown, less than the difference between two solvers."""
COLOURS = {"scvx": "C0", "ptr": "C1", "scvx-star": "C2", "hard": "C3", "elastic": "C4"}
MARKERS = {"CLARABEL": "o", "ECOS": "s", "QOCO": "^", "SCS": "D", "IPOPT": "*", "UNO": "P"}
OTHER = "X"
PROFILED = {"scenarios": "P2 from one P3 solution", "random": "random scenarios, cold"}
"""Groups of problems with performance profiles, and their titles."""
COLOURS_MAX = 10
"""Number of colours; methods beyond it have them again, dashed."""
SAME = 1e-4
"""Relative difference of total delta-v within which two ends are the same optimum."""


def frontier(tables: list[Table]) -> Figure:
    """Delta-v, what certifying adds to it and the time observed, on the normal quantile scale."""
    (rows,) = tables
    few = (0.55, 0.8, 0.95, 0.99, 0.999)
    with page(4.2) as figure:
        panels = figure.subplot_mosaic(
            [["dv", "more"], ["dv", "observed"]], width_ratios=(1.6, 1.0)
        )
        for kind, (mark, colour) in FRONTIER.items():
            own = rows[rows.kind == kind]
            required, more, dv = ndtri(own.asked), own.certifying_dv_m_s, own.total_dv_m_s
            panels["dv"].plot(required, dv, mark, color=colour, ms=4, label=kind)
            panels["observed"].plot(required, own.observed_mean_s, mark, color=colour, ms=3)
            if np.isfinite(more).any():
                panels["more"].plot(required, 100.0 * more / (dv - more), mark, color=colour, ms=3)
        probability_axis(
            panels["dv"], (0.55, 0.7, 0.8, 0.9, 0.95, 0.99, 0.999), "required probability (-)"
        )
        probability_axis(panels["more"], few, "")
        probability_axis(panels["observed"], few, "required probability (-)")
        panels["dv"].set_ylabel("delta-v (m/s)")
        panels["more"].set_ylabel("certifying adds (%)")
        panels["observed"].set_ylabel("mean time observed (s)")
        legend(figure, 3)
    return figure


def feedback(tables: list[Table]) -> Figure:
    """Delta-v's 99 % and the final dispersion by probability; the program's delta-v by error."""
    rows, errors = tables
    with page(4.4) as figure:
        panels = figure.subplot_mosaic([["dv", "end"], ["dv", "errors"]], width_ratios=(1.4, 1.0))
        for kind, (mark, colour) in FEEDBACK.items():
            own = rows[rows.kind == kind]
            p, cost = _cheapest(own, "asked", "dv99_m_s")
            panels["dv"].plot(ndtri(p), 1e3 * cost, mark, color=colour, ms=4, label=kind)
            p, sigma = _cheapest(own, "asked", "final_sigma_m")
            panels["end"].plot(ndtri(p), sigma, mark, color=colour, ms=3)
        of_flights = errors[(errors.scope == "flight") & (errors.kind == "feedback")]
        groups = of_flights.groupby("asked", sort=False)
        for (asked, own), look in zip(groups, ("o-", "o--"), strict=False):
            scale, cost = _cheapest(own, "scale", "program_m_s")
            look, label = f"k{look}", f"program, for {asked}"
            panels["errors"].semilogx(POSITION_M * scale, 1e3 * cost, look, ms=3, label=label)
        words = "required probability of whole flights (-)"
        probability_axis(panels["dv"], (0.7, 0.9, 0.95, 0.99, 0.997, 0.999), words)
        probability_axis(panels["end"], (0.7, 0.9, 0.99, 0.999), words)
        panels["dv"].set_ylabel("99 % quantile of delta-v (mm/s)")
        costs = 1e3 * rows[rows.kind != OPEN].dv99_m_s.dropna()
        if len(costs):  # which a run that was stopped need not have
            panels["dv"].set_ylim(costs.min() - ROOM_MM_S, costs.max() + ROOM_MM_S)
        panels["end"].set_ylabel("final dispersion (m)")
        panels["errors"].set(xlabel="error of the measured position (m)", ylabel="delta-v (mm/s)")
        legend(figure, 3)
    return figure


def _cheapest(rows: Table, x: str, y: str) -> tuple[Array, Array]:
    """Two columns of the rows that have figures, the cheapest of several, by the first."""
    own = rows.dropna(subset=[y]).sort_values("dv99_m_s").drop_duplicates(x).sort_values(x)
    return own[x].to_numpy(), own[y].to_numpy()


def policies(tables: list[Table]) -> Figure:
    """Probability, delta-v and dispersion: above over the probability, below over the error."""
    (rows,) = tables
    flown = rows.dropna(subset=["dv99_m_s"])
    usual, others = flown[flown.scale == 1.0], flown[flown.scale != 1.0]
    at = others.asked.iloc[0]
    over_error, ticks = flown[flown.asked == at], sorted(usual.asked.unique())
    with page(4.6) as figure:
        panels = figure.subplots(2, 3)
        for (above, below), (name, (factor, words)) in zip(
            panels.T, QUANTITIES.items(), strict=True
        ):
            for policy, (mark, colour, label) in POLICIES.items():
                look: Look = {"fmt": mark, "color": colour, "label": label}
                own = usual[usual.policy == policy].sort_values("asked")
                _bars(above, ndtri(own.asked), factor * own.filter(like=name), name, look)
                own = over_error[over_error.policy == policy].sort_values("scale")
                if policy == "open":
                    below.axhline(factor * own[name].iloc[0], color=colour, lw=1.0)
                else:
                    _bars(below, POSITION_M * own.scale, factor * own.filter(like=name), name, look)
            probability_axis(above, ticks, "required probability (-)", fontsize=6)
            above.set_ylabel(words)
            below.set(xlabel=f"measured to (m), for {at}", ylabel=words, xscale="log")
        legend(figure, 3)
    return figure


def _bars(axes: Axes, x: Any, rows: Table, name: str, look: dict[str, str]) -> None:
    """Draw a figure with its intervals."""
    y = rows[name]
    ends = (y - rows[f"{name}_low"], rows[f"{name}_high"] - y)
    style: Look = {"ms": 3, "lw": 1.0, "capsize": 2, **look}
    axes.errorbar(x, y, ends, **style)


def map_sample(tables: list[Table]) -> Figure:
    """Two maps by longitude and latitude, in the colour of the delta-v's 99 %."""
    (rows,) = tables
    alone, gained = rows.open.eq(True), rows.corrected.eq(True)
    costs = rows.dv99_m_s[gained]
    look: Look = {"vmin": costs.min(), "vmax": costs.max()} if len(costs) else {}
    look |= {"cmap": "viridis", "s": 30, "edgecolors": "0.2", "linewidths": 0.4, "zorder": 3}
    with page(3.2) as figure:
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        for axes, more, said in (
            (panels[0], alone & False, "open loop"),
            (panels[1], gained & ~alone, "with feedback"),
        ):
            for which, mark, label in (
                (alone, "o", "planned open loop"),
                (more, "D", "planned with feedback alone"),
            ):
                at, cost = _where(rows[which]), rows.dv99_m_s[which]
                points = axes.scatter(*at, c=cost, marker=mark, label=label, **look)
            none = ~(alone | more)
            axes.plot(*_where(rows[none]), "x", color="0.45", ms=4, label="no plan")
            count = f"{said}: {len(rows) - none.sum()} of {len(rows)} sites"
            axes.set_title(count, fontsize="medium")
            axes.set(xlim=(0, 360), ylim=(-90, 90), xlabel="east longitude (deg)")
            axes.set_xticks(range(0, 361, 90))
            axes.set_yticks(range(-90, 91, 30))
        panels[0].set_ylabel("latitude (deg)")
        figure.colorbar(points, ax=panels, label="99 % quantile of delta-v (m/s)", pad=0.01)
        legend(figure, 3)
    return figure


def _where(rows: Table) -> tuple[Any, Any]:
    """East longitudes from 0 to 360 and latitudes, deg."""
    return rows["site.longitude_deg"] % 360.0, rows["site.latitude_deg"]


def accuracy(tables: list[Table]) -> Figure:
    """Error over processor seconds, a panel a problem; a mark is an iteration, a full one the end."""
    (rows,) = tables
    problems, methods = list(rows.problem.unique()), list(rows.method.unique())
    with page(3.2) as figure:
        panels = figure.subplots(1, len(problems), sharey=True, squeeze=False)[0]
        for axes, problem in zip(panels, problems, strict=True):
            for number, method in enumerate(methods):
                own = rows[(rows.problem == problem) & (rows.method == method)]
                seconds, errors = own.processor_s, own.error.clip(lower=LEAST)
                look: Look = {"color": f"C{number}", "marker": "P" if "IPOPT" in method else "o"}
                axes.plot(seconds, errors, ms=3, mfc="none", lw=1.0, label=method, **look)
                axes.plot(seconds[-1:], errors[-1:], ms=5, **look)
            axes.set(xscale="log", yscale="log", title=problem)
            axes.xaxis.set_major_formatter("{x:g}")
        panels[0].set_ylabel("merit over the least, less one (-)")
        figure.supxlabel("seconds of the processor from the solution of P3", fontsize="medium")
        legend(figure, 3)
    return figure


def solver_comparison(tables: list[Table]) -> dict[str, Figure]:
    """The figures of the groups of runs in the table, by name."""
    (rows,) = tables
    figures: dict[str, tuple[str, Callable[[Table], Figure]]] = {
        "comparison_times": ("matrix", comparison_times),
        "comparison_profiles": ("scenarios", comparison_profiles),
    }
    groups = {*rows.group}
    return {name: draw(rows) for name, (group, draw) in figures.items() if group in groups}


def _solved(rows: Table) -> Any:
    """Whether P2 converged, by row."""
    return (rows.status == "converged") & (rows.problem == "P2")


def comparison_times(rows: Table) -> Figure:
    """Processor time from the straight line to the end of P2 of the default scenario."""
    rows = rows.assign(solved=_solved(rows))
    cold = (rows.group == "matrix") & (rows.start == "cold") & (rows.scenario == "recon_b")
    chosen = rows[cold]
    forms = list(chosen.formulation.unique())
    with page(0.55 * len(forms) + 1.6) as figure:
        axes = figure.subplots()
        for row in chosen.itertuples():
            beside = 0.14 * (1 - list(COLOURS).index(row.algorithm) % 3)
            y = len(forms) - 1 - forms.index(row.formulation) + beside
            colour = COLOURS[row.algorithm]
            look: Look = {"color": colour, "mfc": colour if row.solved else "none", "ms": 6}
            axes.plot(row.cpu_s, y, MARKERS.get(row.solver, OTHER), **look)
        axes.set(xscale="log", xlabel="seconds of the processor from the straight line, P3 and P2")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set_yticks(range(len(forms)), forms[::-1])
        for name in chosen.algorithm.unique():
            axes.plot([], [], "o", color=COLOURS[name], label=name)
        for name in chosen.solver.unique():
            axes.plot([], [], MARKERS.get(name, OTHER), color="0.3", label=name)
        axes.plot([], [], "o", color="0.3", mfc="none", label="not solved")
        axes.legend(fontsize=LEGEND_PT, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def comparison_profiles(rows: Table) -> Figure:
    """Share of the problems that a method solves within a multiple of the least processor time."""
    groups = [group for group in PROFILED if group in {*rows.group}]
    methods = list(rows[rows.group.isin(groups)].method.unique())
    with page(3.4) as figure:
        panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
        for axes, group in zip(panels, groups, strict=True):
            for method, (ratios, share) in profiles(rows[rows.group == group]).items():
                number = methods.index(method)
                look = "--" if number >= COLOURS_MAX else "-"
                axes.step(ratios, share, look, where="post", color=f"C{number}", label=method)
            axes.set(xscale="log", ylim=(0.0, 1.02), title=PROFILED[group])
            axes.xaxis.set_major_formatter("{x:g}")
        panels[0].set_ylabel("share solved")
        figure.supxlabel("processor time over the least of all methods", fontsize="medium")
        legend(figure, 3)
    return figure


def profiles(rows: Table) -> dict[str, tuple[Array, Array]]:
    """Ratios to the least time, and shares solved within them, of methods that got every problem."""
    solved = rows[_solved(rows)]
    best = solved.groupby("scenario").total_dv_m_s.transform("min")
    ended = solved[solved.total_dv_m_s <= (1 + SAME) * best]
    least = ended.groupby("scenario").cpu_s.min()
    ratios = (ended.cpu_s / ended.scenario.map(least)).groupby(ended.method)
    found = {}
    for method, own in rows.groupby("method", sort=False):
        if {*own.scenario} >= {*least.index}:
            within = ratios.get_group(method) if method in ratios.groups else pd.Series(dtype=float)
            found[method] = np.sort(within), np.arange(1, len(within) + 1) / len(least)
    return found
