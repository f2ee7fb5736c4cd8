"""The largest probability that a plan can have, at all or for a delta-v budget.

Delta-v grows with the probability asked, so that bisection on the normal quantile scale finds the last
one that has a plan. Each try begins at the burns of the best one so far, and at the first start where
that settles nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

from scipy.special import ndtr, ndtri

from formulations.problem.flyby import Iterate
from scp_recon.certification.certify import (
    ROUNDS_MAX,
    AimedPlanning,
    Watch,
    are_close,
    certificate_from,
    with_nodes_at,
)
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.certifying import FAILURES, FIRST_SEED, FLIGHTS_MAX, flights_needed
from scp_recon.monte_carlo.whole_flight import kept_flights
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.plan import Plan, as_interrupted
from scp_recon.scenario.warning import ScenarioWarning
from scp_recon.scp.status import Status

LEAST, MOST = 0.55, 1.0 - FAILURES / FLIGHTS_MAX
"""Probabilities between which it is looked for: no flights can certify a larger one."""
CLOSE = 0.01
"""Standard deviations between the last probability with a plan and the first without."""
DIGITS = 4
"""Of a probability that is promised."""

ANSWERS = (Status.CONVERGED, Status.INFEASIBLE, Status.INTERRUPTED)
"""Outcomes after which a try is not repeated from another start."""


def rounded_down(probability: float) -> float:
    """To what is promised."""
    return math.floor(probability * 10**DIGITS) / 10**DIGITS


def is_kept(plan: Plan, budget_m_s: float) -> bool:
    """Whether a try has a plan within the budget."""
    return plan.status is Status.CONVERGED and plan.total_dv_m_s <= budget_m_s


@dataclass(frozen=True)
class Search:
    """How the largest probability is looked for.

    Attributes:
        make_plan: a try's.
        budget_m_s: most delta-v that it may cost.
        close: standard deviations between what has a plan and what has none.
    """

    make_plan: AimedPlanning
    budget_m_s: float = float("inf")
    close: float = CLOSE

    def run(self, mission: Mission, start: Iterate) -> Plan:
        """The plan of the largest probability by the normal law.

        Ctrl-C ends with the best so far, marked as interrupted.

        Args:
            mission: to plan; its scenario's allocation is exact.
            start: of the first try.

        Returns:
            A plan whose `aim` is that probability; the try for `LEAST` where none is kept. Where the
            try above it came to no verdict it has a warning that says so.
        """
        best = self.make_plan(mission, start, LEAST)
        if not is_kept(best, self.budget_m_s):
            return best
        low, high, open_end = float(ndtri(LEAST)), float(ndtri(MOST)), None
        while high - low > self.close:
            middle = 0.5 * (low + high)
            found = self._tried(mission, best, start, float(ndtr(middle)))
            if found is None or found.status is Status.INTERRUPTED:
                return as_interrupted(best)
            if is_kept(found, self.budget_m_s):
                best, low = found, middle
            else:
                high, open_end = middle, None if found.status in ANSWERS else found
        return best if open_end is None else with_warning(best, open_end)

    def _tried(self, mission: Mission, best: Plan, start: Iterate, aim: float) -> Plan | None:
        """A try, from the first start too where the best burns lead to no verdict; or Ctrl-C came."""
        try:
            found = self.make_plan(mission, from_burns(mission, best.burns_m_s), aim)
            if found.status not in ANSWERS:
                again = self.make_plan(mission, start, aim)
                found = again if again.status in ANSWERS else found
        except KeyboardInterrupt:
            return None
        return found


def with_warning(best: Plan, undecided: Plan) -> Plan:
    """The plan with a word on the probability next to it, for which planning came to no verdict."""
    word = ScenarioWarning.of(
        "risk.p_chance",
        f"no verdict for {undecided.aim:.5g}: {undecided.status.value.name}",
        f"{best.aim:.5g} is the largest that a plan was found for; a larger one may have one too",
    )
    warnings = (*best.mission.warnings, word)
    return replace(best, mission=replace(best.mission, warnings=warnings))


def largest_promise(
    mission: Mission,
    start: Iterate,
    search: Search,
    *,
    certified: bool,
    watch: Watch | None = None,
) -> Plan:
    """The plan of the largest probability with what it reaches as what its scenario asks, rounded down.

    Where flights touch a limit between nodes, nodes are added there and it is looked for again.

    Args:
        mission: to plan; its scenario's allocation is exact.
        start: of the first try.
        search: for the largest that it aims at.
        certified: whether what flights reach is promised, or what it aims at.
        watch: is told when flights begin, and what they reach.

    Returns:
        That plan; the try for `LEAST` where no plan is kept.
    """
    found: Plan | None = None
    for number in range(1, ROUNDS_MAX + 1):
        best = search.run(mission, start)
        if best.status is Status.INTERRUPTED and found is not None:
            return as_interrupted(found)
        if not is_kept(best, search.budget_m_s):
            return found or best
        assert best.aim is not None
        if not certified:
            return promising(best, best.aim)
        samples, seed = flights_needed(best.aim), FIRST_SEED + number - 1
        try:
            if watch:
                watch(number, best, samples)
            seen = partial(watch, number, best, samples) if watch else None
            kept = kept_flights(mission, best.burns_m_s, samples, seed, seen)
        except KeyboardInterrupt:
            return as_interrupted(found or best)
        reached = certificate_from(mission, kept, seed, number)
        found = replace(best, certificate=reached)
        # A scenario asks for more than one half: less is promised by none, and its verdict says so.
        if rounded_down(reached.low) > 0.5:
            found = promising(found, reached.low)
        if watch:
            watch(number, found, samples)
        if are_close(reached, reached.low):
            break
        mission = with_nodes_at(mission, kept.touched_s)
        start = from_burns(mission, best.burns_m_s)
    assert found is not None
    return found


def promising(plan: Plan, probability: float) -> Plan:
    """The plan of a scenario that asks so much."""
    scenario = plan.mission.scenario.replace({"risk.p_chance": rounded_down(probability)})
    warnings = plan.mission.warnings
    mission = Mission.from_scenario(scenario)
    told = tuple(dict.fromkeys((*mission.warnings, *warnings)))
    return replace(plan, mission=replace(mission, warnings=told))
