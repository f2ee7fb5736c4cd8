"""Draw studies from their tables: probability, feedback, missed burns, solvers, maps, campaigns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pandas import DataFrame as Table
from pandas import to_datetime
from scipy.special import ndtri

from paper_figs.drawing import Look, probability_axis
from scp_recon.campaigns.axes import EPOCH, LATITUDE, LONGITUDE
from scp_recon.campaigns.outcome import (
    CHANCE,
    COST,
    FEASIBLE,
    NO_MISSION,
    CampaignResults,
    read_campaign,
)
from scp_recon.reports.pictures import legend, page

MARKS = "os^DvPX"


def styles(*names: str, **more: Any) -> dict[str, Look]:
    """A marker and a colour for each name, and more that all have."""
    marked = enumerate(zip(names, MARKS, strict=False))
    return {name: {"marker": mark, "color": f"C{i}"} | more for i, (name, mark) in marked}


FRONTIER: dict[str, Look] = {
    "uniform, paper polytopes": {"marker": "s", "color": "C1"},
    "uniform, facets settled": {"marker": "v", "color": "C4"},
    "uniform, tangent spheres": {"marker": "^", "color": "C3"},
    "exact, each node": {"marker": "o", "color": "C0", "ms": 7, "mfc": "none"},
    "exact, whole flights": {"marker": "D", "color": "C2", "ms": 3},
    "certified, each node": {"marker": "o", "color": "C0", "ms": 7, "mfc": "none", "ls": ":"},
    "certified, whole flights": {"marker": "D", "color": "C2", "ms": 3, "ls": ":"},
}
DRIFTS = styles("missed", "without", "cut short", ls="", ms=5)
PARAMETERS = {
    "body.gm": "GM",
    "body.j2": "J2",
    "body.pole": "pole",
    "body.prime": "phase, spin rate",
    "site": "site",
    "spacecraft": "reflectivity",
    "body.companion": "companion",
}
"""Beginnings of uncertain entries, with their names."""
NONE_INSIDE = 1e-4
"""Where no flight comes inside, of 4,000."""
LEFT_OF = 0.98
"""Probability above which words do not fit on the right of a curve's end."""
OPEN = "open loop"
FEEDBACK: dict[str, Look] = {
    OPEN: {"marker": "s", "color": "C1", "ms": 8, "mfc": "none"},
    "feedback": {"marker": "o", "color": "C0", "ms": 5, "mfc": "none"},
    "feedback, lead 1 h": {"marker": ".", "color": "C5", "ls": ":"},
}
"""Curves coincide where the open loop is as good: the larger markers are open."""
ROOM_MM_S = 1.0
"""Margin about all costs but the open loop's, beside which the others would look the same."""
POLICIES = {
    "open": ("s-", "C1", "as planned"),
    "feedback": ("o-", "C0", "corrected by gains"),
    "replan": ("D-", "C2", "planned again"),
}
QUANTITIES = {
    "whole_flight": (100.0, "flights within limits (%)"),
    "dv99_m_s": (1e3, "delta-v, 99 % (mm/s)"),
    "final_sigma_m": (1.0, "final dispersion (m)"),
}
"""Factor and name of each column of the policies."""
POSITION_M, UNMEASURED_M = 10.0, 1e4
"""Error of the usual measurement, of which `scale` gives multiples, and that which is as good as none,
m."""
SOLVERS = styles("CLARABEL", "IPOPT", "QOCO", "SCS", "ECOS", "UNO", ms=6)
WITHIN = {
    "solved": "a plan",
    "within_0_1_of_the_least": "within 10 % of the cheapest",
    "within_0_01_of_the_least": "within 1 %",
    "within_0_0001_of_the_least": "within 0.01 %",
}
"""Columns of the random scenarios, with their names."""


def frontier(tables: list[Table]) -> Figure:
    """Delta-v, what certifying adds to it and the time observed, on the normal quantile scale."""
    (rows,) = tables
    few = (0.55, 0.8, 0.95, 0.99, 0.999)
    with page(4.4) as figure:
        panels = figure.subplot_mosaic(
            [["dv", "more"], ["dv", "observed"]], width_ratios=(1.6, 1.0)
        )
        for kind, given in FRONTIER.items():
            own, look = rows[rows.kind == kind], {"ms": 4, **given}
            required, more, dv = ndtri(own.asked), own.certifying_dv_m_s, own.total_dv_m_s
            panels["dv"].plot(required, 1e3 * dv, label=kind, **look)
            panels["observed"].plot(required, own.observed_mean_s, **look)
            if np.isfinite(more).any():
                panels["more"].plot(required, 100.0 * more / (dv - more), **look)
            if dv.isna().iloc[-1]:
                _ends(panels["dv"], own.assign(x=required, y=1e3 * dv), look["color"])
        ticks = (0.55, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999)
        probability_axis(panels["dv"], ticks, "required probability (-)", rotation=60)
        probability_axis(panels["more"], few, "")
        probability_axis(panels["observed"], few, "required probability (-)")
        panels["dv"].set(ylabel="delta-v (mm/s)", ylim=(100.0, None))
        panels["more"].set(ylabel="certifying adds (%)", ylim=(-0.2, None))
        panels["observed"].set_ylabel("mean time observed (s)")
        legend(figure, 3)
    return figure


def missed_burns(tables: list[Table]) -> Figure:
    """Share of flights inside after the worst miss, and what it costs to survive the misses."""
    (rows,) = tables
    cases = list(dict.fromkeys(rows.case))
    with page(4.4) as figure:
        inside, more = figure.subplots(1, 2, sharey=True)
        for (drifts, look), shift in zip(DRIFTS.items(), (-0.2, 0.0, 0.2), strict=True):
            own = rows[rows.drifts == drifts].set_index("case").reindex(cases)
            height = np.arange(len(cases)) + shift
            inside.plot(np.maximum(1.0 - own.safe, NONE_INSIDE), height, **look, label=drifts)
            more.plot(own.more_percent, height, **look)
        inside.axvline(0.003, color="k", lw=1.0, ls="--")
        inside.set(xscale="log", xlabel="share of flights inside; none at the left edge")
        inside.set_yticks(range(len(cases)), cases)
        inside.invert_yaxis()
        more.set_xlabel("delta-v beyond the plan without (%)")
        legend(figure, 3)
    return figure


def knowledge(tables: list[Table]) -> Figure:
    """Share of flights lost to each uncertain parameter, and the price of plans that know of all."""
    alone, plans = tables
    cases, without = list(plans.case), plans.set_index("case").without
    with page(3.8) as figure:
        lost, price = figure.subplots(1, 2, sharey=True, width_ratios=(1.5, 1.0))
        for begins, look in styles(*PARAMETERS, ls="", ms=5, mfc="none").items():
            own = alone[alone.parameter.str.startswith(begins)]
            share = 100.0 * (without.loc[own.case].to_numpy() - own.kept)
            lost.plot(share, own.case.map(cases.index), label=PARAMETERS[begins], **look)
        for policy, look in styles("feedback", "open", ls="", ms=5, mfc="none").items():
            percent = plans[f"{policy}_percent"]
            label = OPEN if policy == "open" else policy
            price.plot(percent.clip(lower=0.0), range(len(cases)), label=label, **look)
            for at in np.flatnonzero(percent.isna()):
                height = at + (-0.17 if policy == "open" else 0.17)
                price.text(0.0, height, f"{label}: no plan", va="center", fontsize=7)
        lost.set_yticks(range(len(cases)), cases)
        lost.invert_yaxis()
        lost.set_xlabel("flights lost to one parameter (%)")
        price.set_xlabel("price of all (%)")
        price.set_xscale("symlog", linthresh=1.0)
        price.set_xlim(-0.3, 200.0)
        price.xaxis.set_major_formatter("{x:g}")
        legend(figure, 5)
    return figure


def _ends(axes: Axes, rows: Table, colour: str) -> None:
    """Say where a curve ends from which probability on there is no plan."""
    end, beyond = rows[rows.y.notna()].iloc[-1], rows[rows.y.isna()].asked.iloc[0]
    look: Look = {"color": colour, "fontsize": 8, "textcoords": "offset points"}
    if end.asked > LEFT_OF:
        text, away, look["ha"] = f"no plan\nfrom {beyond}", (-6.0, 4.0), "right"
    else:
        text, away = f"no plan from {beyond}", (6.0, 0.0)
    axes.annotate(text, (end.x, end.y), away, **look)


def feedback(tables: list[Table]) -> Figure:
    """Delta-v's 99 % and the final dispersion by probability; the program's delta-v by error."""
    rows, errors = tables
    with page(4.6) as figure:
        panels = figure.subplot_mosaic([["dv", "end"], ["dv", "errors"]], width_ratios=(1.4, 1.0))
        for kind, given in FEEDBACK.items():
            own, look = rows[rows.kind == kind], {"ms": 4, **given}
            panels["dv"].plot(ndtri(own.asked), 1e3 * own.dv99_m_s, label=kind, **look)
            panels["end"].plot(ndtri(own.asked), own.final_sigma_m, **look)
        of_flights = errors[(errors.scope == "flight") & (errors.kind == "feedback")]
        groups = of_flights.groupby("asked", sort=False)
        for (asked, own), dash in zip(groups, ("o-", "o--"), strict=False):
            own = own.sort_values("scale")
            error, cost = np.minimum(POSITION_M * own.scale, UNMEASURED_M), 1e3 * own.program_m_s
            panels["errors"].semilogx(error, cost, f"k{dash}", ms=3)
            said: Look = {"xytext": (0, -11), "textcoords": "offset points"}
            panels["errors"].annotate(f"required {asked}", (1.0, cost.iloc[0]), **said)
        words = "required probability of whole flights (-)"
        probability_axis(panels["dv"], (0.7, 0.9, 0.95, 0.99, 0.997, 0.999), words)
        probability_axis(panels["end"], (0.7, 0.9, 0.99, 0.999), words)
        panels["dv"].set_ylabel("99 % quantile of delta-v (mm/s)")
        costs = 1e3 * rows[rows.kind != OPEN].dv99_m_s.dropna()
        if len(costs):  # which a run that was stopped need not have
            panels["dv"].set_ylim(costs.min() - ROOM_MM_S, costs.max() + ROOM_MM_S)
            _dearer(panels["dv"], rows[rows.kind == OPEN])
        panels["end"].margins(y=0.1)
        panels["end"].set(ylabel="final dispersion (m)", ylim=(0.0, None))
        panels["errors"].set(xlabel="error of the measured position (m)", ylabel="delta-v (mm/s)")
        panels["errors"].set_xticks([1.0, 10.0, 100.0, 1e3, UNMEASURED_M],
                                    ["1", "10", "100", "1000", "not\nmeasured"])  # fmt: skip
        panels["errors"].margins(y=0.2)
        legend(figure, 3)
    return figure


def _dearer(axes: Axes, rows: Table) -> None:
    """Give the values of a curve above the axes, where it leaves them."""
    above = rows[1e3 * rows.dv99_m_s > axes.get_ylim()[1]]
    if len(above):
        words = "\n".join(f"{1e3 * row.dv99_m_s:.0f} for {row.asked}" for row in above.itertuples())
        x = 0.5 * ndtri(above.asked.iloc[0]) + 0.5 * ndtri(rows.asked[above.index[0] - 1])
        axes.annotate(
            f"\u2191 {OPEN}:\n{words}", (x, 1.0), (-9, -2), va="top", ha="right", color="C1",
            xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=8,
        )  # fmt: skip


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
                own = usual[usual.policy == policy].sort_values("asked")
                look: Look = {"fmt": mark, "color": colour}
                look["label"] = f"{label} ({own.flights.max():,} flights)"
                _bars(above, ndtri(own.asked), factor * own.filter(like=name), name, look)
                own = over_error[over_error.policy == policy].sort_values("scale")
                if policy == "open":
                    below.axhline(factor * own[name].iloc[0], color=colour, lw=1.0)
                else:
                    _bars(below, POSITION_M * own.scale, factor * own.filter(like=name), name, look)
            probability_axis(above, ticks, "required probability (-)")
            above.set_ylabel(words)
            below.set(xlabel=f"measured to (m), for {at}", ylabel=words, xscale="log")
            below.xaxis.set_major_formatter("{x:g}")
            if name == "final_sigma_m":
                above.set_ylim(0.0, None)
                below.set_ylim(0.0, None)
        legend(figure, 3)
    return figure


def _bars(axes: Axes, x: Any, rows: Table, name: str, look: dict[str, str]) -> None:
    """Draw a figure, with its intervals where they are known."""
    y, low, high = rows[name], rows.get(f"{name}_low"), rows.get(f"{name}_high")
    style: Look = {"ms": 3, "lw": 1.0, "capsize": 2, **look}
    axes.errorbar(x, y, None if low is None else (y - low, high - y), **style)


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
            axes.plot(*_where(rows[none]), "x", color="0.45", ms=4, label="no plan", clip_on=False)
            count = f"{said}: {len(rows) - none.sum()} of {len(rows)} sites"
            axes.set_title(count, fontsize="medium")
            axes.set_xlabel("east longitude (deg)")
            _map_axes(axes, 90)
        panels[0].set_ylabel("latitude (deg)")
        figure.colorbar(points, ax=panels, label="99 % quantile of delta-v (m/s)", pad=0.01)
        legend(figure, 3)
    return figure


def _where(rows: Table) -> tuple[Any, Any]:
    """East longitudes from 0 to 360 and latitudes, deg."""
    return rows[LONGITUDE] % 360.0, rows[LATITUDE]


def _map_axes(axes: Axes, step_deg: int) -> None:
    axes.set(xlim=(0, 360), ylim=(-90, 90))
    axes.set_xticks(range(0, 361, step_deg))
    axes.set_yticks(range(-90, 91, 30))


def solver_comparison(tables: list[Table]) -> dict[str, Figure]:
    """The figures of the comparison of solvers, by name."""
    methods, drawn = tables
    return {
        "comparison_times": comparison_times(methods),
        "comparison_random": comparison_random(drawn),
    }


def comparison_times(rows: Table) -> Figure:
    """Processor time from the straight line to the end of P2 of the default scenario."""
    own = rows[(rows.problem == "recon_b") & (rows.start == "cold")]
    words = own.method.str.split("/", expand=True)
    lines = list(dict.fromkeys(words[0] + ", " + words[1]))
    with page(0.22 * len(lines) + 1.4) as figure:
        axes = figure.subplots()
        for row, (form, algorithm, solver) in zip(own.itertuples(), words.values, strict=True):
            hollow = {} if row.status.startswith("converged") else {"mfc": "none"}
            place = lines.index(f"{form}, {algorithm}")
            axes.plot(row.processor_s, place, **SOLVERS[solver] | hollow)
        for name, look in SOLVERS.items():
            axes.plot([], [], ls="", label=name, **look)
        axes.plot([], [], "o", color="0.4", mfc="none", label="no plan")
        axes.set(xscale="log", xlabel="processor time from the straight line, P3 and P2 (s)")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set_yticks(range(len(lines)), lines)
        axes.invert_yaxis()
        legend(figure, 4)
    return figure


def comparison_random(rows: Table) -> Figure:
    """How many random scenarios each method solves, how near the cheapest plan, and how fast."""
    places, most = range(len(rows)), rows.solved_by_any.max()
    with page(0.24 * len(rows) + 1.3) as figure:
        left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.5, 1.0))
        for column, look in styles(*WITHIN, ls="", ms=6, mfc="none").items():
            left.plot(rows[column], places, label=WITHIN[column], **look)
        left.axvline(most, color="0.4", ls="--", lw=1.0, label="solved by any method")
        right.plot(rows.median_processor_s_of_the_solved, places, "ko", ms=5)
        left.set(xlabel=f"random scenarios, of {rows.scenarios.max()}", xlim=(0, None))
        right.set(xscale="log", xlabel="median processor time (s)")
        right.xaxis.set_major_formatter("{x:g}")
        left.set_yticks(places, rows.method)
        left.invert_yaxis()
        legend(figure, 3)
    return figure


# --- campaigns of `experiments maps` ---

CAMPAIGNS = {
    "studies_map": "reconnaissance_map",
    "gallery/ryugu_map": "ryugu_map",
    "studies_errors": "errors",
    "studies_year": "asteroid_year",
    "studies_sizes": "sizes",
}
"""Folder of each picture's campaign."""
MEASURES = ((COST, 1e3, "delta-v (mm/s)"), (CHANCE, 1.0, "lowest probability (-)"))
"""Columns, with their factors and names."""
BURN, INITIAL = "uncertainty.execution_error", "uncertainty.initial_sigma_fraction"
LARGEST, LEAST = "burns.dv_max_m_s", "safety.radius_min_m"
INITIALS_SHOWN = 3
"""Largest initial errors with a curve of their own; below them delta-v hardly changes."""


def read_campaigns(folder: Path) -> dict[str, CampaignResults]:
    """The campaigns in a folder, those that have run, by the pictures' names.

    Raises:
        InputError: if results are unusable.
    """
    found = {name: folder / one for name, one in CAMPAIGNS.items()}
    return {name: read_campaign(place) for name, place in found.items() if place.is_dir()}


def campaigns(found: dict[str, CampaignResults]) -> dict[str, Figure]:
    """The pictures by name."""
    drawn = {"studies_errors": errors, "studies_year": year, "studies_sizes": sizes}
    return {name: drawn.get(name, sites)(results) for name, results in found.items()}


def sites(results: CampaignResults) -> Figure:
    """Delta-v and lowest probability of each site by longitude and latitude."""
    results = results.by_site
    good, table = results.ending(FEASIBLE), results.table
    none = results.ending(NO_MISSION)
    others = table.drop(index=good.index.union(none.index))
    with page(6.2) as figure:
        panels = figure.subplots(2, 1, sharex=True, sharey=True)
        for axes, (column, factor, words) in zip(panels, MEASURES, strict=True):
            look: Look = {"s": 36, "edgecolors": "0.2", "linewidths": 0.4, "cmap": "viridis"}
            label = f"plan verified: {len(good)}"
            points = axes.scatter(*_where(good), c=factor * good[column], label=label, **look)
            axes.plot(*_where(others), "x", color="0.3", ms=5, label=f"no plan: {len(others)}")
            axes.plot(
                *_where(none), "+", color="C1", ms=6, label=f"no lighting window: {len(none)}"
            )
            axes.set_ylabel("latitude (deg)")
            _map_axes(axes, 60)
            figure.colorbar(points, ax=axes, label=words, pad=0.01)
        panels[-1].set_xlabel("east longitude (deg)")
        legend(figure, 3)
    return figure


def errors(results: CampaignResults) -> Figure:
    """Curves over the execution error, of the smallest and the largest initial errors."""
    good, every = results.ending(FEASIBLE), sorted(results.table[BURN].unique())
    initial = sorted(results.table[INITIAL].unique())
    with page(4.6) as figure:
        panels = figure.subplots(2, 1, sharex=True)
        for mark, size in zip(MARKS, [initial[0], *initial[-INITIALS_SHOWN:]], strict=False):
            own = good[good[INITIAL] == size].sort_values(BURN)
            label = f"initial error {100.0 * size:.2g} %"
            _curves(panels, 100.0 * own[BURN], own, {"marker": mark, "label": label})
        panels[-1].set(xscale="log", xlabel="execution error, 1 sigma (% of the burn, logarithmic)")
        panels[-1].set_xticks([100.0 * x for x in every], [f"{100.0 * x:.2g}" for x in every])
        panels[-1].minorticks_off()
        _no_plan(panels, [100.0 * x for x in every if x not in set(good[BURN])])
        legend(figure, 4)
    return figure


def year(results: CampaignResults) -> Figure:
    """Curves over the epoch; delta-v from zero, as it hardly changes."""
    good = results.ending(FEASIBLE).sort_values(EPOCH)
    with page(4.0) as figure:
        panels = figure.subplots(2, 1, sharex=True)
        _curves(panels, to_datetime(good[EPOCH]), good, {"marker": "o", "ms": 4})
        panels[0].set_ylim(0.0, 1.1e3 * good[COST].max())
        panels[1].set_ylim(None, 1.005)
        panels[1].set_xlabel("epoch (TDB)")
    return figure


def sizes(results: CampaignResults) -> Figure:
    """Curves over the least radius, one for each largest burn, of the cheaper battery cone."""
    good = results.ending(FEASIBLE).sort_values(COST).drop_duplicates([LARGEST, LEAST])
    with page(4.4) as figure:
        panels = figure.subplots(2, 1, sharex=True)
        groups = good.sort_values(LEAST).groupby(LARGEST)
        for number, ((size, own), mark) in enumerate(zip(groups, MARKS, strict=False)):
            look: Look = {"ms": 9 - 3 * number, "ls": ("-", "--", ":")[number % 3]}
            label = f"largest burn {1e3 * size:g} mm/s"
            _curves(
                panels, own[LEAST], own, {"marker": mark, "mfc": "none", "label": label, **look}
            )
        panels[-1].set_xlabel("least distance allowed from the centre (m)")
        none = {*results.table[LEAST]} - {*good[LEAST]}
        panels[-1].set_xticks(sorted(results.table[LEAST].unique()))
        _no_plan(panels, sorted(none))
        legend(figure, 3)
    return figure


def _curves(panels: Any, x: Any, rows: Table, look: Look) -> None:
    """A curve of each measure."""
    for axes, (column, factor, words) in zip(panels, MEASURES, strict=True):
        axes.plot(x, factor * rows[column], **look)
        axes.set_ylabel(words)


def _no_plan(panels: list[Axes], places: list[float]) -> None:
    """Say where no curve has a verified plan."""
    for axes in panels:
        for x in places:
            axes.axvline(x, color="0.6", lw=1.0, ls=":")
            at: Look = {"xycoords": ("data", "axes fraction"), "rotation": 90, "fontsize": 8}
            axes.annotate("no verified plan", (x, 0.5), color="0.3", ha="right", va="center", **at)
            axes.margins(x=0.05)
