"""Build the tables of flights: many with errors, and one of the simulated spacecraft.

As those of `tables` they serve terminal and report, with the values of the files.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from scp_recon.monte_carlo.limits import ALL
from scp_recon.reports.tables import called, or_none
from scp_recon.results.table import Cell, Table, columns

if TYPE_CHECKING:
    from scp_recon.monte_carlo.summary import Commanded, Contingency, Interval, Summary
    from scp_recon.simulation.record import FlightSummary


def observation_times_table(summary: Summary) -> Table:
    """Time observed by flights, s, and the probability that a limit holds throughout."""
    return Table.of(
        "Observation times",
        columns(
            "time held", "mean (s)", "worst 1 sigma (s)", "worst 2 sigma (s)", "throughout (1)"
        ),
        (
            [
                called(name),
                *(
                    interval_cell(x, 1, "\n")
                    for x in (held.mean, held.worst_1_sigma, held.worst_2_sigma)
                ),
                interval_cell(held.throughout, 4, "\n"),
            ]
            for name, held in summary.held_s.items()
        ),
        key="flights",
        note=f"{summary.samples} flights, seed {summary.seed}, {summary.errors} errors, planned with "
        f"{summary.planned_gravity}, flown with "
        f"{summary.flown_gravity}, as in montecarlo.json.",
    )


def missed_burns_table(missed: Sequence[Summary]) -> Table:
    """Flights that miss a burn: their drifts, and the way home where it was planned."""
    return Table.of(
        "Flown with a missed burn, and then home",
        columns("what happens", "closest 99.7 % (m) .0f", "safe .4f", "impact .4f", "way home",
                "delta-v (mm/s) .3f", "burns at s", "flights home that keep every limit"),
        (
            [drift.event, drift.closest_m, drift.value, drift.impact, *_home(one.then)]
            for one in missed
            if (drift := one.drift) is not None
        ),
        key="missed_burns",
        note="From `scp-recon montecarlo --miss N --then return`: see montecarlo_miss_N.json.",
    )  # fmt: skip


def _home(then: Contingency | None) -> Sequence[object]:
    if then is None:
        return "not planned", None, "", None
    times = ", ".join(f"{time:.0f}" for time in then.burn_times_s)
    return then.status, then.total_dv_m_s, times, interval_cell(then.whole_flight, 4)


def flown_probabilities_table(summary: Summary, required: float | None) -> Table:
    """Lowest probabilities of the joint constraints and of whole flights, with their intervals."""
    rows: list[list[object]] = [
        [
            called(name),
            interval_cell(lowest, 4),
            lowest.worst_t_s,
            None if name == ALL else required,
            _counted(summary, narrowed=summary.is_narrowed(name)),
        ]
        for name, lowest in summary.probability.items()
    ]
    whole, counted = interval_cell(summary.whole_flight, 4), _counted(summary, narrowed=False)
    rows.append(["all limits, whole flight", whole, None, None, counted])
    heads = columns("joint constraint", "lowest probability", "at (s) .0f", "required g", "of")
    note = (
        "Rows of draws are of further flights, mostly of draws near a limit; within the intervals they "
        "differ from rows of flights."
    )
    return Table.of("Lowest probabilities", heads, rows, note=note if summary.strata else "")


def _counted(summary: Summary, *, narrowed: bool) -> str:
    """The flights that a probability is of."""
    own = summary.strata
    if own is None or not narrowed:
        return f"{summary.samples} flights"
    return f"{own.draws} draws, {own.flights} flown"


def corrected_burns_table(commanded: Commanded, required: float | None) -> Table:
    """How often each corrected burn keeps each limit on burns, with intervals; and failed replans."""
    again = any(burn.failed is not None for burn in commanded.burns)
    return Table.of(
        "Burns planned again, as commanded" if again else "Corrected burns as commanded",
        columns("burn", "cut-off (s) g", "limit", "probability that it holds", "required g",
                *(["failed replans"] if again else [])),
        (
            [
                *(str(burn.burn), burn.cut_off_s, name, interval_cell(kept, 4), required),
                *([str(burn.failed)] if again else []),
            ]
            for burn in commanded.burns
            for name, kept in burn.limits.items()
        ),
        key="corrected_burns",
    )  # fmt: skip


def interval_cell(interval: Interval, digits: int, gap: str = " ", scale: float = 1.0) -> Cell:
    """A value, with its interval if it has both ends; the text's unit may be another."""
    text = f"{scale * interval.estimate.value:.{digits}f}"
    if interval.low is not None and interval.high is not None:
        text += f"{gap}({scale * interval.low:.{digits}f} to {scale * interval.high:.{digits}f})"
    return Cell(text, interval.value)


def simulated_burns_table(summary: FlightSummary) -> Table:
    """Burns as planned and as the spacecraft's simulation executed them."""
    return Table.of(
        f"Burns in the simulation ({summary.vehicle}, seed {summary.seed})",
        columns("burn", "at (s) .0f", "planned (mm/s) .3f", "executed (mm/s) .3f",
                "off at start (deg) .3f", "off (deg) .3f"),
        (
            [
                str(number),
                burn.t_s,
                *or_none(
                    any(burn.planned_m_s),
                    *(float(np.linalg.norm(dv)) for dv in (burn.planned_m_s, burn.executed_m_s)),
                    burn.pointing_deg,
                    burn.executed_pointing_deg,
                ),
            ]
            for number, burn in enumerate(summary.burns, start=1)
        ),
        key="simulated_burns",
    )  # fmt: skip


def legs_table(summary: FlightSummary) -> Table:
    """Attitude modes as flown, with their failed requirements."""
    rows = []
    for leg in summary.legs:
        faults = ("" if leg.ok else " too short") + (
            "" if leg.settled_in_time else " not steady in time"
        )
        settled = "never" if leg.settled_s is None else leg.settled_s
        rows.append([leg.mode + faults, leg.start_s, leg.duration_s, leg.required_s, settled])
    times = (f"{name} (s) .0f" for name in ("from", "for", "at least", "steady after"))
    return Table.of("Attitude modes", columns("mode", *times), rows)


def simulated_table(summary: FlightSummary) -> Table:
    """Charge, pointing and final state in the spacecraft's simulation."""
    miss = summary.terminal_miss
    rows = (
        ("least state of charge", 100.0 * summary.least_charge, ".1f", "%"),
        ("floor of it", 100.0 * summary.floor_charge, ".1f", "%"),
        ("camera off the site, 99.7 %", summary.window_pointing_deg.site.q997, ".3f", "deg"),
        ("final position off the mean", miss.position_m, ".1f", "m"),
        ("final velocity off the mean", 1e3 * miss.velocity_m_s, ".2f", "mm/s"),
        ("largest distance in the planned spread", summary.largest_sigma_distance, ".2f", "sigma"),
        ("momentum dumps", summary.dumps, "d", ""),
    )
    return Table.of(
        f"In the simulation ({summary.vehicle}, seed {summary.seed})",
        ("figure", "value", "unit"),
        ([name, Cell(format(value, form), value), unit] for name, value, form, unit in rows),
        key="simulated",
    )
