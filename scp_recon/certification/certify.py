"""A loop around the whole way from grid to flights: aim higher until what was asked is reached.

A plan keeps its constraints with the probability that it aims at, under the normal law that linear
dynamics propagate. What nonlinear flights reach differs a little, and an estimate's lower limit lies
below it. So the plan aims above what is asked, on the normal quantile scale by what that takes, flies,
and aims higher where the lower limit falls short. Where flights touch a limit between nodes, nodes are
added there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, ndtri

from formulations.problem.flyby import Iterate
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import Estimate, proportion
from scp_recon.monte_carlo.whole_flight import KeptFlights, kept_flights
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.plan import Certificate, Plan
from scp_recon.scp.status import Status

FLIGHTS_MIN, FAILURES, FLIGHTS_MAX = 10_000, 300, 1_000_000
"""At least so many flights, and so many that 300 may break what is allowed to break; and at most."""

ROUNDS_MAX = 6
FIRST_SEED = 1_000
"""Of the first round's flights; no other draws of this library begin there. Each round has the next."""

LOST_BETWEEN = 0.05
"""Share of 1 - p that flights may lose between nodes."""

SPARE = 0.1
"""Standard errors of the estimate by which a round aims above what it has to reach."""

Planning = Callable[[Mission, Iterate, float], Plan]
"""A plan of a mission from a start, aiming at a probability."""


def certify(mission: Mission, start: Iterate, make_plan: Planning) -> Plan:
    """Plan so that the lower limit of the probability reached is at least what was asked.

    Args:
        mission: to plan; its scenario's allocation is exact.
        start: of the first round; the others start at the last one's burns.
        make_plan: a round's.

    Returns:
        The plan of the last round, with its certificate: that one reaches what was asked unless it says
        otherwise. A round that does not converge ends the loop without a certificate.
    """
    asked = mission.scenario.risk.p_chance
    samples = flights_needed(asked)
    needed = successes_needed(asked, samples) / samples
    aim = raised(needed, 0.0, samples)
    for number in range(ROUNDS_MAX):
        plan = make_plan(mission, start, aim)
        if plan.status is not Status.CONVERGED:
            return plan
        seed = FIRST_SEED + number
        kept = kept_flights(mission, plan.burns_m_s, samples, seed)
        reached = certificate_from(mission, kept, seed, number + 1)
        plan = replace(plan, certificate=reached)
        touched = reached.at_nodes - reached.reached > LOST_BETWEEN * (1.0 - asked)
        if reached.low >= asked and not touched:
            return plan
        if touched:
            mission = with_nodes_at(mission, kept.touched_s)
        if reached.low < asked:
            aim = raised(needed, float(ndtri(aim) - ndtri(reached.reached)), samples)
        start = from_burns(mission, plan.burns_m_s, "certify")
    return plan


def certificate_of(plan: Plan, samples: int, seed: int, rounds: int) -> Certificate:
    """What flights of a plan reach."""
    kept = kept_flights(plan.mission, plan.burns_m_s, samples, seed)
    return certificate_from(plan.mission, kept, seed, rounds)


def certificate_from(mission: Mission, kept: KeptFlights, seed: int, rounds: int) -> Certificate:
    """What flights reached."""
    at_nodes, reached = judged(mission, kept)
    return Certificate(kept.samples, seed, *reached, at_nodes.value, rounds)


def flights_needed(asked: float) -> int:
    """Flights whose failures tell the probability well enough.

    Raises:
        InputError: if they are too many.
    """
    rounding = 1e-6  # of 1 - asked, in flights
    flights = int(np.ceil(max(FLIGHTS_MIN, FAILURES / (1.0 - asked) - rounding)))
    if flights > FLIGHTS_MAX:
        raise InputError(
            "risk.p_chance",
            f"{asked:g}",
            f"takes {flights} flights to certify, more than {FLIGHTS_MAX}: at most "
            f"{1.0 - FAILURES / FLIGHTS_MAX:g}, or --certify no",
        )
    return flights


def successes_needed(asked: float, samples: int) -> int:
    """The least number of successes whose lower limit is at least `asked`."""
    low, high = int(asked * samples), samples
    while low < high:
        middle = (low + high) // 2
        low, high = (
            (low, middle) if proportion(middle, samples).low >= asked else (middle + 1, high)
        )
    return low


def raised(needed: float, loss: float, samples: int) -> float:
    """What to aim at to reach what is needed.

    Args:
        needed: share of flights.
        loss: by how many standard deviations flights reach less than was aimed at.
        samples: flights.
    """
    error = np.sqrt(needed * (1.0 - needed) / samples)
    return float(ndtr(ndtri(min(needed + SPARE * error, 1.0 - 0.5 / samples)) + loss))


def judged(mission: Mission, kept: KeptFlights) -> tuple[Estimate, Estimate]:
    """What the scope asks for: at the nodes, and at all times."""
    if mission.scenario.risk.scope == "flight":
        return proportion(kept.whole_at_nodes, kept.samples), proportion(kept.whole, kept.samples)
    at_nodes = min(int(counts.min()) for counts in kept.at_nodes.values())
    return proportion(at_nodes, kept.samples), proportion(
        min(kept.throughout.values()), kept.samples
    )


def with_nodes_at(mission: Mission, times_s: npt.NDArray[np.float64]) -> Mission:
    """The mission with a node in each arc in which flights touch a limit, where most of them do."""
    arcs = np.searchsorted(mission.times_s, times_s)
    new = {float(round(float(np.median(times_s[arcs == arc])))) for arc in np.unique(arcs)}
    nodes = sorted({*mission.scenario.grid.nodes_s} | (new - set(mission.times_s.tolist())))
    return Mission.from_scenario(mission.scenario.replace({"grid.nodes_s": nodes}))
