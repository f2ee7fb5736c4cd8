"""Draw the chart of lighting windows."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from scp_recon.mission.schedule import LitWindow, Survey
from scp_recon.results.pictures import HOUR_S, legend, page, picture, plain
from scp_recon.scenario.schema import Scenario

ROWS_MAX = 12
"""Windows that are drawn: more rows cannot be read."""
BURN_COLOURS = ("C0", "C4", "C2", "C1", "C3", "C5")


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
