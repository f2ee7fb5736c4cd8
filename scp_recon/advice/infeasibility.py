"""Diagnose a failed plan: find, within a limit of time, values with which the command ends verified.

Every trial is a local search. A trial without a plan therefore does not prove that no plan exists.

What may mend a plan without a verdict, or one whose verification fails, follows from the checks that
fail.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from scp_recon.advice.clock import Clock
from scp_recon.advice.trials import (
    FINAL_SPREAD,
    FINAL_STATE,
    LARGEST,
    MORE_BURNS,
    PROBABILITY,
    RETURN,
    SIZE,
    SPLIT,
    Case,
    Changes,
    Remedy,
    rounded,
)
from scp_recon.api.inputs import PlanRequest
from scp_recon.api.planning import carry_out
from scp_recon.certification.flights import fly_plan, run_test
from scp_recon.jobs.cores import one_thread
from scp_recon.monte_carlo.estimates import flights_of_test
from scp_recon.planning.plan import Plan
from scp_recon.results.verification import Verification
from scp_recon.scp.status import Status
from scp_recon.verification.causes import (
    BETWEEN,
    BURNS,
    BY_LAW,
    CERTIFICATE,
    COMMANDS,
    CONTRADICTION,
    DRIFT,
    GRID,
    SHORT,
    SPREAD,
    STATUS,
    UNEXECUTED,
    kind_of,
    needed_step_s,
)

STEEPER = (0.9, 0.75, 0.5, 0.25)
"""Factors on a probability's complement, tried one after the other where flights reach too little."""

CONTINUED, CERTIFIED = "continuing from this solution", "certification by flights"
FINER, STRICTER = "a finer grid", "a higher probability"
EXECUTED, UNCORRECTED = "the least burn", "burns without corrections"
TARGET = "the target of the certificate"


def repairs(
    case: Case, verification: Verification | None
) -> Iterator[tuple[str, Callable[[], Remedy | None]]]:
    """Trials of a plan without a verdict, or of one whose verification fails, by its checks."""
    mission, scenario, options = case.failed.mission, case.scenario, case.request.options
    kinds = {STATUS}
    if verification is not None and STATUS not in verification.failed:
        kinds = {kind_of(name, mission, verification) for name in verification.failed}
    risk, burns = scenario.risk, scenario.burns
    if kinds & {STATUS, BURNS, CONTRADICTION} and case.request.remade is None:
        yield CONTINUED, partial(_continued, case)
    if kinds & {STATUS, GRID, BETWEEN}:
        apart = float(np.diff(mission.times_s).max())
        steps = [float(math.floor(apart / n)) for n in (2, 4)]
        if verification is not None and GRID in kinds:
            steps.insert(0, needed_step_s(mission, verification))
        finer: list[Changes] = [{"grid.step_max_s": step} for step in steps if step >= 1.0]
        yield FINER, partial(case.first, FINER, finer)
    uniform = options.problem == "P2" and risk.allocation == "uniform"
    if kinds & {STATUS, SHORT} and uniform:
        yield SPLIT, partial(case.confirmed, SPLIT, {"risk.allocation": "exact"})
    if kinds & {BY_LAW, DRIFT} and risk.allocation == "exact" and options.certify is False:
        yield CERTIFIED, partial(case.confirmed, CERTIFIED, {}, certified=True)
    if kinds & {SHORT, BY_LAW}:
        yield STRICTER, partial(case.first, STRICTER, _steeper("risk.p_chance", risk.p_chance))
    if SPREAD in kinds:
        yield FINAL_SPREAD, case.final_spread
    if COMMANDS in kinds:
        larger = [{LARGEST: rounded(f * burns.dv_max_m_s)} for f in (1.1, 1.25, 1.5, 2.0)]
        yield SIZE, partial(case.first, SIZE, larger)
        yield UNCORRECTED, partial(case.confirmed, UNCORRECTED, {"policy.kind": "open"})
    if UNEXECUTED in kinds:
        sizes = np.linalg.norm(case.failed.burns_m_s, axis=1)
        least = {"burns.dv_min_m_s": rounded(float(sizes[sizes > 0.0].min()), up=False)}
        yield EXECUTED, partial(case.confirmed, EXECUTED, least)
    entry = "safety.drift_probability"
    if DRIFT in kinds and (asked := scenario.safety.drift_probability) is not None:
        yield STRICTER, partial(case.first, STRICTER, _steeper(entry, asked))
    if kinds & {STATUS, CERTIFICATE} and case.failed.target is not None:
        yield TARGET, partial(_lower_promise, case)


def kept(case: Case) -> float | None:
    """Share of flights that keep every limit with a plan that has none certified, or whose test."""
    if case.failed.certificate is not None:
        return case.failed.certificate.reached
    if case.failed.target is None or case.failed.status is Status.CONVERGED:
        return None

    def reached() -> float:
        flights = flights_of_test(case.scenario.risk.p_chance)
        tested, _ = run_test(case.failed, partial(fly_plan, case.clock.flights), flights, 1, 1)
        assert tested.certificate is not None
        return tested.certificate.reached

    return case.clock.attempt("flights of this plan", reached)


def _continued(case: Case) -> Remedy | None:
    """The user's command, started from the plan that failed; a certification goes on by itself."""
    options = case.request.options
    if options.is_certified(case.scenario) and options.objective == "delta-v":
        return None
    outcome = carry_out(replace(case.request, init=case.failed), case.clock)
    ok = outcome.verification is not None and outcome.verification.ok
    return Remedy.of(CONTINUED, {}, outcome.plan) if ok else None


def _lower_promise(case: Case) -> Remedy | None:
    """The largest of some lower probabilities that flights certify."""
    required = case.scenario.risk.p_chance
    below = [1.0 - rounded((1.0 - required) * factor, digits=1) for factor in (1.1, 1.5, 2.0, 4.0)]
    tries = dict.fromkeys(round(p, 9) for p in below if 0.5 < p < required)
    return case.first(TARGET, [{"risk.p_chance": p} for p in tries])


def _steeper(entry: str, asked: float) -> list[Changes]:
    """Higher probabilities than asked, one after the other."""
    return [{entry: round(1.0 - rounded((1.0 - asked) * f), 9)} for f in STEEPER]


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
