"""Find the largest probability for which a plan exists, with or without a delta-v budget.

Delta-v grows with the required probability. Bisection on the normal quantile scale therefore finds
the largest probability with a plan. Each trial starts from the burns and gains of the best plan so
far, and where that ends without a plan from trials for other probabilities (`targets`); from the first
start if none gives a verdict.

With feedback a trial takes a minute. Without a budget the search therefore begins above: a trial for
more than flights can certify ends where hardly anything is likelier, and the next one starts there and
requires what that end keeps.

A plan for one target is the start of the next, both ways. A plan for a higher target keeps a lower
one. A target therefore has a plan if a higher one has, and costs no more. Local optima break both:
from the same start one target ends without a plan, or with a dear one, and another does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Generic

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.problem.flyby import Iterate
from scp_recon.certification.flights import (
    ROUNDS_MAX,
    Watch,
    are_close,
    fly_plan,
    fly_round,
    run_test,
    with_nodes_at,
)
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import FAILURES, FLIGHTS_MAX, flights_needed, flights_of_test
from scp_recon.planning.initial_guess import start_from
from scp_recon.planning.plan import Aimed, Plan, StagedPlan, as_interrupted
from scp_recon.planning.planner import flown
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scp.status import Status

MOST = 1.0 - FAILURES / FLIGHTS_MAX
"""End of the search for the largest probability: flights cannot certify a larger one."""

SAVING = 1e-4
"""Relative saving up to which two plans cost the same."""

GROWTH = 4.0
"""Growth of the steps between probabilities from one trial to the next."""

ANSWERS = (Status.CONVERGED, Status.INFEASIBLE, Status.INTERRUPTED)
"""Outcomes that answer whether a target has a plan, or end planning."""


def is_plan(trial: StagedPlan) -> bool:
    """Whether a trial found a plan."""
    return trial.status is Status.CONVERGED


@dataclass
class Targets(Generic[Aimed]):
    """Trials of one problem on the same nodes for several targets, so far.

    Attributes:
        make: plans for a target from the end of another trial.
        keeps: whether a trial found what is looked for.
        begun: starts of trials with an answer.
        trials: with an answer.
    """

    make: Callable[[Aimed | None, float], Aimed]
    keeps: Callable[[Aimed], bool] = is_plan
    begun: list[Aimed | None] = field(default_factory=list)
    trials: list[Aimed] = field(default_factory=list)

    def plan(self, last: Aimed | None, target: float) -> Aimed:
        """Plan for a target from the last trial, and from those of other targets where that may help.

        Returns:
            The cheapest plan found that keeps the target, which may be one for a higher target. If
                there is none, a trial that proves it, or the first.
        """
        found = [self._trial(last, target)]
        for start in self._others(last, found[0], target):
            ended = start.status is Status.INTERRUPTED
            found.append(start if ended else self._trial(start, target))
            if self.keeps(found[-1]):
                break
        if found[-1].status is Status.INTERRUPTED:
            return found[-1]
        plans = [one for one in (*found, *self._above(target)) if self.keeps(one)]
        if not plans:
            return next((one for one in found if one.status in ANSWERS), found[0])
        own = min((one for one in found if self.keeps(one)), key=cost_of, default=plans[0])
        best = min(plans, key=cost_of)
        return best if cost_of(best) < (1.0 - SAVING) * cost_of(own) else own

    def _above(self, target: float) -> list[Aimed]:
        """Trials for higher targets, the nearest first."""
        return sorted((one for one in self.trials if target_of(one) > target), key=target_of)

    def _others(self, last: Aimed | None, first: Aimed, target: float) -> Iterator[Aimed]:
        """Other starts for a target: after a plan the cheapest for a higher target, if it costs less.

        Otherwise the end for the next higher target, and a plan half way to the next lower target that
        has one, on the normal quantile scale. Where there are neither, the end for a target half way to
        `MOST`, be it a plan or not: its violation is the least, and a lower target may hold there.
        """
        above = self._above(target)
        if self.keeps(first):
            plans = [one for one in above if self.keeps(one)]
            least = min(plans, key=cost_of, default=first)
            if cost_of(least) < (1.0 - SAVING) * cost_of(first):
                yield least
            return
        if first.status is Status.INTERRUPTED:
            return
        yield from above[:1]
        lower = (one for one in self.trials if self.keeps(one) and target_of(one) < target)
        below = max(lower, key=target_of, default=None)
        if below is not None:
            half = self._trial(below, _half_way(target, target_of(below)))
            if self.keeps(half) or half.status is Status.INTERRUPTED:
                yield half
        elif not above and target < MOST:
            yield self._trial(last, _half_way(target, MOST))

    def _trial(self, start: Aimed | None, target: float) -> Aimed:
        for begun, made in zip(self.begun, self.trials, strict=True):
            if begun is start and math.isclose(target_of(made), target):
                return made
        made = self.make(start, target)
        if made.status in ANSWERS:
            self.begun.append(start)
            self.trials.append(made)
        return made


def largest_kept(
    best: Aimed,
    most: float,
    close: float,
    attempt: Callable[[Aimed, float], Aimed],
    keeps: Callable[[Aimed], bool] = is_plan,
    step: float = math.inf,
) -> tuple[Aimed, Aimed | None]:
    """Bisect for the largest probability that has a plan, on the normal quantile scale.

    The search lies between the probability of the best plan and `most`, which is not planned, and
    ends within `close` standard deviations. Each trial starts from the best plan so far, at most a
    `step` above it, which grows with each trial.

    Returns:
        The best plan, marked as interrupted after Ctrl-C; and the failed trial of the least
            probability, if any trial failed.
    """
    low, high = float(ndtri(target_of(best))), float(ndtri(most))
    above: Aimed | None = None
    while high - low > close:
        middle, step = min(low + step, 0.5 * (low + high)), GROWTH * step
        try:
            found = attempt(best, float(ndtr(middle)))
        except KeyboardInterrupt:
            return as_interrupted(best), None
        if found.status is Status.INTERRUPTED:
            return as_interrupted(best), None
        if keeps(found):
            best, low = found, middle
        else:
            high, above = middle, found
    return best, above


def _half_way(one: float, other: float) -> float:
    """The target in the middle on the normal quantile scale."""
    return float(ndtr(0.5 * (ndtri(one) + ndtri(other))))


def target_of(plan: StagedPlan) -> float:
    """Target probability of a plan with exact risk."""
    assert plan.target is not None
    return plan.target


def cost_of(plan: StagedPlan) -> float:
    """What planning minimises, nondimensional."""
    return plan.final.merit.cost(plan.final.result.lin)


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
        word = ScenarioWarning.of(
            "risk.p_chance",
            f"no verdict for {failed.target:.5g}: {failed.status.value.name}",
            f"{best.target:.5g} is the largest probability with a plan so far; larger ones may be "
            "feasible",
        )
        warnings = (*best.mission.warnings, word)
        return replace(best, mission=replace(best.mission, warnings=warnings))

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
