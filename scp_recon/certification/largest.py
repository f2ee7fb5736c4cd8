"""The largest probability that a plan can have, at all or for a delta-v budget.

Delta-v grows with the probability asked, so that bisection on the normal quantile scale finds the last
one that has a plan. Each try begins at the burns of the best one so far.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from scipy.special import ndtr, ndtri

from formulations.problem.flyby import Iterate
from scp_recon.certification.certify import FIRST_SEED, certificate_of, flights_needed
from scp_recon.mission.mission import Mission
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.plan import Plan
from scp_recon.scp.status import Status

LEAST, MOST = 0.55, 0.9999
"""Probabilities between which it is looked for."""
CLOSE = 0.01
"""Standard deviations between the last probability with a plan and the first without."""
DIGITS = 4
"""Of a probability that is promised."""

Planning = Callable[[Mission, Iterate, float], Plan]
"""An exact plan of a mission from a start, aiming at a probability."""


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
    asked = math.floor(reached * 10**DIGITS) / 10**DIGITS
    mission = Mission.from_scenario(best.mission.scenario.replace({"risk.p_chance": asked}))
    return replace(best, mission=mission, certificate=certificate)


def largest_probability(
    mission: Mission,
    start: Iterate,
    make_plan: Planning,
    budget_m_s: float = float("inf"),
    close: float = CLOSE,
) -> Plan | None:
    """The plan of the largest probability, which is its `aim`; None if there is none for `LEAST`.

    Args:
        mission: to plan; its scenario's allocation is exact.
        start: of the first try.
        make_plan: a try's.
        budget_m_s: most delta-v that it may cost.
        close: standard deviations between what has a plan and what has none.
    """

    def tried(probability: float, begin: Iterate) -> Plan | None:
        found = make_plan(mission, begin, probability)
        kept = found.status is Status.CONVERGED and found.total_dv_m_s <= budget_m_s
        return found if kept else None

    best = tried(LEAST, start)
    if best is None:
        return None
    low, high = float(ndtri(LEAST)), float(ndtri(MOST))
    while high - low > close:
        middle = 0.5 * (low + high)
        found = tried(float(ndtr(middle)), from_burns(mission, best.burns_m_s))
        if found is None:
            high = middle
        else:
            best, low = found, middle
    return best
