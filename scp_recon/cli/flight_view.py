"""Show the figures of many flights, and of one simulated flight."""

from __future__ import annotations

from rich.console import Console

from scp_recon.cli.rendering import terminal
from scp_recon.display import mm_s
from scp_recon.monte_carlo.summary import Statistics, Summary, Terminal
from scp_recon.reports.flight_tables import (
    corrected_burns_table,
    flown_probabilities_table,
    interval_cell,
    legs_table,
    observation_times_table,
    simulated_burns_table,
)
from scp_recon.results.table import SCALES
from scp_recon.simulation.record import Angles, FlightSummary

IN_MM_S = SCALES["m/s", "mm/s"]


def show_summary(console: Console, summary: Summary, required: float | None = None) -> None:
    """Show the main figures of many flights, with their intervals.

    Args:
        console: to print to.
        summary: what to show.
        required: required probability of every joint constraint; None without one.
    """
    first, last = summary.window_s or (0.0, 0.0)
    window = f"window {last - first:.1f} s" if summary.window_s else "the window is over"
    console.print(
        f"{summary.samples} flights, truth {summary.truth}, errors {summary.errors}, "
        f"policy {summary.policy}, planned with {summary.planned_gravity}, "
        f"flown with {summary.flown_gravity}, "
        f"{100 * summary.confidence:.0f} % intervals; {window}",
        highlight=False,
    )
    if summary.held_s:
        console.print(terminal(observation_times_table(summary)))
    lowest = flown_probabilities_table(summary, required)
    console.print(terminal(lowest))
    if lowest.note:
        console.print(lowest.note, highlight=False)
    if summary.commanded is not None:
        console.print(terminal(corrected_burns_table(summary.commanded, required)))
    for label, spread, digits, scale in (
        ("all hold from s", summary.entry_s, 0, 1.0),
        ("all hold until s", summary.exit_s, 0, 1.0),
        ("nearest the centre m", summary.closest_m, 1, 1.0),
        ("executed delta-v mm/s", summary.executed_dv_m_s, 2, IN_MM_S),
    ):
        _show_spread(console, label, spread, digits, scale)
    if summary.commanded is not None:
        mean, most = summary.commanded.mean_dv_m_s, summary.commanded.dv99_m_s
        console.print(
            f"commanded delta-v mm/s {interval_cell(mean, 2, scale=IN_MM_S).text}; "
            f"99 % of flights at most {interval_cell(most, 2, scale=IN_MM_S).text}",
            highlight=False,
        )
    worst = interval_cell(summary.closest_m.worst, 1).text
    console.print(f"closest approach to the centre, 0.3 % quantile: {worst} m", highlight=False)
    _show_terminal(console, summary.terminal)
    if summary.drift is not None:
        console.print(str(summary.drift), highlight=False)
        safe = summary.drift
        console.print(
            f"safe drifts, never within {safe.radius_m:g} m of the centre: {safe.value:.4f}, "
            f"{safe.low:.4f} to {safe.high:.4f}",
            highlight=False,
        )
    if summary.then is not None:
        console.print(str(summary.then), highlight=False)


def _show_spread(
    console: Console, label: str, spread: Statistics, digits: int, scale: float
) -> None:
    """One line, and none without flights."""
    if spread.mean is None or spread.q05 is None or spread.q95 is None:
        return
    low, high = scale * spread.q05.estimate.value, scale * spread.q95.estimate.value
    mean = interval_cell(spread.mean, digits, scale=scale).text
    console.print(
        f"{label:21} {mean}; 90 % of flights {low:.{digits}f} to {high:.{digits}f}",
        highlight=False,
    )


def _show_terminal(console: Console, terminal: Terminal) -> None:
    if not terminal.sigma_ratio:
        console.print("final state: no component spreads", highlight=False)
        return
    position = interval_cell(terminal.sigma_position_m, 2).text
    velocity = interval_cell(terminal.sigma_velocity_m_s, 2, scale=IN_MM_S).text
    console.print(f"final dispersion: {position} m, {velocity} mm/s", highlight=False)
    ratios = ", ".join(
        f"{name} {interval_cell(r, 3).text}" for name, r in terminal.sigma_ratio.items()
    )
    console.print(f"final state, J2000, sampled over predicted sigma: {ratios}", highlight=False)
    normal = ", ".join(f"{name} {test.p_value:.2g}" for name, test in terminal.normality.items())
    console.print(f"final state, J2000, p-value of normality: {normal}", highlight=False)


def show_flight(console: Console, summary: FlightSummary) -> None:
    """The figures of a simulated flight."""
    console.print(terminal(legs_table(summary)))
    console.print(terminal(simulated_burns_table(summary)))
    lines = [
        f"{name:22} {_spread(angles)} deg"
        for name, angles in (
            ("camera against command", summary.window_pointing_deg.camera),
            ("camera against site", summary.window_pointing_deg.site),
            ("estimated attitude", summary.estimate_deg),
        )
    ]
    miss = summary.terminal_miss
    lines += [
        f"least state of charge  {summary.least_charge:.3f} (floor {summary.floor_charge:.2f})",
        f"energy ledger error    {summary.ledger_error:.1e} of what is generated",
        f"momentum dumps         {summary.dumps}",
        f"final state            {miss.position_m:.1f} m and {mm_s(miss.velocity_m_s, 2)} "
        "from the planned mean",
        f"within 3 sigma         at {100 * summary.within_3_sigma:.1f} % of the nodes, "
        f"at most {summary.largest_sigma_distance:.2f} sigma",
    ]
    lines += [str(summary.drift)] if summary.drift else []
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _spread(angles: Angles) -> str:
    named = angles.model_dump(by_alias=True)
    return ", ".join(f"{key} {value:.3f}" for key, value in named.items())
