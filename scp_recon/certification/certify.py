"""Certify a plan: raise the target probability until independent flights reach the required one.

A plan keeps its constraints with the target probability, under the normal law of the linearised
dynamics. Nonlinear flights reach a slightly different probability, and the lower limit of an
estimate lies below it. The target must therefore exceed the required probability.

Rounds of flights measure the difference. The curvature of the flow, and violations between nodes,
cause a loss. On the normal quantile scale the loss hardly depends on the target. Each round
measures the loss with its sampling error. The mean over rounds is more accurate than the last
round. If flights violate a limit between nodes, nodes are added there. Rounds end with a plan that
independent flights should pass 95 times in 100, and whose surplus is within sampling error.

A *test* judges the plan: flights with seeds that no round has used. A plan that passes is
certified; there is no choice among several passing plans. Where a target has no plan, that for the
largest lower target is tested, which may still reach the required probability. After a failed test,
its flights count as a round's. One more plan then has one more test, the last. A plan that reaches
exactly the required probability is therefore certified at most 2.5 times in 100: see
`estimates.TEST_CONFIDENCE`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Generic

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from formulations.risk.strata import Counted
from scp_recon.certification.flights import (
    ROUNDS_MAX,
    Fly,
    Watch,
    are_close,
    fly_plan,
    fly_round,
    run_test,
    unlike_beyond,
    with_nodes_at,
)
from scp_recon.certification.largest import Targets, is_plan, largest_kept, target_of
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import (
    TESTS_MAX,
    flights_needed,
    flights_of_test,
    successes_needed,
)
from scp_recon.monte_carlo.whole_flight import KeptCounts
from scp_recon.planning.plan import Aimed, Plan, StagedPlan, as_interrupted
from scp_recon.scp.status import Status

BINDING = 0.01
"""Standard deviations between aim and law, up to which a constraint binds."""

CLOSE = 0.005
"""Standard deviations between the largest target with a plan and the least without."""

AimedPlanning = Callable[[Mission, Iterate | Plan, float], Plan]
"""A plan of a mission from a start, or another plan, aiming at a probability."""

Planning = Callable[[Aimed | None, Array, float], Aimed]
"""A plan that aims at a probability and goes on from the last one, with nodes at times, s, if any."""


def certify(
    mission: Mission, start: Iterate | Plan, make_plan: AimedPlanning, watch: Watch | None = None
) -> Plan:
    """Certify a plan of a mission whose allocation is exact: see `certified`.

    Later plans start from the last one, on the same grid.
    """

    def anew(last: Plan | None, touched_s: Array, aim: float) -> Plan:
        if last is None:
            return make_plan(mission, start, aim)
        at = with_nodes_at(last.mission, touched_s) if len(touched_s) else last.mission
        return make_plan(at, last, aim)

    return certified(mission.scenario.risk.p_chance, anew, partial(fly_plan, watch))


def certified(asked: float, make_plan: Planning[Aimed], fly: Fly[Aimed]) -> Aimed:
    """Plan so that independent flights reach the required probability.

    Ctrl-C ends with the best plan so far, marked as interrupted.

    Returns:
        The plan that passed a test, with its certificate. If none passed, the plan that came
            nearest, whose certificate says so. If a target is infeasible, or the first plan ends
            without a verdict, and the plan for the largest target below does not pass either, the
            plan for that target, without a certificate.
    """
    work = _Certification(asked, make_plan, fly)
    try:
        return work.run()
    except KeyboardInterrupt:
        best = work.nearest or work.made
        if best is None:
            raise
        return as_interrupted(best)


@dataclass
class _Certification(Generic[Aimed]):
    """State of one certification: last plan, times of new nodes, plans and strata of its flights."""

    asked: float
    make_plan: Planning[Aimed]
    fly: Fly[Aimed]
    made: Aimed | None = None
    touched_s: Array = field(default_factory=lambda: np.zeros(0))
    flown: list[tuple[Aimed, float]] = field(default_factory=list)
    tested: list[Aimed] = field(default_factory=list)
    counted: list[Counted] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.targets = Targets(self._make)
        self.samples, self.fresh = flights_needed(self.asked), flights_of_test(self.asked)
        self.aiming = Aiming(self.asked, self.samples, self.fresh)

    def run(self) -> Aimed:
        while len(self.tested) < TESTS_MAX:
            plan = self._next()
            if plan.status is not Status.CONVERGED:
                return self._without(plan)
            aimed = not self.tested and len(self.flown) < ROUNDS_MAX
            if aimed and not self._aims_well(plan):
                continue
            if self._passes(plan):
                break
        assert self.nearest is not None
        return self.nearest

    @property
    def nearest(self) -> Aimed | None:
        """The plan with the largest lower limit among those with a test; only the last may pass."""
        return max(self.tested, key=_low, default=None)

    def _next(self) -> Aimed:
        """The plan for the present target."""
        if len(self.touched_s):
            self.targets = Targets(self._make)
        plan = self.targets.plan(self.made, self.aiming.next())
        if plan.status is Status.INTERRUPTED and self.made is not None:
            raise KeyboardInterrupt
        if plan.status is Status.CONVERGED:
            self.made = plan
        return plan

    def _make(self, last: Aimed | None, target: float) -> Aimed:
        """A plan from the last one, with new nodes, or from one that has these nodes."""
        new = self.touched_s if last is self.made else self.touched_s[:0]
        return self.make_plan(last, new, target)

    def _aims_well(self, plan: Aimed) -> bool:
        """Fly a round and learn from it; whether the plan is ready for a test."""
        kept = fly_round(plan, self.fly, self.samples, len(self.flown) + 1)
        self.flown.append((plan, kept.throughout / kept.samples))
        self.aiming.worth = kept.samples / self.samples
        close = self._learn(plan, kept)
        return close and self.aiming.is_settled(_law(plan), binds=slack(plan) <= BINDING)

    def _passes(self, plan: Aimed) -> bool:
        """Test a plan; if it fails, learn from it."""
        number, rounds = len(self.tested) + 1, len(self.flown)
        unlike = unlike_beyond(self.counted)
        plan, kept = run_test(plan, self.fly, self.fresh, number, rounds, unlike)
        self.tested.append(plan)
        assert plan.certificate is not None
        if plan.certificate.certifies(self.asked):
            return True
        self._learn(plan, kept)
        return False

    def _learn(self, plan: Aimed, kept: KeptCounts) -> bool:
        """Learn the loss from flights; whether the nodes are close enough."""
        if kept.strata is not None:
            self.counted.append(kept.strata)
        close = are_close(kept, self.asked)
        if not close:  # nodes are added, which recover what the flights so far lost between nodes
            self.aiming.losses = []
        self.aiming.learn(_law(plan), kept.throughout if close else kept.at_nodes, kept.samples)
        self.touched_s = kept.touched_s[:0] if close else kept.touched_s
        return close

    def _without(self, failed: Aimed) -> Aimed:
        """The result if a target has no plan: that of the largest lower target may pass a test."""
        if failed.status is not Status.INTERRUPTED:
            best = self._largest_below(failed)
            is_new = all(target_of(best) != target_of(tested) for tested in self.tested)
            if is_plan(best) and is_new and self._passes(best):
                return self.tested[-1]
        if self.nearest is None or failed.status is Status.INFEASIBLE:
            return failed
        return self.nearest

    def _largest_below(self, failed: Aimed) -> Aimed:
        """The plan for the largest target below a failed one that may suffice, or of the best round."""
        lower = (one for one in self.targets.trials if target_of(one) < target_of(failed))
        best = max(filter(is_plan, lower), key=target_of, default=None)
        best = best or self.targets.plan(failed, self.aiming.least)
        if is_plan(best):
            best, _ = largest_kept(best, target_of(failed), CLOSE, self.targets.plan)
        elif self.flown:
            best, _ = max(self.flown, key=lambda flown: flown[1])
        if best.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return best


def _low(plan: StagedPlan) -> float:
    assert plan.certificate is not None
    return plan.certificate.low


def _law(plan: StagedPlan) -> float:
    """The quantile of the plan's probability by the normal law; it may exceed the target."""
    return float(ndtri(target_of(plan))) + max(slack(plan), 0.0)


def slack(plan: StagedPlan) -> float:
    """Excess of the normal law's probabilities over the target, in standard deviations."""
    of, drifts = plan.final, {drift.name for drift in plan.final.merit.problem.drifts}
    return min(
        float(m.margin.min())
        for name, m in of.margins.items()
        if of.unit(name) == "sigma" and name not in drifts
    )


SURE = float(ndtri(0.95))
"""Standard deviations by which a plan should exceed the requirement of a test, by the rounds'
measurements: 95 of 100 plans pass. The deviation combines that of the test and that of the
measurement."""

SURE_ENOUGH = float(ndtri(0.85))
"""The same for a plan that needs no further round."""

EXCESS = 1.0
"""Standard errors of the rounds' measurement up to which a plan's surplus is within sampling error."""

LEAST, MOST = 0.501, 1.0 - 1e-9
"""Aims: the constraint is convex above one half."""


@dataclass
class Aiming:
    """The target of plans that a test should pass, from the flights so far.

    In flights drawn from binomial laws for 0.7 to 0.999, with losses of -1 to 3 standard errors of
    a round, 95 of 100 plans pass their first test, and 1 to 3 of 1,000 neither, after 2 rounds in
    the mean. On average they reach 3.4 of these standard errors more than required, and in 5 of 100
    cases 4.6 or more.

    Losses are those measured on the present nodes, in standard deviations, with the flights of each.
    A round's flights in strata are `worth` times as many plain ones, and so are a test's.
    """

    asked: float
    samples: int
    fresh: int
    worth: float = 1.0
    losses: list[tuple[float, int]] = field(default_factory=list)

    @cached_property
    def needed(self) -> float:
        """Share of the fresh flights with which a test passes."""
        return successes_needed(self.asked, self.fresh) / self.fresh

    @property
    def loss(self) -> float:
        """Mean of the losses; zero before any flight."""
        if not self.losses:
            return 0.0
        values, flights = np.array(self.losses).T
        return float(np.average(values, weights=flights))

    @property
    def least(self) -> float:
        """The target at which flights reach just the required probability."""
        return self._target(self.asked)

    @property
    def error(self) -> float:
        """Standard error of the mean loss's prediction; before any flight that of a round."""
        return self._error(sum(flights for _, flights in self.losses) or self.samples)

    def learn(self, law: float, kept: float, samples: int) -> None:
        """Learn the loss from flights of a plan with a quantile of the normal law."""
        half = 0.5 / samples
        reached = ndtri(np.clip(kept / samples, half, 1.0 - half))
        self.losses.append((law - float(reached), samples))

    def next(self) -> float:
        """The target at which a test passes with the probability of `SURE`."""
        above = min(self.needed + SURE * self._deviation, 1.0 - 0.5 / self.fresh)
        return self._target(above)

    def is_settled(self, law: float, *, binds: bool) -> bool:
        """Whether a test should pass a plan, and its surplus is within sampling error.

        If its constraints do not bind, a lower target would save no delta-v.
        """
        most, least = (float(ndtr(q - self.loss)) for q in (law, ndtri(self.next())))
        sure = most - self.needed >= SURE_ENOUGH * self._deviation
        return sure and (not binds or most - least <= EXCESS * self.error)

    def _target(self, reached: float) -> float:
        """The target at which flights reach a probability."""
        return float(np.clip(ndtr(ndtri(reached) + self.loss), LEAST, MOST))

    @property
    def _deviation(self) -> float:
        """Standard error of a test about its expectation."""
        return float(np.hypot(self._error(self.worth * self.fresh), self.error))

    def _error(self, flights: float) -> float:
        return float(np.sqrt(self.needed * (1.0 - self.needed) / flights))
