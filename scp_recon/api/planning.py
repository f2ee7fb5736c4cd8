"""Plan a mission by its options: method, number of starts, certification, objective."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol, TypedDict, Unpack

import numpy as np

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.api.inputs import scenario_of
from scp_recon.api.options import PlanOptions
from scp_recon.certification.certify import AimedPlanning, certify
from scp_recon.certification.flights import Watch
from scp_recon.certification.largest import LEAST, Search, largest_promise
from scp_recon.errors import InputError, option, shortened
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess, planner
from scp_recon.planning.initial_guess import from_burns, start_from
from scp_recon.planning.plan import Plan
from scp_recon.planning.starts import plan_from_several
from scp_recon.results.read import read_solution
from scp_recon.results.runs import resolve_run
from scp_recon.results.solution import Solution
from scp_recon.scenario.load import naming_files
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.loop import Record
from scp_recon.scp.status import Status
from scp_recon.verification.refinement import refined


class PlanObserver(Protocol):
    """Observes planning."""

    def __call__(self, stage: str, record: Record, /) -> None:
        """Called after an iteration of a stage."""

    @property
    def flights(self) -> Watch:
        """Observer of the flights that certify a plan."""


class Known(TypedDict, total=False):
    """Arguments of `planner.plan` that are known before planning."""

    target: float | None
    p3_resolution: float
    choices: int
    once: bool


def plan_mission(
    mission: Mission,
    start: Iterate | Plan,
    options: PlanOptions,
    observe: PlanObserver | None = None,
    *,
    init: str = "given",
    **known: Unpack[Known],
) -> Plan:
    """Plan a mission from a start; commands, scripts, campaigns and studies all call this function.

    If integration steps are too long for accurate covariances, the mission is planned again on a
    finer grid (`_on_right_grid`) before flights certify the plan.

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
    work = _ByScp(options, observe, known)
    alone = options.objective != "probability" and (options.starts or 1) == 1
    if options.method == "scp" and alone:
        return work.from_one(mission, start, init)
    if isinstance(start, Plan):
        start = from_burns(mission, start.burns_m_s)
    if options.method == "ipopt":
        from scp_recon.planning import ipopt  # CasADi takes a second to import

        make = partial(ipopt.plan, problem=options.problem, variant=options.variant)
        return _on_right_grid(make, mission, start, init=init, observe=observe)
    if options.objective == "probability":
        return work.largest(mission, start, init)
    return work.from_several(mission, start, init)


def _on_right_grid(
    make_plan: Callable[..., Plan], mission: Mission, start: Iterate | Plan, **how: Any
) -> Plan:
    """Make a plan; if its integration steps are too long, make it again with shorter ones.

    The second plan starts from the burns of the first, and from its gains if it has any. Its
    mission has the finer grid, and a warning about it.
    """
    found = make_plan(mission, start, **how)
    finer = refined(found)
    if finer is None:
        return found
    return make_plan(finer, start_from(finer, found), **how)


@dataclass(frozen=True)
class _ByScp:
    """Plans by sequential convex programming, as options say."""

    options: PlanOptions
    observe: PlanObserver | None
    known: Known

    @property
    def make_plan(self) -> Callable[..., Plan]:
        """Make one plan from one start."""
        method = self.options.scp
        return partial(
            _on_right_grid,
            planner.plan,
            problem=self.options.problem,
            **method._asdict(),
            facet_rounds=self.options.facet_rounds,
            **self.known,
        )

    def aiming(self, init: str) -> AimedPlanning:
        """Make a function that plans for a target probability, for rounds and searches."""
        make_plan = self.make_plan
        return lambda mission, start, target: make_plan(
            mission, start, target=target, init=init, observe=self.observe
        )

    def from_one(self, mission: Mission, start: Iterate | Plan, init: str) -> Plan:
        """Plan from one start, and certify if required."""
        if not self.options.is_certified(mission.scenario):
            return self.make_plan(mission, start, init=init, observe=self.observe)
        watch = self.observe.flights if self.observe else None
        return certify(mission, start, self.aiming(init), watch)

    def from_several(self, mission: Mission, start: Iterate, init: str) -> Plan:
        """Keep the best plan of several starts, and certify from there if required."""
        best = plan_from_several(
            mission,
            start,
            self.make_plan,
            starts=self.options.starts or 1,
            seed=self.options.seed or 0,
            workers=self.options.workers or 1,
            init=init,
            seen=self._show_start,
        )
        if not self.options.is_certified(mission.scenario) or best.status is not Status.CONVERGED:
            return best
        certified = self.from_one(best.mission, best, best.provenance.init)
        return replace(certified, starts=best.starts)

    def largest(self, mission: Mission, start: Iterate, init: str) -> Plan:
        """Find the plan with the largest probability within the budget.

        Raises:
            InputError: if the budget allows no plan even for the least probability.
        """
        given = self.options.dv_budget_m_s
        budget = float("inf") if given is None else given
        best = largest_promise(
            mission,
            start,
            Search(self.aiming(init), budget),
            certified=self.options.is_certified(mission.scenario),
            watch=self.observe.flights if self.observe else None,
        )
        if best.status is Status.CONVERGED and best.cost_m_s > budget:
            raise InputError(
                option("dv_budget_m_s"),
                f"{budget:g} m/s",
                f"must be at least {best.cost_m_s:.6f} m/s, which {LEAST} costs",
            )
        return best

    def _show_start(self, number: int, found: Plan) -> None:
        """Show the last iteration of each stage."""
        if self.observe is None:
            return
        for stage in found.stages:
            for record in stage.result.records[-1:]:
                self.observe(f"{number} {stage.name}", record)


def plan(
    scenario: Scenario | str | Path | None = None,
    init: Plan | Solution | str | Path | Array = "cold",
    *,
    problem: Literal["P3", "P2"] = "P2",
    method: Literal["scp", "ipopt"] = "scp",
    formulation: str | None = None,
    algorithm: str | None = None,
    solver: str | None = None,
    facet_rounds: int = 0,
    certify: bool | None = None,
    objective: Literal["delta-v", "probability"] = "delta-v",
    dv_budget_m_s: float | None = None,
    starts: int | None = None,
    seed: int | None = None,
    workers: int | None = None,
    overrides: Sequence[str] = (),
) -> Plan:
    """Plan a flyby.

    Args:
        scenario: a file, complete or with base = another, or the packaged recon_b; other packaged ones
            go with `design` (default: that of `init`, else recon_b).
        init: "cold", a straight line; "warm", a ballistic arc; a plan, a solution or its folder; a CSV
            of states, or such a table as an array (n, 7): t, x, y, z, vx, vy, vz, J2000, SI.
        problem: "P2", with uncertainty, or "P3", without it.
        method: "scp", sequential convex programming, or "ipopt", the nonlinear programs by IPOPT.
        formulation: with scp condensed, lifted, frozen-stm or frozen-covariance (default: condensed);
            with ipopt printed, tuned or shooting (default: tuned).
        algorithm: with scp scvx, ptr or scvx-star (default: scvx).
        solver: with scp a conic solver that CVXPY finds: CLARABEL and SCS; ECOS and QOCO with the extra
            [compare] (default: CLARABEL).
        facet_rounds: choose the facets again at the solution and solve again, up to this many times; an
            infeasible case is tried again in any case.
        certify: with risk.allocation = exact, raise the target probability until fresh flights reach
            the required one (default: yes).
        objective: the least "delta-v"; or with risk.allocation = exact the largest "probability",
            whatever risk.p_chance says.
        dv_budget_m_s: with `objective` probability, largest delta-v of the plan, as policy.cost counts
            it, m/s (default: no limit).
        starts: plan from `init`, and from random flights for the other starts; list the distinct
            local optima and keep the best (default: 1).
        seed: of the random flights (default: 0).
        workers: processes for the starts; the plan does not depend on their number (default: 1).
        overrides: `section.entry=value` each, as of `load_scenario`.

    Returns:
        The plan, not verified yet: `status` says whether it converged, `total_dv_m_s` is its delta-v.
        Burns (m, 3), states (n, 6) and covariances (n, 6, 6) are in J2000, m and m/s.

    Raises:
        InputError: naming the entry, what was given and what is allowed.

    Examples:
        >>> import scp_recon as sr
        >>> found = sr.plan(sr.load_scenario("recon_b").replace({"risk.p_chance": 0.8}))
        >>> print(found.status.value.name, f"{found.total_dv_m_s:.3f} m/s")
        converged 0.155 m/s
    """
    options = PlanOptions(
        problem=problem,
        method=method,
        formulation=formulation,
        algorithm=algorithm,
        solver=solver,
        facet_rounds=facet_rounds,
        certify=certify,
        objective=objective,
        dv_budget_m_s=dv_budget_m_s,
        starts=starts,
        seed=seed,
        workers=workers,
    )
    mission, start = inputs(scenario, init, overrides)
    options.check(mission.scenario)
    return plan_mission(mission, start, options, init=_called(init))


def inputs(
    scenario: Scenario | str | Path | None,
    init: Plan | Solution | str | Path | Array,
    overrides: Sequence[str] = (),
) -> tuple[Mission, Iterate]:
    """Make the mission and the start from arguments of `plan`.

    Raises:
        InputError: if an argument is not valid, or a file cannot be used.
    """
    if isinstance(init, str | Path) and init not in ("cold", "warm") and is_solution(Path(init)):
        init = read_solution(Path(init))
    if scenario is None:
        scenario = "recon_b"
        if isinstance(init, Plan):
            scenario = init.mission.scenario
        elif isinstance(init, Solution):
            scenario = init.scenario
    with naming_files(scenario, overrides):
        mission = Mission.from_scenario(scenario_of(scenario, overrides))
    return mission, _start(mission, init)


def _called(init: Plan | Solution | str | Path | Array) -> str:
    """Name of a start in the solution file."""
    if isinstance(init, np.ndarray):
        return "a table"
    return {Plan: "a plan", Solution: "a solution"}.get(type(init), str(init))


def _start(mission: Mission, init: Plan | Solution | str | Path | Array) -> Iterate:
    """Make the initial guess from a name, a plan, a file or a table of states.

    Args:
        mission: gives the grid and the boundary.
        init: "cold", a straight line; "warm", a ballistic arc; a plan or a solution, whose burns
            are flown; a CSV of states, or these as an array t, x, y, z, vx, vy, vz,
            J2000, SI, shape (n, 7).

    Raises:
        InputError: if it is none of these, or the file or the table is unusable.
    """
    entry = option("init")
    if isinstance(init, np.ndarray):
        return initial_guess.from_states(mission, init, entry)
    if isinstance(init, Plan | Solution):
        return initial_guess.from_burns(mission, init.burns_m_s, entry)
    if not isinstance(init, str | Path):
        allowed = "must be cold, warm, a file, a plan or an array of shape (n, 7)"
        raise InputError(entry, shortened(init), allowed)
    if init == "cold":
        return initial_guess.cold(mission)
    if init == "warm":
        return initial_guess.ballistic(mission, entry)
    return initial_guess.from_table(mission, Path(init), entry)


def is_solution(path: Path) -> bool:
    """Whether a path is a folder, or a file of JSON by its first brace; tables have none."""
    path = resolve_run(path)
    try:
        if path.is_dir() or path.suffix == ".json":
            return True
        if not path.is_file():  # a pipe can be read only once
            return False
        with path.open("rb") as file:
            return file.read(100).lstrip().startswith(b"{")
    except (OSError, ValueError):  # which the reader explains
        return False
