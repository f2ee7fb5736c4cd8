"""The plan of what is left: a mission of its own, from the state that was delivered.

Its scenario is that of the plan that is flown with a table `in_flight`, so that whatever plans,
verifies or flies a mission serves it as well. Planning begins at the path that was planned, and goes
the whole way from there, P3 first. Facets chosen on that path cost 15 % more delta-v from 3000 s on: it
was planned for a spread that a newly determined state does not have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from formulations.problem.flyby import Iterate
from scp_recon.certification.certify import Watch, certify
from scp_recon.errors import InputError
from scp_recon.in_flight.delivery import Delivery
from scp_recon.in_flight.parent import FlownPlan
from scp_recon.in_flight.prediction import predict
from scp_recon.mission.in_flight import BURNS_TO_MEET
from scp_recon.mission.mission import Mission
from scp_recon.mission.states import state_axes
from scp_recon.physics.flow import propagate
from scp_recon.planning import planner
from scp_recon.planning.method import ALGORITHM, FORMULATION
from scp_recon.planning.plan import Plan
from scp_recon.planning.provenance import Parent
from scp_recon.planning.stages import CHOICES_MAX, Observer
from scp_recon.scenario.load import override
from scp_recon.scenario.schema import Scenario

P3_RESOLUTION = 1e-3
"""Relative reduction of the merit at which P3 stops where P2 follows: its end only places the facets.

Newton's steps make of it some 1e-6 of what they begin with, and an iteration less.
"""

KEPT = ("epoch", "in_flight")
"""Tables that no override may change: they say what the delivered state is of."""


def mission_left(flown: FlownPlan, delivery: Delivery, overrides: Sequence[str] = ()) -> Mission:
    """What is left of a mission, with the warnings of the flight so far.

    Args:
        flown: the plan that is flown.
        delivery: the state.
        overrides: `section.entry=value` each, of what is left.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    before = flown.mission.scenario
    delivery = delivery.measured_in(state_axes(before, flown.mission.rotation, delivery.frame))
    at = delivery.at_s
    if at < before.start_s:
        raise InputError(
            delivery.name("at_s"),
            f"{at:g} s",
            f"must not be before {before.start_s:g} s past its epoch, where the plan begins",
        )
    burns = delivery.burns_flown(before, flown.burns_m_s)
    data: dict[str, Any] = before.model_dump(mode="json", exclude_none=True)
    data["in_flight"] = {
        "at_s": at,
        "frame": delivery.frame,
        "position_m": delivery.state[:3].tolist(),
        "velocity_m_s": delivery.state[3:].tolist(),
        "covariance_frame": delivery.covariance_frame,
        "flown_m_s": burns,
    }
    if delivery.covariance is not None:
        data["in_flight"]["covariance"] = delivery.covariance.tolist()
    try:
        scenario = _changed(Scenario.validated(data), overrides)
        mission = Mission.from_scenario(scenario, known=flown.mission)
    except InputError as error:
        entry = _renamed(error.entry, delivery)
        raise InputError(entry, error.given, error.allowed) from None
    kept = before.burns.times_s[: len(burns)]
    if scenario.burns.times_s[: len(burns)] != kept or scenario.burns_flown != len(burns):
        raise InputError(
            "burns.times_s", "other times of burns that are flown", f"must keep {kept}"
        )
    predicted = predict(flown, at, delivery.measured)
    renamed = [
        w.model_copy(update={"entry": _renamed(w.entry, delivery)})
        for w in mission.warnings
        if w not in flown.mission.warnings
    ]
    found = (
        *flown.mission.warnings,
        *renamed,
        *flown.warnings,
        *flown.strange(),
        *delivery.strange_burns(before, flown.burns_m_s),
        *delivery.strange_state(
            mission.initial_state, mission.initial_factor, predicted, mission.units.state
        ),
    )
    return replace(mission, warnings=tuple(dict.fromkeys(found)))


def _changed(scenario: Scenario, overrides: Sequence[str]) -> Scenario:
    changed = override(scenario, overrides)
    for table in KEPT:
        if getattr(changed, table) != getattr(scenario, table):
            raise InputError("--set", f"another {table}", "must leave the flight so far as it was")
    return changed


def _renamed(entry: str, delivery: Delivery) -> str:
    """What the user calls an entry of the table `in_flight`."""
    table, _, key = entry.partition(".")
    if table != "in_flight":
        return entry
    key = key.partition(".")[0]
    called = {"position_m": "state", "velocity_m_s": "state", "flown_m_s": "measured_burns"}
    return delivery.name(called.get(key, key))


def path_planned(flown: FlownPlan, mission: Mission) -> Iterate:
    """The path that was planned, at the nodes of what is left.

    Raises:
        InputError: if there are other burns left than the plan has.
    """
    ahead = [t > mission.scenario.start_s for t in flown.mission.scenario.burn_times_s]
    burns = flown.burns_m_s[ahead]
    if len(burns) != len(mission.burn_nodes):
        raise InputError(
            "burns.times_s",
            f"{len(mission.burn_nodes)} burns left",
            f"must leave the {len(burns)} of the plan that is flown",
        )
    last = np.searchsorted(flown.times_s, mission.times_s, side="right") - 1
    since = mission.times_s - flown.times_s[last]
    states = propagate(flown.states[last], since, mission.forces, mission.arc_substeps)
    return Iterate(burns / mission.units.speed_m_s, states / mission.units.state)


def replan(
    flown: FlownPlan,
    mission: Mission,
    *,
    certified: bool = True,
    observe: Observer | None = None,
    watch: Watch | None = None,
) -> Plan:
    """Plan what is left of a mission, near the plan that is flown and as that was made.

    With two burns left, or one, the final state leaves no choice of burns. What is infeasible is that
    wherever planning begins and whichever facets stand for the limits: it ends at once. A method that
    cannot plan what is left, be it of exact risk or of a miss, gives way to the default.

    Args:
        flown: that plan.
        mission: from `mission_left`.
        certified: with exact risk, whether to plan until flights certify the probability.
        observe: called after each iteration with the stage's name and the record.
        watch: is told how certifying goes on.

    Raises:
        InputError: if there are other burns left than the plan has.
    """
    parent = Parent(flown.name, flown.plan_hash, mission.scenario.start_s)
    exact = mission.scenario.risk.allocation == "exact" and flown.problem == "P2"
    settled = len(mission.scenario.burn_times_s) <= BURNS_TO_MEET

    def once(mission: Mission, start: Iterate, aim: float | None = None) -> Plan:
        return planner.plan(
            mission,
            start,
            problem=flown.problem,
            formulation=FORMULATION if exact else flown.method.formulation,
            algorithm=flown.method.algorithm if mission.must_meet else ALGORITHM,
            solver=flown.method.solver,
            aim=aim,
            p3_resolution=P3_RESOLUTION if flown.problem == "P2" else 0.0,
            choices=0 if settled else CHOICES_MAX,
            init=f"the path of {flown.name}",
            observe=observe,
            once=settled,
        )

    start = path_planned(flown, mission)
    to_certify = exact and certified
    plan = certify(mission, start, once, watch) if to_certify else once(mission, start)
    warnings = tuple(dict.fromkeys((*plan.mission.warnings, *mission.warnings)))
    return replace(plan, mission=replace(plan.mission, warnings=warnings), parent=parent)
