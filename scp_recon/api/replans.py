"""Plan the rest of a flight from a delivered state, near the plan in flight."""

from __future__ import annotations

from dataclasses import replace

from formulations.registry import FULL
from scp_recon.api.inputs import PlannerArguments, PlanRequest
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import carry_out
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import BURNS_TO_MEET
from scp_recon.planning.method import ALGORITHM, FORMULATION, SETTLE
from scp_recon.planning.plan import Plan, ended
from scp_recon.planning.records import Parent
from scp_recon.replanning.flown import FlownPlan
from scp_recon.replanning.remainder import path_planned
from scp_recon.replanning.retiming import with_free_times
from scp_recon.scp.status import Status

P3_RESOLUTION = 1e-3
"""Relative reduction of the merit at which P3 stops in flight if P2 follows: the end of P3 only
places the facets. Newton's steps then still converge to about 1e-6, with one iteration less."""


def plan_left(
    flown: FlownPlan, mission: Mission, *, certify: bool | None = None, free_times: bool = False
) -> Plan:
    """Plan the rest of a mission: see `request_of_rest`."""
    request = request_of_rest(flown, mission, certify=certify, free_times=free_times)
    return carry_out(request, verifies=False).plan


def request_of_rest(
    flown: FlownPlan, mission: Mission, *, certify: bool | None, free_times: bool = False
) -> PlanRequest:
    """What to plan: the rest of a mission near the plan in flight, by the method of that plan.

    With one or two burns left, the final state determines the burns. An infeasible case is then
    infeasible from every start and with all facets, so planning ends at once. A method that cannot
    plan the rest, with exact risk or with a miss of the final state, is replaced by the default. A
    plan that misses the final state by more than `FlownPlan.is_lost` allows ends with the status
    lost.

    Args:
        flown: the plan in flight.
        mission: from `mission_left`.
        certify: as of `PlanOptions`.
        free_times: whether burns that are left may move: see `with_free_times`.

    Raises:
        InputError: if flights cannot certify a plan, or no burn may move.
    """
    options = left_options(flown, mission, certify=certify)
    mission = with_free_times(flown, mission) if free_times else mission
    determined = _is_determined(mission)
    known: PlannerArguments = {
        "p3_resolution": P3_RESOLUTION if flown.problem == "P2" else 0.0,
        "once": determined,
    }

    def finish(plan: Plan) -> Plan:
        warnings = tuple(dict.fromkeys((*plan.mission.warnings, *mission.warnings)))
        at_s = mission.scenario.start_s
        commanded = flown.commanded(mission.initial_state, at_s)
        commanded_m_s = None if commanded is None else tuple(commanded.tolist())
        parent = Parent(flown.name, flown.plan_hash, at_s, commanded_m_s)
        plan = replace(plan, mission=replace(plan.mission, warnings=warnings), parent=parent)
        if plan.status is Status.CONVERGED and flown.is_lost(plan.states[-1] - mission.final_state):
            return ended(plan, Status.LOST)
        return plan

    start, called = path_planned(flown, mission), f"the path of {flown.name}"
    return PlanRequest(mission, start, options, called=called, known=known, finish=finish)


def _is_determined(mission: Mission) -> bool:
    """Whether the final state determines the burns that are left."""
    return len(mission.scenario.burn_times_s) <= BURNS_TO_MEET


def left_options(flown: FlownPlan, mission: Mission, *, certify: bool | None) -> PlanOptions:
    """Options for the rest of the flight: those of the plan in flight, as far as they apply.

    Raises:
        InputError: if flights cannot certify it.
    """
    exact = mission.scenario.risk.allocation == "exact"
    made = flown.method.formulation
    options = PlanOptions(
        problem=flown.problem,
        facet_rounds=0 if _is_determined(mission) else SETTLE,
        formulation=FORMULATION if exact and made not in FULL else made,
        algorithm=flown.method.algorithm if mission.must_meet else ALGORITHM,
        solver=flown.method.solver,
        certify=certify,
        starts=1,
    )
    options.check(mission.scenario)
    return options
