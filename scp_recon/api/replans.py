"""Plan the rest of a flight from a delivered state, near the plan in flight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy.typing as npt

from formulations.registry import FULL
from scp_recon.api.inputs import check_overrides
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import PlanObserver, plan_mission
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import BURNS_TO_MEET
from scp_recon.planning.method import ALGORITHM, FORMULATION
from scp_recon.planning.plan import Parent, Plan, ended
from scp_recon.planning.stages import CHOICES_MAX
from scp_recon.replanning.delivery import Delivery
from scp_recon.replanning.flown import FlownPlan
from scp_recon.replanning.remainder import mission_left, path_planned
from scp_recon.results.solution import Solution
from scp_recon.scp.status import Status

P3_RESOLUTION = 1e-3
"""Relative reduction of the merit at which P3 stops in flight if P2 follows: the end of P3 only
places the facets. Newton's steps then still converge to about 1e-6, with one iteration less."""


def replan(
    plan: Plan | Solution | str | Path,
    at_s: float,
    state: npt.ArrayLike,
    covariance: npt.ArrayLike | None = None,
    *,
    frame: str = "j2000",
    covariance_frame: str | None = None,
    measured_burns: Mapping[int, npt.ArrayLike] | None = None,
    overrides: Sequence[str] = (),
    certify: bool | None = None,
) -> Plan:
    """Plan the rest of a flight from a state in it.

    Burns at or before that time are flown. The next one keeps the scenario's lead time; the
    rest of the observation window counts. With fewer than two burns left the final state is met as
    nearly as possible: `verify` gives the miss. Beyond three sigma of the final dispersion
    that the flown plan predicts, the status is lost.

    Args:
        plan: the plan in flight; nodes and covariances of a solution are compared with its burns.
        at_s: time of the state past the plan's epoch, s.
        state: after the burns flown, m and m/s, body-centred, shape (6,).
        covariance: of it, m and m/s, shape (6, 6); the scenario's initial one if not given.
        frame: axes of state and measured burns, "j2000" or "sun_north", at the epoch.
        covariance_frame: axes of the covariance, these or "rtn" of the state (default: those of
            `frame`).
        measured_burns: burns flown as telemetry saw them, by their number in the flight from 1, m/s.
        overrides: `section.entry=value` each, as of `load_scenario`, for the rest of the flight; burns
            may be added in `burns.times_s`.
        certify: with risk.allocation = exact, raise the target probability until fresh flights reach
            the required one (default: yes).

    Returns:
        A plan of the remaining burns, whose `parent` names the plan in flight.

    Raises:
        InputError: naming the argument, what was given and what is allowed.

    Examples:
        >>> import scp_recon as sr
        >>> flown = sr.plan()
        >>> left = sr.replan(flown, flown.times_s[80], flown.states[80])
        >>> print(f"{len(left.burns_m_s)} burns, {left.total_dv_m_s:.3f} m/s")
        2 burns, 0.062 m/s
    """
    check_overrides(overrides)
    flown = FlownPlan.of(plan)
    delivery = Delivery.of(
        at_s,
        state,
        frame=frame,
        covariance=covariance,
        covariance_frame=covariance_frame,
        measured=measured_burns,
    )
    mission = mission_left(flown, delivery, overrides)
    return plan_left(flown, mission, certify=certify)


def plan_left(
    flown: FlownPlan,
    mission: Mission,
    *,
    certify: bool | None = None,
    observe: PlanObserver | None = None,
) -> Plan:
    """Plan the rest of a mission near the plan in flight, by the method of that plan.

    With one or two burns left, the final state determines the burns. An infeasible case is then
    infeasible from every start and with all facets, so planning ends at once. A method that cannot
    plan the rest, with exact risk or with a miss of the final state, is replaced by the default. A
    plan that misses the final state by more than `FlownPlan.is_lost` allows ends with the status
    lost.

    Args:
        flown: the plan in flight.
        mission: from `mission_left`.
        certify: as of `PlanOptions`.
        observe: called with the progress of planning.

    Raises:
        InputError: if flights cannot certify a plan.
    """
    options = left_options(flown, mission, certify=certify)
    settled = len(mission.scenario.burn_times_s) <= BURNS_TO_MEET
    plan = plan_mission(
        mission,
        path_planned(flown, mission),
        options,
        observe,
        init=f"the path of {flown.name}",
        p3_resolution=P3_RESOLUTION if flown.problem == "P2" else 0.0,
        choices=0 if settled else CHOICES_MAX,
        once=settled,
    )
    warnings = tuple(dict.fromkeys((*plan.mission.warnings, *mission.warnings)))
    at_s = mission.scenario.start_s
    commanded = flown.commanded(mission.initial_state, at_s)
    commanded_m_s = None if commanded is None else tuple(commanded.tolist())
    parent = Parent(flown.name, flown.plan_hash, at_s, commanded_m_s)
    plan = replace(plan, mission=replace(plan.mission, warnings=warnings), parent=parent)
    if plan.status is Status.CONVERGED and flown.is_lost(plan.states[-1] - mission.final_state):
        return ended(plan, Status.LOST)
    return plan


def left_options(flown: FlownPlan, mission: Mission, *, certify: bool | None) -> PlanOptions:
    """Options for the rest of the flight: those of the plan in flight, as far as they apply.

    Raises:
        InputError: if flights cannot certify it.
    """
    exact = mission.scenario.risk.allocation == "exact"
    made = flown.method.formulation
    options = PlanOptions(
        problem=flown.problem,
        formulation=FORMULATION if exact and made not in FULL else made,
        algorithm=flown.method.algorithm if mission.must_meet else ALGORITHM,
        solver=flown.method.solver,
        certify=certify,
    )
    options.check(mission.scenario)
    return options
