"""Write pictures with Matplotlib: style, formats, legends; draw windows, designs and primers.

It needs the extra [report]. The figures of `paper_figs` use this module.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import numpy as np
from cycler import cycler
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from scp_recon.display import COLOURS, mm_s
from scp_recon.mission.schedule import LitWindow, Survey
from scp_recon.passes.design import Trial
from scp_recon.passes.timing import PassResult
from scp_recon.planning.primer import PrimerHistory
from scp_recon.scenario.schema import Scenario

WIDTH_IN = 7.0
"""Width of a figure across the page."""

HOUR_S = 3600.0
ROWS_MAX = 12
"""Windows that are drawn: more rows cannot be read."""
COLOURS_NAMED = 6
BURN_COLOURS = ("C0", "C4", "C2", "C1", "C3", "C5")
STYLE = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.prop_cycle": cycler(color=COLOURS),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 9,
    "date.converter": "concise",
    "font.size": 9,
    "grid.color": "0.92",
    "hatch.linewidth": 0.6,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "savefig.dpi": 200,
    "svg.hashsalt": "scp_recon",
}
"""Settings of all pictures; C0 to C5 are blue, vermilion, green, purple, orange and sky blue."""


@contextmanager
def page(height_in: float, width_in: float = WIDTH_IN) -> Iterator[Figure]:
    """Yield an empty figure in the common style, with room for its labels; draw within the context."""
    with rc_context(STYLE):
        yield Figure(figsize=(width_in, height_in), layout="constrained")


def plain(text: str) -> str:
    """A name escaped so that Matplotlib finds no formula in it."""
    return text.replace("$", r"\$")


def legend(figure: Figure, ncols: int, loc: str = "outside upper center", **look: Any) -> None:
    """Add one legend for all panels, each label once, beside the panels."""
    named = {
        label: handle
        for axes in figure.axes
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(list(named.values()), list(named), loc=loc, ncols=ncols, **look)


def endings() -> list[str]:
    """The file endings of picture formats, with their dots."""
    return [f".{name}" for name in Figure().canvas.get_supported_filetypes()]


def picture(
    figure: Figure, ending: str = ".png", *, plan_hash: str | None = None, dpi: float | None = None
) -> bytes:
    """A figure in the format of a file ending, with its dot; the same bytes every time.

    A plan's hash is kept in the metadata of PNG, PDF and SVG. Dots per inch are by default the
    figure's or the style's.
    """
    ending, plan = ending.lower(), f"plan {plan_hash}" if plan_hash else None
    metadata: dict[str, dict[str, str | None]] = {
        ".png": {"Description": plan} if plan else {},
        ".pdf": {"Keywords": plan, "CreationDate": None},
        ".svg": {"Description": plan, "Date": None},
    }
    rendered = BytesIO()
    with rc_context(STYLE):
        figure.savefig(rendered, format=ending[1:], metadata=metadata.get(ending), dpi=dpi)
    return rendered.getvalue()


def draw_windows(scenario: Scenario, survey: Survey, ending: str) -> bytes:
    """A picture of the first windows: incidence over time, and a row of legal burn times for each.

    Args:
        scenario: of the windows.
        survey: the windows found.
        ending: of the file, which is the format, one of `pictures.endings`.
    """
    shown, count = survey.windows[:ROWS_MAX], len(survey.windows)
    heights = [2.4, 0.8 + 0.34 * max(1, len(shown))]
    with page(3.4 + 0.34 * len(shown)) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=heights)
        some = "" if len(shown) == count else f", first {ROWS_MAX} of them"
        names = f"{plain(scenario.body.name)}, {plain(scenario.site.name)}"
        figure.suptitle(f"{names}: {count} lighting windows{some}")
        _incidence(above, scenario, survey, shown)
        _rows(below, shown)
        below.set_xlabel(f"hours past {scenario.epoch.tdb.isoformat(timespec='seconds')} TDB")
        legend(figure, 7, "outside lower center")
        return picture(figure, ending)


def _incidence(
    axes: Axes, scenario: Scenario, survey: Survey, shown: tuple[LitWindow, ...]
) -> None:
    first, last = survey.span_s
    if len(shown) < len(survey.windows):
        last = shown[-1].edges_s[1] + 0.5 * (shown[-1].edges_s[1] - shown[0].edges_s[0]) / ROWS_MAX
    times = np.linspace(first, last, 4000)
    for window in shown:
        axes.axvspan(*(edge / HOUR_S for edge in window.edges_s), color="#fbf6c0", lw=0, zorder=0)
    axes.plot(times / HOUR_S, np.rad2deg(survey.lighting.incidence(times)), color="0.3", lw=1.2)
    rules = scenario.observation
    limit = rules.incidence_max_deg
    axes.axhline(limit, color="C1", lw=1.0, ls="--")
    axes.annotate(
        f"limit {limit:g} deg", (1.0, limit), xycoords=("axes fraction", "data"), color="C1",
        xytext=(-4, 3), textcoords="offset points", ha="right", fontsize=8,
    )  # fmt: skip
    axes.set(ylabel="incidence (deg)", ylim=(0.0, 180.0), yticks=range(0, 181, 30))
    axes.set_title(
        f"windows (shaded): incidence at most {limit:g} deg, local solar time "
        f"{rules.local_solar_time_min_h:g} to {rules.local_solar_time_max_h:g} h",
    )


def _rows(axes: Axes, shown: tuple[LitWindow, ...]) -> None:
    """One row for each window: a thin bar for each burn, one below the other, and the window."""
    count = len(shown[0].burns_s) if shown else 0
    thick, times = 0.8 / max(1, count), list[float]()
    for row, window in enumerate(shown):
        first, last = (edge / HOUR_S for edge in window.edges_s)
        axes.barh(row, last - first, 0.8, first, color="0.15", label="window")
        for i, interval in enumerate(window.burns_s):
            early, late = (edge / HOUR_S for edge in interval)
            label = f"burn {i + 1}" + (" = epoch" if i == 0 else "")
            place, colour = row - 0.4 + (i + 0.5) * thick, BURN_COLOURS[i % len(BURN_COLOURS)]
            # An instant is seen too; where no time is legal nothing is.
            width = max(late - early, 0.0) if early <= late else np.nan
            axes.barh(place, width, thick, early, color=colour, ec=colour, lw=1.0, label=label)
            times += [early, late]
    axes.set_yticks(range(len(shown)), [f"{k + 1}" for k in range(len(shown))])
    axes.set(ylabel="window", ylim=(len(shown) - 0.4, -0.6))
    axes.grid(visible=False, axis="y")
    if times:
        axes.set_xlim(min(times) - 1.0, max(times) + 1.0)
    axes.set_title("where each burn may be, for a flight that observes in that window")


def draw_design(tried: Sequence[Trial], found: PassResult) -> bytes:
    """Draw a PNG of delta-v over the phases of all plans; a star is at the cheapest pass."""
    with page(5.6) as figure:
        axes = figure.subplots()
        kept = [one for one in tried if one.result.converged and one.step != "certain"]
        costs = np.array([one.result.dv_m_s for one in kept])
        places = np.rad2deg([one.result.at.phases for one in kept]) % 360.0
        mapped = np.array([one.step == "map" for one in kept])
        colours = LogNorm(costs.min(), max(costs.max(), 1.01 * costs.min()))
        x, y = places[mapped].T
        squares = axes.scatter(x, y, c=costs[mapped], marker="s", s=420, norm=colours)
        x, y = places[~mapped].T
        axes.scatter(x, y, c=costs[~mapped], s=14, edgecolors="white", norm=colours)
        if found.converged:
            label = f"found: {mm_s(found.dv_m_s, 1)}"
            place = np.rad2deg(found.at.phases) % 360.0
            axes.plot(*place, "*", color="red", markeredgecolor="white", markersize=14, label=label)
            figure.legend(loc="outside upper center")
        bar = figure.colorbar(squares, label="delta-v (m/s); squares: without uncertainty")
        bar.minorticks_off()
        between = np.geomspace(costs.min(), costs.max(), COLOURS_NAMED)
        bar.set_ticks(between.tolist(), labels=[f"{cost:.2g}" for cost in between])
        axes.set(xlabel="phase of departure (deg)", ylabel="phase of arrival (deg)")
        edges, ticks = (-25.0, 380.0), np.arange(0.0, 361.0, 60.0)
        axes.set(xlim=edges, ylim=edges, xticks=ticks, yticks=ticks)
        return picture(figure)


def draw_primer(primer: PrimerHistory, burns_s: Sequence[float]) -> bytes:
    """Draw a PNG of a primer's size and allowed part over time, with legal times and times of burns."""
    with page(4.2) as figure:
        axes = figure.subplots()
        hours, legal = np.array(primer.t_s) / HOUR_S, np.array(primer.legal)
        sizes = np.linalg.norm(primer.vector, axis=1)
        top = 1.05 * max(1.0, *sizes)
        axes.fill_between(
            hours, 0.0, top, where=legal.tolist(), color="0.88", label="another burn is legal"
        )
        for time in burns_s:
            axes.axvline(time / HOUR_S, color="C1", lw=1.0, ls=":", label="burns of the plan")
        axes.axhline(1.0, color="black", lw=0.8)
        axes.plot(hours, sizes, color="C0", lw=1.0, ls="--", label="in any direction")
        axes.plot(hours, primer.allowed, color="C0", label="in directions off the battery's cones")
        axes.set(
            xlabel="time past the epoch (h)",
            ylabel="delta-v saved per delta-v of a small burn more",
        )
        axes.set(ylim=(0.0, top))
        axes.margins(x=0.01)
        legend(figure, 2)
        return picture(figure)
