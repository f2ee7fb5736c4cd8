"""The largest probability that a plan can have, at all or for a delta-v budget.

Delta-v grows with the probability asked, so that bisection on the normal quantile scale finds the last
one that has a plan. Each try begins at the burns of the best one so far.
"""

from __future__ import annotations

import math
from dataclasses import replace

from scipy.special import ndtr, ndtri

from formulations.problem.flyby import Iterate
from scp_recon.certification.certify import (
    FAILURES,
    FIRST_SEED,
    FLIGHTS_MAX,
    Planning,
    certificate_of,
    flights_needed,
)
from scp_recon.mission.mission import Mission
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.plan import Plan
from scp_recon.scp.status import Status

LEAST, MOST = 0.55, 1.0 - FAILURES / FLIGHTS_MAX
"""Probabilities between which it is looked for: no flights can certify a larger one."""
CLOSE = 0.01
"""Standard deviations between the last probability with a plan and the first without."""
DIGITS = 4
"""Of a probability that is promised."""


def promised(best: Plan, *, certified: bool) -> Plan:
    """The plan with what it reaches as what its scenario asks, rounded down.

    Args:
        best: of the largest probability.
        certified: whether what flights reach is promised, or what it aims at.
    """
    assert best.aim is not None
    certificate, reached = None, best.aim
    if certified:
        certificate = certificate_of(best, flights_needed(best.aim), FIRST_SEED, 1)
        reached = certificate.low
    scenario = best.mission.scenario.replace({"risk.p_chance": rounded_down(reached)})
    mission = Mission.from_scenario(scenario)
    return replace(best, mission=mission, certificate=certificate)


def rounded_down(probability: float) -> float:
    """To what is promised."""
    return math.floor(probability * 10**DIGITS) / 10**DIGITS


def is_kept(plan: Plan, budget_m_s: float) -> bool:
    """Whether a try has a plan within the budget."""
    return plan.status is Status.CONVERGED and plan.total_dv_m_s <= budget_m_s


def largest_probability(
    mission: Mission,
    start: Iterate,
    make_plan: Planning,
    budget_m_s: float = float("inf"),
    close: float = CLOSE,
) -> Plan:
    """The plan of the largest probability, which is its `aim`; the try for `LEAST` if none is kept.

    Args:
        mission: to plan; its scenario's allocation is exact.
        start: of the first try.
        make_plan: a try's.
        budget_m_s: most delta-v that it may cost.
        close: standard deviations between what has a plan and what has none.
    """
    best = make_plan(mission, start, LEAST)
    if not is_kept(best, budget_m_s):
        return best
    low, high = float(ndtri(LEAST)), float(ndtri(MOST))
    while high - low > close:
        middle = 0.5 * (low + high)
        found = make_plan(mission, from_burns(mission, best.burns_m_s), float(ndtr(middle)))
        if is_kept(found, budget_m_s):
            best, low = found, middle
        else:
            high = middle
    return best
