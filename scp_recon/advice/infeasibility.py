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
from itertools import pairwise

import numpy as np

from scp_recon.advice.trials import (
    CONE,
    CORRECTED,
    DIRECTIONS,
    FINAL_SPREAD,
    FINAL_STATE,
    FREE_CONE_DEG,
    LARGEST,
    LIMITS,
    MORE_BURNS,
    PROBABILITY,
    RETURN,
    SIZE,
    SPLIT,
    Case,
    Changes,
    Clock,
    Remedy,
    limits_violated,
    rounded,
    spreads_of,
    violated_by,
)
from scp_recon.api.inputs import PlanRequest
from scp_recon.api.planning import carry_out
from scp_recon.certification.flights import fly_plan, run_test
from scp_recon.jobs.cores import one_thread
from scp_recon.monte_carlo.estimates import flights_of_test
from scp_recon.planning.plan import Plan
from scp_recon.results.verification import Verification
from scp_recon.scp.status import Status
from scp_recon.verification.causes import Cause, kind_of, needed_step_s

STEEPER = (0.9, 0.75, 0.5, 0.25)
"""Factors on a probability's complement, tried one after the other where flights reach too little."""

CONTINUED, CERTIFIED = "continuing from this solution", "certification by flights"
FINER, STRICTER = "a finer grid", "a higher probability"
EXECUTED, UNCORRECTED = "the least burn", "burns without corrections"
TARGET = "the target of the certificate"

FEEDBACK = {
    "policy.kind": "feedback",
    "navigation.sigma_position_m": 5.0,
    "navigation.sigma_velocity_m_s": 0.0005,
}
"""Feedback as it is tried where the scenario has no measurements of its own."""

Trials = Iterator[tuple[str, Callable[[str], Remedy | None]]]
"""Names of what is tried, and trials that find a remedy of that name."""


def relaxations(case: Case, p3: Status) -> Trials:
    """Trials of an infeasible plan: of what is violated and of what gives up nothing first.

    Risk may be what makes the plan infeasible unless P3, which has none, is infeasible too.
    """
    scenario, violated = case.scenario, violated_by(case.failed)
    is_risky = case.request.options.problem == "P2" and p3 is not Status.INFEASIBLE
    cone = scenario.battery.delta_v_cone_deg, FREE_CONE_DEG
    burns = {
        "dv_max": (SIZE, partial(case.relaxed, {}, sized=True)),
        "dv_battery": (DIRECTIONS, partial(case.relaxed, {CONE: cone})),
    }
    if is_risky and scenario.risk.allocation == "uniform":
        yield SPLIT, partial(case.first, [{"risk.allocation": "exact"}])
        if case.remedies:
            return  # nothing else has to be given up
    yield from (trial for name, trial in burns.items() if name in violated)
    if is_risky and spreads_of(scenario):
        yield FINAL_SPREAD, partial(case.relaxed, spreads_of(scenario))
    limits, sized = limits_violated(scenario, violated), "dv_max" in violated
    if len(limits) > 1 or (limits and sized):
        yield f"{LIMITS} together", partial(case.relaxed, limits, sized=sized)
    for entry, ends in limits.items():
        yield f"{LIMITS}: {entry}", partial(case.relaxed, {entry: ends})
    if case.request.is_in_flight and case.failed.mission.observed_s is not None:
        yield RETURN, partial(case.first, [{"observation.required": False}])
    yield from (trial for name, trial in burns.items() if name not in violated)
    case.miss = case.clock.attempt(FINAL_STATE, case.final_miss)
    if not is_risky:
        return
    yield PROBABILITY, case.likeliest
    if case.scenario.policy.kind == "open":
        measures = case.scenario.navigation.measures
        changes: dict[str, object] = {"policy.kind": "feedback"} if measures else dict(FEEDBACK)
        if case.scenario.risk.allocation != "exact":
            changes["risk.allocation"] = "exact"
        yield CORRECTED, partial(case.first, [changes])


def rescues(case: Case) -> Trials:
    """Trials of a lost flight: burns added to its rest, and the rest without its observation."""
    scenario = case.scenario
    times = list(scenario.burns.times_s)
    ends = [scenario.start_s, *(t for t in times if t > scenario.start_s)]
    apart = min(late - early for early, late in pairwise(times))
    several = [
        sorted([*times, float(round(begin + share * (end - begin)))])
        for share in (0.5, 0.25, 0.75)
        for begin, end in pairwise(ends)
    ]
    several += [[*times, *(times[-1] + k * apart for k in range(1, n + 1))] for n in (1, 2)]
    yield MORE_BURNS, partial(case.first, [{"burns.times_s": one} for one in several])
    if not case.remedies and case.failed.mission.observed_s is not None:
        yield RETURN, partial(case.first, [{"observation.required": False}])


def repairs(case: Case, verification: Verification | None) -> Trials:
    """Trials of a plan without a verdict, or of one whose verification fails, by its checks."""
    mission, scenario, options = case.failed.mission, case.scenario, case.request.options
    kinds = {Cause.STATUS}
    if verification is not None and "status" not in verification.failed:
        kinds = {kind_of(name, mission, verification) for name in verification.failed}
    risk, burns = scenario.risk, scenario.burns
    if kinds & {Cause.STATUS, Cause.BURNS, Cause.CONTRADICTION} and not case.request.is_in_flight:
        yield CONTINUED, partial(_continued, case)
    if kinds & {Cause.STATUS, Cause.GRID, Cause.BETWEEN}:
        apart = float(np.diff(mission.times_s).max())
        steps = [float(math.floor(apart / n)) for n in (2, 4)]
        if verification is not None and Cause.GRID in kinds:
            steps.insert(0, needed_step_s(mission, verification))
        finer: list[Changes] = [{"grid.step_max_s": step} for step in steps if step >= 1.0]
        yield FINER, partial(case.first, finer)
    uniform = options.problem == "P2" and risk.allocation == "uniform"
    if kinds & {Cause.STATUS, Cause.SHORT} and uniform:
        yield SPLIT, partial(case.first, [{"risk.allocation": "exact"}])
    if (
        kinds & {Cause.BY_LAW, Cause.DRIFT}
        and risk.allocation == "exact"
        and options.certify is False
    ):
        yield CERTIFIED, partial(case.confirmed, {}, certified=True)
    if kinds & {Cause.SHORT, Cause.BY_LAW}:
        yield STRICTER, partial(case.first, _steeper("risk.p_chance", risk.p_chance))
    if Cause.SPREAD in kinds:
        yield FINAL_SPREAD, partial(case.relaxed, spreads_of(scenario))
    if Cause.COMMANDS in kinds:
        larger = [{LARGEST: rounded(f * burns.dv_max_m_s)} for f in (1.1, 1.25, 1.5, 2.0)]
        yield SIZE, partial(case.first, larger)
        yield UNCORRECTED, partial(case.first, [{"policy.kind": "open"}])
    if Cause.UNEXECUTED in kinds:
        sizes = np.linalg.norm(case.failed.burns_m_s, axis=1)
        least = {"burns.dv_min_m_s": rounded(float(sizes[sizes > 0.0].min()), up=False)}
        yield EXECUTED, partial(case.first, [least])
    entry = "safety.drift_probability"
    if Cause.DRIFT in kinds and (asked := scenario.safety.drift_probability) is not None:
        yield STRICTER, partial(case.first, _steeper(entry, asked))
    if kinds & {Cause.STATUS, Cause.CERTIFICATE} and case.failed.target is not None:
        below = [1.0 - rounded((1.0 - risk.p_chance) * f, digits=1) for f in (1.1, 1.5, 2.0, 4.0)]
        lower = dict.fromkeys(round(p, 9) for p in below if 0.5 < p < risk.p_chance)
        yield TARGET, partial(case.first, [{"risk.p_chance": p} for p in lower])


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


def _continued(case: Case, name: str) -> Remedy | None:
    """The user's command, started from the plan that failed; a certification goes on by itself."""
    options = case.request.options
    if options.is_certified(case.scenario) and options.objective == "delta-v":
        return None
    outcome = carry_out(replace(case.request, init=case.failed), case.clock)
    ok = outcome.verification is not None and outcome.verification.ok
    return Remedy.of(name, {}, outcome.plan) if ok else None


def _steeper(entry: str, asked: float) -> list[Changes]:
    """Higher probabilities than asked, one after the other."""
    return [{entry: round(1.0 - rounded((1.0 - asked) * f), 9)} for f in STEEPER]


TIMES, LEAST_S = 3.0, 30.0
"""Limit of a diagnosis: so many times the processor time of the plan, at least so many seconds."""

SHARE = 0.25
SHARES = {SPLIT: 0.8, PROBABILITY: 0.5, CORRECTED: 1.0}
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
    lost, share = failed.status is Status.LOST, None
    if failed.status is Status.INFEASIBLE:
        trials = relaxations(case, p3)
    else:
        share = None if lost else kept(case)
        trials = rescues(case) if lost else repairs(case, verification)
    for name, work in trials:
        remedy = clock.attempt(name, partial(work, name), 1.0 if lost else SHARES.get(name, SHARE))
        case.remedies += [remedy] if remedy else []
    return Diagnosis(
        p3,
        tuple(case.remedies),
        tuple(clock.tried),
        tuple(clock.left_out),
        clock.limit_s,
        case.miss,
        share,
        case.largest,
    )


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
