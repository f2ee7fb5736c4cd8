"""What the terminal shows of Monte Carlo flights."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from scp_recon.cli.tables import plain_table
from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.monte_carlo.summary import Interval, Spread, Summary, Terminal


def show_summary(console: Console, summary: Summary, asked: float | None = None) -> None:
    """The figures that matter, with their intervals.

    Args:
        console: to print to.
        summary: what to show.
        asked: probability of every joint constraint, if one was.
    """
    first, last = summary.window_s or (0.0, 0.0)
    window = f"window {last - first:.1f} s" if summary.window_s else "the window is over"
    console.print(
        f"{summary.samples} flights, truth {summary.truth}, errors {summary.errors}, "
        f"{100 * summary.confidence:.0f} % intervals; {window}",
        highlight=False,
    )
    if summary.held_s:
        console.print(_times_held(summary))
    console.print(_probabilities(summary, asked))
    for label, spread, digits in (
        ("all hold from", summary.entry_s, 0),
        ("all hold until", summary.exit_s, 0),
        ("closest approach m", summary.closest_m, 1),
        ("executed delta-v m/s", summary.executed_dv_m_s, 5),
    ):
        _show_spread(console, label, spread, digits)
    worst = _shown(summary.closest_m.worst, 1)
    console.print(f"closest approach, 0.3 % quantile: {worst} m", highlight=False)
    _show_terminal(console, summary.terminal)


def _times_held(summary: Summary) -> Table:
    table = plain_table(
        "time held, s", "mean", "worst 1 sigma", "worst 2 sigma", "probability of\nthroughout"
    )
    for name, held in summary.held_s.items():
        table.add_row(
            _label(name),
            *(_shown(x, 0, "\n") for x in (held.mean, held.worst_1_sigma, held.worst_2_sigma)),
            _shown(held.throughout, 4, "\n"),
        )
    return table


def _probabilities(summary: Summary, asked: float | None) -> Table:
    table = plain_table("joint constraint", "lowest probability", "at s", "asked")
    for name, lowest in summary.probability.items():
        limit = "" if asked is None or name == ALL else f"{asked:g}"
        table.add_row(_label(name), _shown(lowest, 4), f"{lowest.worst_t_s:.0f}", limit)
    if summary.whole_flight is not None:
        table.add_row("all limits, whole flight", _shown(summary.whole_flight, 4), "", "")
    return table


def _label(name: str) -> str:
    return "all at once" if name == ALL else name


def _show_spread(console: Console, label: str, spread: Spread, digits: int) -> None:
    """One line, and none without flights."""
    if spread.mean is None or spread.q05 is None or spread.q95 is None:
        return
    low, high = spread.q05.estimate.value, spread.q95.estimate.value
    console.print(
        f"{label:21} {_shown(spread.mean, digits)}; 90 % of flights {low:.{digits}f} to "
        f"{high:.{digits}f}",
        highlight=False,
    )


def _show_terminal(console: Console, terminal: Terminal) -> None:
    if not terminal.sigma_ratio:
        console.print("final state: no component spreads", highlight=False)
        return
    ratios = ", ".join(f"{name} {_shown(r, 3)}" for name, r in terminal.sigma_ratio.items())
    console.print(f"final state, J2000, sampled over predicted sigma: {ratios}", highlight=False)
    normal = ", ".join(f"{name} {test.p_value:.2g}" for name, test in terminal.normality.items())
    console.print(f"final state, J2000, p-value of normality: {normal}", highlight=False)


def _shown(interval: Interval, digits: int, gap: str = " ") -> str:
    """A value, and its interval if it has both ends."""
    value = f"{interval.estimate.value:.{digits}f}"
    if interval.low is None or interval.high is None:
        return value
    return f"{value}{gap}({interval.low:.{digits}f} to {interval.high:.{digits}f})"
