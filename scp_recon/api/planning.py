"""Plan a flyby: load, resolve, plan, certify, verify, keep.

`carry_out` is the way of every plan: of `plan` and the command `solve`, of designs and replans, of a
campaign's case, drafts and the page with sliders.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol

from pydantic import ValidationError

from formulations.problem.flyby import Iterate
from scp_recon.api.files import keep
from scp_recon.api.inputs import PlanRequest, RestOfFlight, resolve
from scp_recon.api.options import VARIANT, PlanOptions
from scp_recon.certification.again import with_pictures, with_safe_drifts
from scp_recon.certification.certify import certify
from scp_recon.certification.flights import Watch as FlightWatch
from scp_recon.certification.largest import LEAST, Search, largest_promise
from scp_recon.display import exact
from scp_recon.errors import InputError, option
from scp_recon.jobs.cores import one_thread
from scp_recon.mission.mission import Mission
from scp_recon.planning import planner
from scp_recon.planning.initial_guess import from_burns, start_from
from scp_recon.planning.method import NumberOfStarts
from scp_recon.planning.plan import Plan
from scp_recon.planning.solver import Observer
from scp_recon.planning.stages import DOUBTFUL
from scp_recon.planning.starts import plan_from_several
from scp_recon.replanning.flown import FlownPlan
from scp_recon.replanning.remainder import Delivery
from scp_recon.results.solution import Solution, make_solution
from scp_recon.results.verification import Verification
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status
from scp_recon.verification.causes import refined
from scp_recon.verification.reintegration import verify

REFINEMENTS = 6
"""Times that a plan is made again with shorter integration steps."""


@dataclass(frozen=True, eq=False)
class PlanOutcome:
    """A plan, and what was made of it.

    Attributes:
        plan: the plan, on the grid to which planning may have refined its mission.
        stored: the plan as in its file, with its verification and advice; None before that.
        path: of that file, if it is kept.
        aside: results of other plans in its folder, under the names that they have now.
    """

    plan: Plan
    stored: Solution | None = None
    path: Path | None = None
    aside: tuple[Path, ...] = ()

    @property
    def verification(self) -> Verification | None:
        """None if the plan was not verified, or planning was interrupted."""
        return None if self.stored is None else self.stored.verification

    @cached_property
    def solution(self) -> Solution:
        """The plan as in its file."""
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

    def kept(self, outcome: PlanOutcome, request: PlanRequest) -> tuple[str, ...]:
        """The plan is kept, verified unless interrupted; return advice that is kept with it.

        `request` is what was asked for, with its files read.
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
        verifies: whether the plan is verified and kept; else it is only made. A plan that was
            interrupted is kept without verification.
    """
    watch = watch or Watch()
    mission, start, asked, known = resolve(request)
    with watch.folder(mission.scenario) as folder:
        with watch.planning(mission) as observe, finite_figures():
            made = plan_mission(mission, start, asked.options, observe, init=asked.called, **known)
            if isinstance(request.scenario, RestOfFlight):
                made = request.scenario.finished(made, mission)
        outcome = PlanOutcome(made)
        if not verifies:
            return outcome
        # Kept before it is verified, so that an interrupt from here on loses nothing.
        outcome = PlanOutcome(made, outcome.solution, *keep(outcome.solution, folder))
        if made.status is not Status.INTERRUPTED:
            verification = verify(made.mission, outcome.solution)
            solution = outcome.solution.with_verification(verification)
            path, aside = keep(solution, folder)
            outcome = PlanOutcome(made, solution, path, outcome.aside + aside)
        if not (advice := watch.kept(outcome, asked)):
            return outcome
        solution = replace(outcome.solution, advice=advice)
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
    **known: Any,
) -> Plan:
    """Plan a mission from a start, and certify the plan by flights if the options require it.

    If integration steps are too long for accurate covariances, the mission is planned again on a finer
    grid before flights certify the plan. A single start continues from a plan, several starts begin at
    its burns. `init` names the start in the solution file; `known` are arguments of `planner.plan` that
    are known beforehand, for sequential convex programming.

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
    known: Mapping[str, Any],
) -> Plan:
    """See `plan_mission`; drifts are safe by the law alone, or by the losses that the mission has."""
    what: dict[str, Any] = {"problem": options.problem, "facet_rounds": options.facet_rounds}
    if options.method == "ipopt":
        from scp_recon.planning import ipopt  # CasADi takes a second to import

        make = partial(
            _on_right_grid, partial(ipopt.plan, variant=options.formulation or VARIANT, **what)
        )
    else:
        method = options.scp._asdict()
        make = partial(_on_right_grid, partial(planner.plan, **method, **what, **known))
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
        if found.status is Status.CONVERGED and found.cost_m_s > search.budget_m_s:
            allowed = f"must be at least {found.cost_m_s:.6f} m/s, which {LEAST} costs"
            raise InputError(option("dv_budget_m_s"), f"{exact(search.budget_m_s)} m/s", allowed)
        return found
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
    """The best plan of several starts, which are asked for or pay after the first one.

    Further starts pay for any plan with exact risk, which is planned quickly beside them. Evenly split
    risk is planned from other starts where there is no plan, or a dear one beside P3's.
    """
    guess = from_burns(mission, start.burns_m_s) if isinstance(start, Plan) else start
    first = make(mission, guess, init=init, observe=observe)
    p3, uniform = first.without_uncertainty, first.mission.risk.allocation != "exact"
    is_dear = p3 is not None and first.total_dv_m_s > DOUBTFUL * p3.total_dv_m_s
    is_good = first.status is Status.CONVERGED and uniform and not is_dear
    if options.starts is None and (is_good or first.status is Status.INTERRUPTED):
        return first
    seed, workers = options.seed or 0, options.workers or 1
    return plan_from_several(
        first, make, starts=number, seed=seed, workers=workers, observe=observe
    )


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


def plan_left(
    flown: FlownPlan,
    delivery: Delivery,
    overrides: Sequence[str] = (),
    *,
    certify: bool | None = None,
    free_times: bool = False,
) -> Plan:
    """Plan the rest of a flight from a delivered state: see `RestOfFlight` and `PlanOptions`."""
    rest, options = RestOfFlight(flown, delivery, free_times), PlanOptions(certify=certify)
    return carry_out(PlanRequest(rest, options=options, overrides=overrides), verifies=False).plan
