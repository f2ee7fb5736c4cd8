"""Plan for several target probabilities: a plan for one target is the start of the next, both ways.

A plan for a higher target keeps a lower one. A target therefore has a plan if a higher one has, and
costs no more. Local optima break both: from the same start one target ends without a plan, or with a
dear one, and another does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Generic

from scipy.special import ndtr, ndtri

from scp_recon.monte_carlo.estimates import FAILURES, FLIGHTS_MAX
from scp_recon.planning.plan import Aimed, StagedPlan, as_interrupted
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
