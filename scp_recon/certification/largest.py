"""Find the largest probability for which a plan exists, with or without a delta-v budget.

Delta-v grows with the required probability. Bisection on the normal quantile scale therefore finds
the largest probability with a plan. Each trial starts from the burns and gains of the best plan so
far, and where that ends without a plan from trials for other probabilities (`targets`); from the first
start if none gives a verdict.

With feedback a trial takes a minute. Without a budget the search therefore begins above: a trial for
more than flights can certify ends where hardly anything is likelier, and the next one starts there and
requires what that end keeps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.problem.flyby import Iterate
from scp_recon.certification.certify import ROUNDS_MAX
from scp_recon.certification.flights import (
    Watch,
    are_close,
    fly_plan,
    fly_round,
    run_test,
    with_nodes_at,
)
from scp_recon.certification.targets import ANSWERS, MOST, Targets, largest_kept, target_of
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import flights_needed, flights_of_test
from scp_recon.planning.initial_guess import start_from
from scp_recon.planning.missions import flown
from scp_recon.planning.plan import Plan, as_interrupted
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scp.status import Status

LEAST = 0.55
"""Least probability that is looked for."""
CLOSE = 0.01
"""Standard deviations between the last probability with a plan and the first without."""
LEAPS = 3
"""Trials from above, each for what the one before keeps."""
DIGITS = 4
"""Digits of a promised probability."""


def rounded_down(probability: float) -> float:
    """Round a probability down to the digits that are promised."""
    return math.floor(probability * 10**DIGITS) / 10**DIGITS


@dataclass(frozen=True)
class Search:
    """Search for the largest probability within a budget, to a number of standard deviations.

    Attributes:
        make_plan: plans a mission from a start for a target; if `once`, from that start alone.
        budget_m_s: largest delta-v.
        close: see `CLOSE`.
        most: end of the search, a probability without a plan.
    """

    make_plan: Callable[..., Plan]
    budget_m_s: float = float("inf")
    close: float = CLOSE
    most: float = MOST

    def run(self, mission: Mission, start: Iterate | Plan, above: float = MOST) -> Plan:
        """Find the largest probability by the normal law; the mission's allocation is exact.

        `above` is hardly less than that probability. Ctrl-C ends with the best so far, marked as
        interrupted.

        Returns:
            A plan whose `target` is that probability; the trial for `LEAST` if no trial succeeds.
                The plan has a warning if the next larger trial ended without a verdict.
        """

        def make(last: Plan | None, target: float) -> Plan:
            if last is None:
                return self._planned(mission, start, target)
            return self._planned(last.mission, start_from(last.mission, last), target, once=True)

        targets, step = Targets(make, self.keeps), 2.0 * self.close
        best = self._from_above(mission, start, above, make)
        if best is None:
            best, step = targets.plan(None, LEAST), math.inf
        if not self.keeps(best):
            return best

        def attempt(best: Plan, target: float) -> Plan:
            """Plan from the best burns and other trials, and from the start if they say nothing."""
            if step < math.inf:
                return make(best, target)
            found = targets.plan(best, target)
            return found if found.status in ANSWERS else make(None, target)

        best, failed = largest_kept(best, self.most, self.close, attempt, self.keeps, step)
        if failed is None or failed.status in ANSWERS or best.status is Status.INTERRUPTED:
            return best
        return with_warning(best, failed)

    def _from_above(
        self,
        mission: Mission,
        start: Iterate | Plan,
        above: float,
        make: Callable[[Plan | None, float], Plan],
    ) -> Plan | None:
        """A plan for what an end of a trial for more keeps; None where bisection is as quick.

        The first trial for `MOST` has no gains to begin with: those of a plan for less lead nowhere.
        """
        if mission.problem.feedback is None or self.budget_m_s < math.inf:
            return None
        begun = flown(mission, start) if isinstance(start, Plan) else start
        if above == MOST:
            begun = replace(begun, gains=np.zeros_like(begun.gains))
        trial = self._planned(mission, begun, above, once=True)
        for _ in range(LEAPS):
            if self.keeps(trial) or trial.status is Status.INTERRUPTED:
                return trial
            kept = kept_quantile(trial)
            if not ndtri(LEAST) < kept < ndtri(target_of(trial)):
                break
            trial = make(trial, float(ndtr(kept - 0.5 * self.close)))
        return trial if self.keeps(trial) else None

    def _planned(
        self, mission: Mission, start: Iterate | Plan, target: float, *, once: bool = False
    ) -> Plan:
        """Plan for a probability, also required of the limits on corrected burns."""
        return self.make_plan(mission.changed({"risk.p_chance": target}), start, target, once=once)

    def keeps(self, plan: Plan) -> bool:
        """Whether a trial has a plan within the budget."""
        return plan.status is Status.CONVERGED and plan.cost_m_s <= self.budget_m_s


def kept_quantile(trial: Plan) -> float:
    """Normal quantile of the probability that a trial's end keeps, at most of its target."""
    final = trial.final
    rows = [
        part.margin.min() for name, part in final.margins.items() if final.unit(name) == "sigma"
    ]
    return float(ndtri(target_of(trial)) + min([0.0, *rows]))


def with_warning(best: Plan, undecided: Plan) -> Plan:
    """The plan with a warning about the next probability, for which planning gave no verdict."""
    word = ScenarioWarning.of(
        "risk.p_chance",
        f"no verdict for {undecided.target:.5g}: {undecided.status.value.name}",
        f"{best.target:.5g} is the largest probability with a plan so far; larger ones may be feasible",
    )
    warnings = (*best.mission.warnings, word)
    return replace(best, mission=replace(best.mission, warnings=warnings))


def largest_promise(
    mission: Mission,
    start: Iterate | Plan,
    search: Search,
    *,
    certified: bool,
    watch: Watch | None = None,
) -> Plan:
    """The plan of the largest probability; its scenario requires that probability, rounded down.

    Without flights the plan promises its target. With certification, rounds of flights find
    violations between nodes, nodes are added there, and the search is repeated. The plan then
    promises the lower limit of one test, whose flights no round has used. The mission's allocation
    is exact.

    Returns:
        That plan; the trial for `LEAST` if no trial succeeds. Ctrl-C ends with the last plan found,
            marked as interrupted.
    """
    found: Plan | None = None
    for number in range(1, ROUNDS_MAX + 1):
        best = search.run(mission, start, found.target if found and found.target else MOST)
        if best.status is Status.INTERRUPTED and found is not None:
            return as_interrupted(found)
        if not search.keeps(best):
            if found is None:
                return best
            break
        found = best
        assert best.target is not None
        if not certified:
            return promising(best, best.target)
        try:
            kept = fly_round(best, partial(fly_plan, watch), flights_needed(best.target), number)
        except KeyboardInterrupt:
            return as_interrupted(best)
        if are_close(kept, kept.throughout / kept.samples):
            break
        mission = with_nodes_at(best.mission, kept.touched_s)
        start = start_from(mission, best)
    assert found is not None
    return _promised(found, number, watch)


def _promised(found: Plan, rounds: int, watch: Watch | None) -> Plan:
    """The plan with a scenario that requires the lower limit of a test."""
    assert found.target is not None
    try:
        judged, _ = run_test(
            found, partial(fly_plan, watch), flights_of_test(found.target), 1, rounds
        )
    except KeyboardInterrupt:
        return as_interrupted(found)
    assert judged.certificate is not None
    # A scenario asks for more than one half: less is promised by none, and its verdict says so.
    low = judged.certificate.low
    return promising(judged, low) if rounded_down(low) > 0.5 else judged


def promising(plan: Plan, probability: float) -> Plan:
    """The plan with a scenario that requires a probability."""
    return replace(plan, mission=plan.mission.changed({"risk.p_chance": rounded_down(probability)}))
