"""Whether flights show what was asked of their plan."""

from __future__ import annotations

from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.monte_carlo.summary import Interval, Summary
from scp_recon.scp.status import Status
from scp_recon.solution.file import Solution


def probability_asked(solution: Solution) -> float | None:
    """Of every joint constraint at every time; none of a plan that was made without uncertainty."""
    return solution.scenario.risk.p_chance if solution.problem == "P2" else None


def shortfalls(summary: Summary, solution: Solution) -> list[str]:
    """What is not met, each beside what was asked; empty if all is.

    Estimates are held to the probability, as the verification does, and whole flights where they are
    what was asked.
    """
    converged = Status.CONVERGED.value.name
    found = []
    if solution.status != converged:
        found.append(f"the plan is {solution.status}, asked {converged}")
    asked = probability_asked(solution)
    if asked is None:
        return found
    for name, lowest in summary.probability.items():
        if name != ALL and _judged(lowest, solution) < asked:
            value, at = lowest.estimate.value, lowest.worst_t_s
            found.append(f"{name} {value:.4f} at {at:.0f} s, asked {asked:g}")
    whole = summary.whole_flight
    flights = solution.scenario.risk.scope == "flight"
    if flights and whole is not None and _judged(whole, solution) < asked:
        found.append(f"whole flights {whole.estimate.value:.4f}, asked {asked:g}")
    return found


def too_wide(width: float, until: float | None) -> list[str]:
    """An interval wider than flights were to go on until, where they came to an end before.

    Args:
        width: of the widest confidence interval.
        until: width that was asked for, if one was.
    """
    if until is None or width <= until:
        return []
    return [
        f"widest interval {100.0 * width:.3g} %, asked {100.0 * until:g} %: needs more --samples"
    ]


def _judged(found: Interval, solution: Solution) -> float:
    """The estimate; of an exact plan, which spends what was asked, what flights do not refute."""
    exact = solution.scenario.risk.allocation == "exact"
    return found.estimate.high if exact else found.estimate.value
