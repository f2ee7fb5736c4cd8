"""Judge flights by one rule: what they keep less often, or do worse, than their plan requires."""

from __future__ import annotations

from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.monte_carlo.summary import Interval, Summary
from scp_recon.results.figures import is_converged
from scp_recon.results.solution import Solution
from scp_recon.scp.status import Status
from scp_recon.simulation.record import FlightSummary
from scp_recon.verification.probabilities import falls_short, required_probability

SHORT_WH = 1e-9
"""Largest energy that counts as none, Wh."""


def shortfalls(found: Summary | FlightSummary, solution: Solution) -> list[str]:
    """List requirements that flights do not meet, as value and required value; empty if none.

    Args:
        found: of many flights, whose probabilities are compared with the required one, those of whole
            flights if the scope is the whole flight; or of one simulated flight, whose charge must stay
            above the vehicle's floor with every load served, and whose modes must have the length and
            the steady attitude that the schedule's rules require.
        solution: that was flown; it must have converged.
    """
    failed = []
    if not is_converged(solution):
        failed.append(f"the plan is {solution.status}, required {Status.CONVERGED.value.name}")
    if isinstance(found, Summary):
        return [*failed, *_of_flights(found, solution)]
    return [*failed, *_of_simulation(found, solution)]


def _of_flights(summary: Summary, solution: Solution) -> list[str]:
    probabilities: list[tuple[str, Interval]] = [
        (f"{name} {{:.4f}} at {lowest.worst_t_s:.0f} s", lowest)
        for name, lowest in summary.probability.items()
        if name != ALL
    ]
    if summary.commanded:
        probabilities += [
            (f"{name} of burn {burn.burn} {{:.4f}}", kept)
            for burn in summary.commanded.burns
            for name, kept in burn.limits.items()
        ]
    if solution.scenario.risk.scope == "flight":
        probabilities.append(("whole flights {:.4f}", summary.whole_flight))
    required, drift, found = required_probability(solution), summary.drift, []
    if drift is not None and drift.is_refuted:
        found.append(f"{drift.check} {drift.value:.4f}, required {drift.required:g}")
    return found + [
        f"{line.format(one.value)}, required {required:g}"
        for line, one in probabilities
        if falls_short(solution, one.value, one.high, required)
    ]


def _of_simulation(summary: FlightSummary, solution: Solution) -> list[str]:
    failed = []
    charge, floor = summary.least_charge, summary.floor_charge
    if charge < floor:
        failed.append(f"least state of charge {charge:.3f}, required {floor:.2f}")
    if (short := summary.energy_wh.short) > SHORT_WH:
        failed.append(f"{short:.3g} Wh short, required 0")
    rule = solution.scenario.schedule.attitude_s
    for leg in summary.legs:
        name = f"{leg.mode} mode from {leg.start_s:.0f} s"
        if not leg.ok:
            failed.append(f"{name} {leg.duration_s:.0f} s long, required {leg.required_s:.0f} s")
        if not leg.settled_in_time:
            after = "never" if leg.settled_s is None else f"after {leg.settled_s:.0f} s"
            failed.append(f"{name} steady {after}, required {rule:.0f} s")
    return failed
