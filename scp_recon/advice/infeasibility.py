"""Diagnose a plan that failed: values with which the user's command ends verified, within a time.

Every trial is a local search. A trial without a plan therefore does not prove that no plan exists.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from scp_recon.advice.clock import Clock
from scp_recon.advice.repairs import kept, repairs
from scp_recon.advice.trials import (
    FINAL_STATE,
    MORE_BURNS,
    PROBABILITY,
    RETURN,
    SPLIT,
    Case,
    Remedy,
)
from scp_recon.api.inputs import PlanRequest
from scp_recon.jobs.blas import one_thread
from scp_recon.planning.plan import Plan
from scp_recon.results.verification import Verification
from scp_recon.scp.status import Status

TIMES, LEAST_S = 3.0, 30.0
"""Limit of a diagnosis: so many times the processor time of the plan, at least so many seconds."""

SHARE = 0.25
SHARES = {SPLIT: 0.8, PROBABILITY: 0.5}
"""Shares of all time that a trial may take, and those of the dearer ones."""

LEAST_TRIAL_S, WORTH_SAYING = 1.0, 1e-3
"""Least limit of time for a plan with exact risk beside a verified one, and the share of its delta-v
that exact risk has to save."""


@dataclass(frozen=True)
class Diagnosis:
    """Diagnosis of a failed plan.

    Attributes:
        without_uncertainty: how P3 ended, at best.
        remedies: each of them suffices.
        tried: what was tried without success.
        left_out: what the time did not suffice for.
        limit_s: that time, of the processor.
        miss: of the final state in m and m/s, if a plan exists that misses it.
        kept: share of flights of the plan that kept every limit, by its certificate.
        largest: the largest probability that was found to have a plan, by the normal law.
    """

    without_uncertainty: Status
    remedies: tuple[Remedy, ...] = ()
    tried: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    limit_s: float = LEAST_S
    miss: tuple[float, float] | None = None
    kept: float | None = None
    largest: float | None = None


@one_thread
def diagnose(
    failed: Plan,
    request: PlanRequest,
    spent_s: float = 0.0,
    show: Callable[[str], None] | None = None,
    verification: Verification | None = None,
) -> Diagnosis:
    """Find values with which the user's command has a verified plan.

    Args:
        failed: a plan that is not verified.
        request: of the user's command.
        spent_s: processor time that planning took.
        show: called with what is tried, and with its time.
        verification: of the plan; its failed checks say what is tried for a converged plan.
    """
    clock = Clock(max(TIMES * spent_s, LEAST_S), show=show)
    case = Case(failed, request, clock)
    p3 = _without_uncertainty(failed)
    known = Diagnosis(p3, limit_s=clock.limit_s)
    if failed.status is Status.LOST:
        remedies = [clock.attempt(MORE_BURNS, case.more_burns)]
        if not remedies[0] and failed.mission.observed_s is not None:
            remedies.append(clock.attempt(RETURN, case.going_home))
    elif failed.status is not Status.INFEASIBLE:
        known = replace(known, kept=kept(case))
        remedies = [
            clock.attempt(name, work, SHARES.get(name, SHARE))
            for name, work in repairs(case, verification)
        ]
    else:
        remedies = []
        for name, work in case.trials(p3):
            remedies.append(clock.attempt(name, work, SHARES.get(name, SHARE)))
            if name == SPLIT and remedies[-1]:
                break  # nothing else has to be given up
        else:
            known = replace(known, miss=clock.attempt(FINAL_STATE, case.final_miss))
            for name, work in case.longer_trials(p3):
                remedies.append(clock.attempt(name, work, SHARES.get(name, 1.0)))
        known = replace(known, largest=case.largest)
    found = tuple(remedy for remedy in remedies if remedy)
    return replace(known, remedies=found, tried=tuple(clock.tried), left_out=tuple(clock.left_out))


@one_thread
def cost_of_exact_risk(made: Plan, request: PlanRequest, spent_s: float = 0.0) -> float | None:
    """Delta-v of a verified plan's mission with exact risk, by the normal law, m/s.

    None if no such plan is found within `SHARE` of the time that planning took, if it costs as much,
    or if the plan's risk is not split evenly. Plans with feedback or drifts are not tried.

    Args:
        made: the verified plan.
        request: of the user's command.
        spent_s: processor time that planning took.
    """
    risk, open_loop = made.mission.risk, made.mission.scenario.policy.kind == "open"
    if made.final.problem != "P2" or risk.allocation != "uniform" or not open_loop:
        return None
    if made.mission.problem.drifts:
        return None
    case = Case(made, request, Clock(max(SHARE * spent_s, LEAST_TRIAL_S)))
    found = case.clock.attempt(SPLIT, partial(case.rough, {"risk.allocation": "exact"}))
    if found is None or found.cost_m_s > (1.0 - WORTH_SAYING) * made.cost_m_s:
        return None
    return found.cost_m_s


def _without_uncertainty(failed: Plan) -> Status:
    """How P3 ended, at best: what is infeasible from every start comes last."""
    order = (Status.CONVERGED, Status.MAX_ITERATIONS, Status.STALLED, Status.SOLVER_FAILED)
    ranked = {status: number for number, status in enumerate(order)}
    own = [s.result.status for s in failed.stages if s.problem == "P3" and s.spec.role != "open"]
    # A plan that continued from another has no P3 of its own; the other had one.
    return min(own, key=lambda status: ranked.get(status, len(order)), default=Status.CONVERGED)
