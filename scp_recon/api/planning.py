"""Plan a flyby: load, resolve, plan, certify, verify, keep.

`carry_out` is the way of every plan: of `plan` and the command `solve`, of designs and replans, of a
campaign's case, drafts and the page with sliders.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol, Unpack

from pydantic import ValidationError

from formulations.problem.flyby import Iterate
from formulations.registry import FULL
from scp_recon.api.inputs import GUESSES, PlannerArguments, PlanRequest, load, resolve
from scp_recon.api.keeping import Kept, keep
from scp_recon.api.options import PlanOptions
from scp_recon.certification.again import with_pictures, with_safe_drifts
from scp_recon.certification.certify import certify
from scp_recon.certification.flights import Watch as FlightWatch
from scp_recon.certification.largest import LEAST, Search, largest_promise
from scp_recon.display import exact
from scp_recon.errors import InputError, option
from scp_recon.jobs.cores import one_thread
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import BURNS_TO_MEET
from scp_recon.planning import planner
from scp_recon.planning.initial_guess import from_burns, start_from
from scp_recon.planning.method import ALGORITHM, FORMULATION, SETTLE, NumberOfStarts
from scp_recon.planning.plan import Plan, ended
from scp_recon.planning.records import Parent
from scp_recon.planning.solver import Observer
from scp_recon.planning.stages import DOUBTFUL
from scp_recon.planning.starts import plan_from_several
from scp_recon.replanning.flown import FlownPlan
from scp_recon.replanning.remainder import path_planned, with_free_times
from scp_recon.results.solution import Solution, make_solution
from scp_recon.results.verification import Verification
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status
from scp_recon.verification.causes import refined
from scp_recon.verification.reintegration import verify

REFINEMENTS = 6
"""Times that a plan is made again with shorter integration steps."""
P3_RESOLUTION = 1e-3
"""Relative reduction of the merit at which P3 stops in flight if P2 follows: the end of P3 only
places the facets. Newton's steps then still converge to about 1e-6, with one iteration less."""


@dataclass(frozen=True, eq=False)
class PlanOutcome:
    """A plan, and what was made of it.

    Attributes:
        plan: the plan, on the grid to which planning may have refined its mission.
        stored: the plan as in its file, with its verification and advice; None before that.
        verification: None if the plan was not verified, or planning was interrupted.
        kept: files that were written.
    """

    plan: Plan
    stored: Solution | None = None
    verification: Verification | None = None
    kept: Kept = field(default_factory=Kept)

    @cached_property
    def solution(self) -> Solution:
        """The plan as in its file.

        Raises:
            InputError: if its figures are not finite.
        """
        if self.stored is not None:
            return self.stored
        with finite_figures():
            return make_solution(self.plan)


class PlanObserver(Observer, Protocol):
    """Observes planning, and the flights that certify a plan."""

    @property
    def flights(self) -> FlightWatch:
        """Observer of the flights."""


class Watch:
    """Follows a plan on its way. This one shows and keeps nothing."""

    def folder(self, scenario: Scenario) -> AbstractContextManager[Path | None]:
        """Open the folder where the plan is kept; None if it is not kept."""
        del scenario
        return nullcontext()

    def planning(self, mission: Mission) -> AbstractContextManager[PlanObserver | None]:
        """Begin to observe planning."""
        del mission
        return nullcontext()

    def planned(self, outcome: PlanOutcome) -> None:
        """The plan is made, and kept without verification."""

    def verified(self, outcome: PlanOutcome, request: PlanRequest | None) -> tuple[str, ...]:
        """The plan is verified, and kept; return lines of advice that are kept with it.

        `request` is what was asked for, with its files read, if it is known.
        """
        del outcome, request
        return ()


@one_thread
def carry_out(
    request: PlanRequest, watch: Watch | None = None, *, verifies: bool = True
) -> PlanOutcome:
    """Load, resolve, plan, certify, verify and keep: the way of every plan from its scenario.

    Args:
        request: what to plan, and how.
        watch: shows and keeps the plan; None for neither.
        verifies: whether the plan is verified and kept; else it is only made.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    watch = watch or Watch()
    loaded = load(request)
    mission, start, called = resolve(loaded, request)
    with watch.folder(mission.scenario) as folder:
        with watch.planning(mission) as observe, finite_figures():
            made = plan_mission(
                mission, start, request.options, observe, init=called, **request.known
            )
            made = request.finish(made)
        if not verifies:
            return PlanOutcome(made)
        # A pipe can be read only once.
        is_read = isinstance(loaded.init, str | Path) and loaded.init not in GUESSES
        init = start if is_read else loaded.init
        known = replace(request, scenario=loaded.scenario, init=init, called=called, overrides=())
        return checked(made, folder, watch, known)


def checked(
    made: Plan,
    folder: Path | None = None,
    watch: Watch | None = None,
    request: PlanRequest | None = None,
) -> PlanOutcome:
    """Verify and keep a plan.

    Args:
        made: the plan; if it was interrupted, it is kept without verification.
        folder: for its file; None to keep none.
        watch: shows the plan.
        request: what was asked for, if known.

    Raises:
        InputError: if its figures are not finite, or the folder cannot be written.
    """
    watch = watch or Watch()
    solution = PlanOutcome(made).solution
    # Kept before it is verified, so that an interrupt from here on loses nothing.
    outcome = PlanOutcome(made, solution, kept=keep(solution, folder))
    watch.planned(outcome)
    if made.status is Status.INTERRUPTED:
        return outcome
    verification = verify(made.mission, solution)
    solution = solution.with_verification(verification)
    kept = outcome.kept.then(keep(solution, folder))
    outcome = PlanOutcome(made, solution, verification, kept)
    if not (advice := watch.verified(outcome, request)):
        return outcome
    solution = replace(solution, advice=advice)
    keep(solution, folder)
    return replace(outcome, stored=solution)


@one_thread
def plan_mission(
    mission: Mission,
    start: Iterate | Plan,
    options: PlanOptions,
    observe: PlanObserver | None = None,
    *,
    init: str = "given",
    **known: Unpack[PlannerArguments],
) -> Plan:
    """Plan a mission from a start, and certify the plan by flights if the options require it.

    If integration steps are too long for accurate covariances, the mission is planned again on a finer
    grid before flights certify the plan.

    Args:
        mission: to plan.
        start: initial guess or plan; a single start continues from a plan, several starts begin at
            its burns.
        options: of planning.
        observe: called with the progress of planning.
        init: name of the start in the solution file.
        **known: arguments of `planner.plan` that are known beforehand, for sequential convex
            programming.

    Raises:
        InputError: if an option does not go with the scenario, or the delta-v budget has no plan.
    """
    options.check(mission.scenario)

    def planned(mission: Mission, last: Plan | None) -> Plan:
        return _planned(mission, last or start, options, observe, init, known)

    def safe(mission: Mission, last: Plan | None) -> Plan:
        if not mission.problem.drifts:
            return planned(mission, last)
        return with_safe_drifts(mission, lambda mission, again: planned(mission, again or last))

    if mission.scenario.navigation.landmarks is None or mission.feedback is None:
        return safe(mission, None)
    path = start if isinstance(start, Plan) else planner.plan(mission, start, problem="P3")
    return with_pictures(mission, path.burns_m_s, safe)


def _planned(
    mission: Mission,
    start: Iterate | Plan,
    options: PlanOptions,
    observe: PlanObserver | None,
    init: str,
    known: PlannerArguments,
) -> Plan:
    """See `plan_mission`; drifts are safe by the law alone, or by the losses that the mission has."""
    make = partial(_on_right_grid, _method(options, known))
    probable, number = options.objective == "probability", options.starts_for(mission.scenario)
    if options.starts is None and isinstance(start, Plan):
        number = 1
    if isinstance(start, Plan) and options.method == "ipopt":
        start = from_burns(mission, start.burns_m_s)

    def aimed(mission: Mission, start: Iterate | Plan, target: float, **how: bool) -> Plan:
        return make(mission, start, target=target, init=init, observe=observe, **how)

    certifies, watch = options.is_certified(mission.scenario), observe.flights if observe else None
    if probable:
        given = options.dv_budget_m_s
        search = Search(aimed, float("inf") if given is None else given)
        found = largest_promise(mission, start, search, certified=certifies, watch=watch)
        return _within_budget(found, search.budget_m_s)
    best = None
    if number != 1:
        best = _of_several(mission, start, make, options, number, init, observe)
        if best.status is not Status.CONVERGED or not certifies:
            return best
        mission, start, init = best.mission, best, best.provenance.init
    if not certifies:
        return make(mission, start, init=init, observe=observe)
    found = certify(mission, start, aimed, watch)
    if found.status in (Status.MAX_ITERATIONS, Status.STALLED):  # the next target may have a plan
        again = certify(found.mission, found, aimed, watch)
        found = again if again.status in (Status.CONVERGED, Status.INTERRUPTED) else found
    return replace(found, starts=best.starts) if best else found


def _of_several(
    mission: Mission,
    start: Iterate | Plan,
    make: Callable[..., Plan],
    options: PlanOptions,
    number: NumberOfStarts,
    init: str,
    observe: PlanObserver | None,
) -> Plan:
    """The best plan of several starts, which are asked for or pay after the first one."""
    guess = from_burns(mission, start.burns_m_s) if isinstance(start, Plan) else start
    first = make(mission, guess, init=init, observe=observe)
    if options.starts is None and not _may_be_poor(first):
        return first
    seed, workers = options.seed or 0, options.workers or 1
    return plan_from_several(
        first, make, starts=number, seed=seed, workers=workers, observe=observe
    )


def _may_be_poor(first: Plan) -> bool:
    """Whether further starts pay: of any plan with exact risk, which is planned quickly beside them.

    Evenly split risk is planned from other starts where there is no plan, or a dear one beside P3's.
    """
    if first.status is not Status.CONVERGED or first.mission.risk.allocation == "exact":
        return first.status is not Status.INTERRUPTED
    p3 = first.without_uncertainty
    return p3 is not None and first.total_dv_m_s > DOUBTFUL * p3.total_dv_m_s


def _method(options: PlanOptions, known: PlannerArguments) -> Callable[..., Plan]:
    """The function that makes one plan from one start, on the mission's grid."""
    what: dict[str, Any] = {"problem": options.problem, "facet_rounds": options.facet_rounds}
    if options.method == "ipopt":
        from scp_recon.planning import ipopt  # CasADi takes a second to import

        return partial(ipopt.plan, variant=options.variant, **what)
    return partial(planner.plan, **options.scp._asdict(), **what, **known)


def _on_right_grid(
    make_plan: Callable[..., Plan], mission: Mission, start: Iterate | Plan, **how: Any
) -> Plan:
    """Make a plan; while its integration steps are too long, make it again with shorter ones.

    Each further plan starts from the burns of the one before, and from its gains if it has any. Its
    mission has the finer grid, and a warning about it.
    """
    found = make_plan(mission, start, **how)
    for _ in range(REFINEMENTS):
        if (finer := refined(found)) is None:
            break
        found = make_plan(finer, start_from(finer, found), **how)
    return found


def _within_budget(best: Plan, budget: float) -> Plan:
    """Refuse a budget that allows no plan even for the least probability."""
    if best.status is Status.CONVERGED and best.cost_m_s > budget:
        allowed = f"must be at least {best.cost_m_s:.6f} m/s, which {LEAST} costs"
        raise InputError(option("dv_budget_m_s"), f"{exact(budget)} m/s", allowed)
    return best


@contextmanager
def finite_figures() -> Iterator[None]:
    """Context in which a record that numbers which are not finite do not fit names the scenario."""
    try:
        yield
    except ValidationError:  # which only numbers that are not finite can cause
        raise InputError(
            "scenario",
            "magnitudes for which the dynamics are not finite along the guess",
            "the units of body, boundary and burns must fit together",
        ) from None


# --- the rest of a flight ------------------------------------------------------------------------


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
        "p3_resolution": P3_RESOLUTION if flown.solution.problem == "P2" else 0.0,
        "once": determined,
    }

    def finish(plan: Plan) -> Plan:
        warnings = tuple(dict.fromkeys((*plan.mission.warnings, *mission.warnings)))
        at_s = mission.scenario.start_s
        commanded = flown.commanded(mission.initial_state, at_s)
        commanded_m_s = None if commanded is None else tuple(commanded.tolist())
        parent = Parent(flown.name, flown.solution.plan_hash, at_s, commanded_m_s)
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
        problem=flown.solution.problem,
        facet_rounds=0 if _is_determined(mission) else SETTLE,
        formulation=FORMULATION if exact and made not in FULL else made,
        algorithm=flown.method.algorithm if mission.must_meet else ALGORITHM,
        solver=flown.method.solver,
        certify=certify,
        starts=1,
    )
    options.check(mission.scenario)
    return options
