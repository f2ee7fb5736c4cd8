"""Diagnose an infeasible plan: find the limits that bind, and a probability that is feasible.

Binding limits are found by relaxing one kind at a time: the size of the burns, their directions,
the final state, the state limits. The largest probability is that of exact risk, which allows every
plan that another split of the risk allows. Every trial is a local search. A trial without a plan
therefore does not prove that no plan exists.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, Unpack

import numpy as np
from scipy.special import ndtr, ndtri

from formulations.problem.flyby import FlybyProblem, Iterate
from scp_recon.api.inputs import Known
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.certification.largest import MOST, largest_kept, rounded_down
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.plan import Plan
from scp_recon.results.solution import make_solution
from scp_recon.scp.status import Status
from scp_recon.verification.reintegration import verify

LEAST = 0.501
"""Least probability of the search: a scenario requires more than one half."""

CLOSE = 0.02
"""Standard deviations between the largest probability with a plan and the next without: a hint."""

TRIES = ((False, 0.0), (True, 0.0), (True, 0.1), (True, 0.25))
"""Whether flights certify the proposed plan, and standard deviations by which its probability is
below the largest. If flights refute a plan, they also refute a plan for less with no higher target.
A certified plan has a higher target."""

FREE = 100.0
"""Factor on the largest burn if the size of burns is relaxed."""

FREE_CONE, FREE_MISS = 1e-6, 1e-3
"""Half-angle, rad, of the cones that burns avoid if their directions are relaxed, and price of a
miss if the final state is relaxed."""

SIZE, DIRECTIONS = "the size of the burns", "the directions of the burns"
FINAL_STATE, LIMITS = "the final state", "the limits"
FINAL_SPREAD = "the limits on the final covariance"
SPLIT = "the polytopes and the split of the risk"

FREED: dict[str, Callable[[FlybyProblem], FlybyProblem]] = {
    SIZE: lambda problem: replace(problem, dv_max=FREE * problem.dv_max),
    DIRECTIONS: lambda problem: replace(problem, dv_cone=FREE_CONE),
    FINAL_STATE: lambda problem: replace(problem, miss_weight=FREE_MISS),
    LIMITS: lambda problem: replace(problem, constraints=()),
    FINAL_SPREAD: lambda problem: replace(problem, final_spread=(None, None)),
}
"""Functions that relax one kind of limit of a problem, by name."""


@dataclass(frozen=True)
class Diagnosis:
    """Diagnosis of an infeasible plan: the limits that bind, and a probability that is feasible.

    Attributes:
        without_uncertainty: how P3 ended, at best.
        binds: limits of which relaxing any one suffices; empty if no single one suffices.
        violated: constraints that the point of least violation violates.
        burn_m_s: largest burn of a plan without a limit on the burns' size, if relaxing that limit
            suffices.
        exact: the plan with exact risk for the required probability, if there is one.
        largest: the plan with the largest probability found, which is its `target`; None if there
            is none.
        verified: a verified plan with exact risk, if any: for the required probability, or for the
            largest, rounded down. It is certified only if flights refute the uncertified plan.
    """

    without_uncertainty: Status
    binds: tuple[str, ...]
    violated: tuple[str, ...]
    burn_m_s: float | None = None
    exact: Plan | None = None
    largest: Plan | None = None
    verified: Plan | None = None


def diagnose(failed: Plan, start: Iterate | None = None) -> Diagnosis:
    """Find the limits that make a plan infeasible, and a plan that is feasible.

    Args:
        failed: an infeasible plan.
        start: initial guess of the proposed plan; None for the solution of P3.
    """
    p3 = _without_uncertainty(failed)
    status, iterate = p3.status, p3.final.result.lin.iterate
    if failed.final.problem == "P3" or status is Status.INFEASIBLE:
        some = tuple(name for name in FREED if name != FINAL_SPREAD)
        freed = {name: plan for name in some if (plan := _freed(p3, name))}
        return Diagnosis(status, tuple(freed), _violated(p3), _largest_burn(freed))
    risk = failed.mission.scenario.risk
    wanted, required = failed.target or risk.p_chance, min(risk.p_chance, failed.target or 1.0)
    uniform = risk.allocation == "uniform"
    trial = None
    if uniform or wanted > required:
        trial = exact_plan(failed.mission, iterate, required)
    exact = trial if trial and _has_converged(trial) else None
    violated, freed = _violated(failed), {}
    binds: tuple[str, ...] = (SPLIT,)
    if not (uniform and exact):
        last = trial if uniform and trial else failed
        violated = _violated(last)
        # Whole flights take ten times as long where the final state is free.
        some = (SIZE, FINAL_STATE) if risk.scope == "node" else (SIZE,)
        spread = last.mission.problem.final_spread != (None, None)
        some = (*some, FINAL_SPREAD) if spread else some
        freed = {name: plan for name in some if (plan := _freed(last, name))}
        # What is left, where the final covariance alone is not too large.
        binds = tuple(freed) if FINAL_SPREAD in freed else (*freed, LIMITS)
    most = required if exact is None else max(wanted, MOST) if uniform else wanted
    low = exact or exact_plan(failed.mission, iterate, LEAST)
    largest = largest_feasible(low, most) if _has_converged(low) else None
    verified = largest and _verified(largest, required, failed, start or iterate)
    return Diagnosis(status, binds, violated, _largest_burn(freed), exact, largest, verified)


def exact_plan(mission: Mission, start: Iterate, target: float) -> Plan:
    """Plan with exact risk, from one start only; the mission requires the target probability."""
    changes = {"risk.allocation": "exact", "risk.p_chance": target}
    exact = Mission.from_scenario(mission.scenario.replace(changes))
    return _planned(exact, start, "P2", once=True)


def largest_feasible(low: Plan, most: float) -> Plan:
    """The plan of the largest probability that is found.

    Args:
        low: a plan with exact risk for its target probability.
        most: probability above which no plan is sought.
    """

    def attempt(best: Plan, target: float) -> Plan:
        return exact_plan(best.mission, best.final.result.lin.iterate, target)

    return _uninterrupted(largest_kept(low, most, CLOSE, attempt, _has_converged)[0])


def _without_uncertainty(failed: Plan) -> Plan:
    """The plan of P3: a converged one among the stages of the infeasible plan, or a new one."""
    own = [s for s in failed.stages if s.problem == "P3" and s.spec.role != "open"]
    if not own:
        return _planned(failed.mission, failed.final.result.lin.iterate, "P3")
    order = (Status.CONVERGED, Status.MAX_ITERATIONS, Status.STALLED, Status.SOLVER_FAILED)
    ranked = {status: rank for rank, status in enumerate(order)}
    # What is infeasible from every start comes last: one that did not end shows nothing.
    best = min(own, key=lambda stage: ranked.get(stage.result.status, len(order)))
    return replace(failed, final=best)


def _freed(failed: Plan, name: str) -> Plan | None:
    """The plan with one kind of limit relaxed, if there is one."""
    mission = replace(failed.mission)
    # No scenario asks for such a problem: it takes the place of the one that this copy would cache.
    vars(mission)["problem"] = FREED[name](failed.mission.problem)
    start, problem = failed.final.result.lin.iterate, failed.final.problem
    plan = _planned(mission, start, problem, target=failed.target, once=True)
    return plan if _has_converged(plan) else None


def _verified(largest: Plan, required: float, failed: Plan, start: Iterate) -> Plan | None:
    """The plan with exact risk as the command makes it; a certified one if flights refute it."""
    assert largest.target is not None
    names = failed.provenance if failed.provenance.method == "scp" else largest.provenance
    most = min(required, largest.target)
    for certified, less in TRIES:
        p = most if most == required and less == 0.0 else rounded_down(ndtr(ndtri(most) - less))
        if p <= 0.5:
            return None
        mission = Mission.from_scenario(largest.mission.scenario.replace({"risk.p_chance": p}))
        if len(start.mean) != len(mission.times_s):  # its grid is finer than that of the start
            start = from_burns(mission, start.burns * mission.units.speed_m_s)
        options = PlanOptions(algorithm=names.algorithm, solver=names.solver, certify=certified)
        try:
            plan = _uninterrupted(plan_mission(mission, start, options))
        except InputError:  # no flights certify so much
            continue
        if _has_converged(plan) and verify(plan.mission, make_solution(plan)).ok:
            return plan
    return None


def _planned(
    mission: Mission, start: Iterate, problem: Literal["P3", "P2"], **known: Unpack[Known]
) -> Plan:
    """Plan without certification by flights."""
    exact = problem == "P2" and mission.scenario.risk.allocation == "exact"
    options = PlanOptions(problem, certify=False if exact else None)
    return _uninterrupted(plan_mission(mission, start, options, **known))


def _uninterrupted(plan: Plan) -> Plan:
    """Return the plan unless it was interrupted.

    Raises:
        KeyboardInterrupt: if it was interrupted.
    """
    if plan.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return plan


def _has_converged(plan: Plan) -> bool:
    return plan.status is Status.CONVERGED


def _violated(plan: Plan) -> tuple[str, ...]:
    """Names of the constraints that the point of least violation violates."""
    merit, tolerance = plan.final.merit, plan.final.tolerance
    violations = merit.violations(plan.final.result.lin)
    return tuple(
        FINAL_STATE if name == "dynamics" else name
        for name, amount in violations.items()
        if amount.max(initial=0.0) > tolerance
    )


def _largest_burn(freed: dict[str, Plan]) -> float | None:
    if SIZE not in freed:
        return None
    return float(np.linalg.norm(freed[SIZE].burns_m_s, axis=1).max())
