"""Whether a campaign shows what was asked of its plan."""

from __future__ import annotations

from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.monte_carlo.summary import Summary
from scp_recon.scp.status import Status
from scp_recon.solution.file import Solution


def probability_asked(solution: Solution) -> float | None:
    """Of every joint constraint at every time; none of a plan that was made without uncertainty."""
    return solution.scenario.risk.p_chance if solution.problem == "P2" else None


def shortfalls(summary: Summary, solution: Solution) -> list[str]:
    """What is not met, each beside what was asked; empty if all is.

    Estimates are held to the probability, as the verification does; that all constraints hold at once
    was not asked.
    """
    converged = Status.CONVERGED.value.name
    found = []
    if solution.status != converged:
        found.append(f"the plan is {solution.status}, asked {converged}")
    asked = probability_asked(solution)
    for name, lowest in summary.probability.items():
        if asked is not None and name != ALL and lowest.estimate.value < asked:
            value, at = lowest.estimate.value, lowest.worst_t_s
            found.append(f"{name} {value:.4f} at {at:.0f} s, asked {asked:g}")
    return found
