"""Plans from Python: a first one, and what is left of one in flight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from formulations.problem.flyby import Iterate
from scp_recon.certification.certify import certify
from scp_recon.errors import InputError, one_of, shortened, whole_number
from scp_recon.in_flight.delivery import Delivery
from scp_recon.in_flight.parent import FlownPlan
from scp_recon.in_flight.replanning import mission_left, replan
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.certifying import flights_needed
from scp_recon.planning import planner
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.method import FACET_ROUNDS_MAX, PROBLEMS, check_exact, scp_method
from scp_recon.planning.plan import Plan
from scp_recon.planning.starts import SEED_MAX, STARTS_MAX, WORKERS_MAX, plan_from_several
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status
from scp_recon.solution.file import Solution
from scp_recon.solution.start import start_from

Array = npt.NDArray[np.float64]


def plan(
    scenario: Scenario | str | Path = "recon_b",
    init: Plan | str | Path | Array = "cold",
    *,
    problem: Literal["P3", "P2"] = "P2",
    formulation: str = "condensed",
    algorithm: str = "scvx",
    solver: str = "CLARABEL",
    facet_rounds: int = 0,
    certified: bool | None = None,
    starts: int = 1,
    seed: int = 0,
    workers: int = 1,
) -> Plan:
    """Plan a flyby.

    >>> import scp_recon as sr
    >>> found = sr.plan(sr.load_scenario("recon_b").replace({"risk.p_chance": 0.8}))
    >>> print(found.status.value.name, f"{found.total_dv_m_s:.3f} m/s")
    converged 0.155 m/s

    Args:
        scenario: what to plan; the name of a packaged one, or a file.
        init: "cold", a straight line; "warm", a ballistic arc; a plan, a solution or its folder; a CSV
            of states, or such a table as an array (n, 7): t, x, y, z, vx, vy, vz, J2000, SI.
        problem: with uncertainty (P2) or without (P3).
        formulation: condensed, lifted, frozen-stm or frozen-covariance.
        algorithm: scvx, ptr or scvx-star.
        solver: a conic solver that CVXPY finds.
        facet_rounds: how often to choose the facets again at the solution.
        certified: with exact risk, whether to plan until flights certify the probability; they do
            unless it is False.
        starts: the plan is the best from `init` and from so many random flights less one; its `starts`
            lists the distinct local optima.
        seed: of the random flights.
        workers: processes for the starts; the plan does not depend on their number.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    one_of("problem", problem, PROBLEMS)
    method = scp_method(formulation, algorithm, solver)
    whole_number("facet_rounds", facet_rounds, 0, FACET_ROUNDS_MAX)
    whole_number("starts", starts, 1, STARTS_MAX)
    whole_number("seed", seed, 0, SEED_MAX)
    whole_number("workers", workers, 1, WORKERS_MAX)
    mission = Mission.from_scenario(_scenario(scenario))
    if mission.scenario.risk.allocation == "exact":
        check_exact("scp", method.formulation, facet_rounds)
    to_certify = is_to_certify(mission, problem, certified)

    make_plan = partial(
        planner.plan,
        problem=problem,
        formulation=method.formulation,
        algorithm=method.algorithm,
        solver=method.solver,
        facet_rounds=facet_rounds,
    )
    start, called = start_from(mission, init), _called(init)
    best = None
    if starts > 1:
        best = plan_from_several(
            mission, start, make_plan, starts=starts, seed=seed, workers=workers, init=called
        )
        if not to_certify or best.status is not Status.CONVERGED:
            return best
        start, called = from_burns(mission, best.burns_m_s), best.provenance.init

    def once(mission: Mission, start: Iterate, aim: float | None = None) -> Plan:
        return make_plan(mission, start, aim=aim, init=called)

    found = certify(mission, start, once) if to_certify else once(mission, start)
    return replace(found, starts=best.starts) if best else found


def plan_again(
    plan: Plan | Solution | str | Path,
    at_s: float,
    state: npt.ArrayLike,
    covariance: npt.ArrayLike | None = None,
    *,
    frame: str = "j2000",
    covariance_frame: str | None = None,
    measured_burns: Mapping[int, npt.ArrayLike] | None = None,
    overrides: Sequence[str] = (),
    certified: bool | None = None,
) -> Plan:
    """Plan what is left of a flight from a state in it.

    Burns at or before that time are flown. The next one keeps the scenario's decision lead time; what
    is left of the observation window counts. With fewer than two burns left the final state is met as
    nearly as they can: `check` says how much is missed.

    >>> import scp_recon as sr
    >>> flown = sr.plan()
    >>> left = sr.plan_again(flown, flown.times_s[80], flown.states[80])
    >>> print(f"{len(left.burns_m_s)} burns, {left.total_dv_m_s:.3f} m/s")
    2 burns, 0.062 m/s

    Args:
        plan: that is flown; nodes and spread of a solution, or its file, are held against its burns.
        at_s: time of the state past the plan's epoch, s.
        state: after the burns flown, m and m/s, body-centred, shape (6,).
        covariance: of it, m and m/s, shape (6, 6); the scenario's initial one if not given.
        frame: axes of state and measured burns, "j2000" or "sun_north", at the epoch.
        covariance_frame: axes of the covariance, these or "rtn" of the state; `frame` if not given.
        measured_burns: burns flown as telemetry saw them, by their number in the flight from 1, m/s.
        overrides: `section.entry=value` each, as of `load_scenario`, for what is left.
        certified: as in `plan`.

    Returns:
        A plan of the burns that are left, whose `parent` names the one that is flown.

    Raises:
        InputError: naming the argument, what was given and what is allowed.
    """
    if isinstance(overrides, str) or not all(isinstance(text, str) for text in overrides):
        raise InputError("overrides", shortened(overrides), "must be a list of section.entry=value")
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
    to_certify = is_to_certify(mission, flown.problem, certified)
    return replan(flown, mission, certified=to_certify)


def is_to_certify(mission: Mission, problem: str, certified: bool | None) -> bool:
    """Whether flights have to stand behind a plan.

    Raises:
        InputError: if they cannot, or would be too many.
    """
    exact = mission.scenario.risk.allocation == "exact" and problem == "P2"
    if certified not in (None, True, False):
        raise InputError("certified", shortened(certified), "must be True, False or None")
    if certified is not None and not exact:
        raise InputError(
            "certified",
            shortened(certified),
            "goes with risk.allocation = exact and problem P2 only",
        )
    if exact and certified is not False:
        flights_needed(mission.scenario.risk.p_chance, "certified=False")
        return True
    return False


def _scenario(given: Scenario | str | Path) -> Scenario:
    if isinstance(given, Scenario):
        return given
    if not isinstance(given, str | Path):
        raise InputError("scenario", shortened(given), "must be a scenario, its name, or a file")
    return load_scenario(given)


def _called(init: Plan | str | Path | Array) -> str:
    """What the solution file calls a start."""
    if isinstance(init, np.ndarray):
        return "a table"
    return "a plan" if isinstance(init, Plan) else str(init)
