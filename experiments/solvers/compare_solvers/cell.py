"""Solve and measure one cell of the comparison: a row of the table."""

from __future__ import annotations

import importlib
import resource
from dataclasses import dataclass, replace
from itertools import pairwise
from time import process_time
from typing import ClassVar, Self

import numpy as np

from experiments.solvers.compare_solvers.cases import (
    EVERY_NODE,
    NLP_SOLVERS,
    REFERENCE,
    UNGUARDED,
    UNO,
    Cell,
    Method,
    start_of,
)
from experiments.solvers.compare_solvers.exact.check import check, rolled_out
from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import choose_facets
from formulations.problem.flyby import FlybyProblem
from formulations.program.subproblem import MeritFunction, Penalty, PenaltyParameters, Subproblem
from formulations.rows.uniform import ChanceRows
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.planning import initial_guess
from scp_recon.planning.missions import make_plan, other_starts
from scp_recon.planning.plan import Plan, Provenance, StageSpec
from scp_recon.planning.planner import Planner, screened
from scp_recon.planning.stages import Pipeline, StageSolver
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.loop import Record, State, Timing, record_of, trial_step
from scp_recon.scp.status import Status

for form in ("condensed", "lifted"):
    # With CVXPY, which the copy of this process that solves a cell need not import again.
    importlib.import_module(f"formulations.program.{form}")

FAILED = "failed"
"""Status of a cell that was ended or failed."""


@dataclass(frozen=True)
class Row:
    """A cell and its results; empty figures are NaN.

    Attributes:
        key, group, scenario, start, seed, formulation, algorithm, solver: the cell.
        status: a `Status` by name, or `FAILED`.
        detail: reason of a failure.
        problem: "P2", or "P3" if P3 was not solved.
        total_dv_m_s: sum of the burns.
        merit_m_s: with the exact penalty of SCvx, first weight; IPOPT's burns are flown first, because
            gaps between its arcs cost next to nothing there.
        heavy_merit_m_s: with its second weight, which infeasible cases end with.
        violation_m: largest violation; velocities count as metres per unit of time. With exact risk it
            is of the final state and of the limits on the burns alone.
        iterations_p3, iterations_p2: the latter over all facet restorations; evaluations of the
            references of exact risk.
        first_status: of the first try, where another was made.
        from_arc: whether the answer is a later try's, from the ballistic arc or a turn.
        total_s: from the guess, or from SCP's P3 solution, to the end, with building of programs but
            without imports.
        cpu_s: processor time of that, which other work on the machine does not lengthen.
        setup_s: of total_s, building programs and solvers.
        solver_s: of total_s, in the conic solver, or in IPOPT without its evaluations.
        peak_mib: resident memory of the process, imports included.
        observed_s: mean observation time of many flights.
        burns_m_s: all components.
        asked: required probability, with exact risk.
        reached: probability by the check, at the worst node or of whole flights.
        reached_error: its standard error.
        limit_s: limit of processor time.
        version: release of the package that solved it.
    """

    key: str
    group: str
    scenario: str
    start: str
    seed: int
    formulation: str
    algorithm: str
    solver: str
    status: str
    detail: str = ""
    problem: str = ""
    total_dv_m_s: float = np.nan
    merit_m_s: float = np.nan
    heavy_merit_m_s: float = np.nan
    violation_m: float = np.nan
    iterations_p3: int = 0
    iterations_p2: int = 0
    first_status: str = ""
    from_arc: bool = False
    total_s: float = np.nan
    cpu_s: float = np.nan
    setup_s: float = np.nan
    solver_s: float = np.nan
    peak_mib: float = np.nan
    observed_s: float = np.nan
    burns_m_s: tuple[float, ...] = ()
    asked: float = np.nan
    reached: float = np.nan
    reached_error: float = np.nan
    limit_s: float = np.nan
    version: str = ""

    @property
    def method(self) -> str:
        """Name of the method."""
        return Method(self.formulation, self.algorithm, self.solver).name

    @property
    def solved_at_once(self) -> bool:
        """Whether it was solved at the first try."""
        return self.solved and not self.first_status

    @property
    def solved(self) -> bool:
        """Whether P2 converged and every constraint holds."""
        return self.problem == "P2" and self.status == Status.CONVERGED.value.name


def failed_row(cell: Cell, reason: str, cpu_s: float = np.nan) -> Row:
    """The row of a cell that was ended or failed."""
    return replace(empty_row(cell), detail=reason, cpu_s=cpu_s)


def empty_row(cell: Cell) -> Row:
    """A row without figures."""
    method = cell.method
    return Row(
        key=cell.key,
        group=cell.group,
        scenario=cell.scenario,
        start=cell.start,
        seed=cell.seed,
        formulation=method.formulation,
        algorithm=method.algorithm,
        solver=method.solver,
        status=FAILED,
    )


def solve_cell(cell: Cell, flights: int) -> Row:
    """Solve a cell in this process; `flights` sampled flights, if any, give the observation time."""
    mission = Mission.from_scenario(load_scenario(cell.base, cell.overrides))
    for name in _needs(cell.method):
        importlib.import_module(name)
    done, cpu_s = (_from_p3 if cell.start == "p3" else _whole)(mission, cell)
    peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # on Linux, so far
    row = replace(_of_plan(cell, done, cpu_s), peak_mib=peak_kib / 1024.0)
    lin, merit = done.final.result.lin, done.final.merit
    if not lin.is_dynamically_feasible:
        # A nonlinear program may end with gaps between its arcs, which no flight has.
        lin = rolled_out(mission, lin.iterate.burns)
    return judged(row, mission, lin, merit, flights)


def judged(
    row: Row, mission: Mission, lin: Linearisation, merit: MeritFunction, flights: int
) -> Row:
    """A row with its flight's cost, violation and, by `flights` samples if any, observation time."""
    speed, weights, observed = mission.units.speed_m_s, SCvx(), np.nan
    burns = lin.iterate.burns * speed
    if flights:
        flown = fly_many(FlightConfig(mission, burns), samples=flights)
        observed = flown.held[ALL].mean().value
    return replace(
        row,
        problem="P2" if isinstance(merit.rows, ChanceRows) else "P3",
        total_dv_m_s=lin.iterate.total_dv * speed,
        merit_m_s=merit(lin, weights.weight) * speed,
        heavy_merit_m_s=merit(lin, weights.weight_max) * speed,
        violation_m=merit.worst_violation(lin) * mission.units.length_m,
        observed_s=observed,
        burns_m_s=_components(burns),
    )


def _needs(method: Method) -> tuple[str, ...]:
    """Modules that a method imports late; they are imported before its time is taken."""
    return ("scp_recon.planning.ipopt" if method.solver in NLP_SOLVERS else method.solver.lower(),)


def _whole(mission: Mission, cell: Cell) -> tuple[Plan, float]:
    """Plan P3, facets and P2 by one method; returns processor time in s as well."""
    start, method = start_of(mission, cell), cell.method
    begin = process_time()
    if method.solver in NLP_SOLVERS:
        run = Pipeline(mission, _solver_of_rows(mission, method))
        provenance = Provenance(method.formulation, method.algorithm, method.solver, cell.start)
        others = other_starts(mission)
        done = make_plan(mission, run, lambda: run.plan(start, "P2", others), provenance)
    else:
        names = (method.formulation, method.algorithm, method.solver)
        done = plan_mission(mission, start, PlanOptions("P2", "scp", *names))
    return done, process_time() - begin


def _of_plan(cell: Cell, done: Plan, cpu_s: float) -> Row:
    """The row of a plan with effort and status; its burns are judged later."""
    names = [stage.name for stage in done.stages for _ in stage.result.records]
    tries = ((a.result.status.value.name, bool(b.spec.start)) for a, b in pairwise(done.stages))
    return replace(
        empty_row(cell),
        status=done.status.value.name,
        iterations_p3=sum(name.startswith("P3") for name in names),
        iterations_p2=sum(name.startswith("P2") for name in names),
        first_status=next((first for first, again in tries if again), ""),
        from_arc=bool(done.final.spec.start),
        total_s=done.total_s,
        cpu_s=cpu_s,
        setup_s=done.timing.setup,
        solver_s=done.timing.conic_solver,
    )


def _from_p3(mission: Mission, cell: Cell) -> tuple[Plan, float]:
    """Solve P2 from SCP's P3 solution with its facets, restoring facets found violated."""
    start = start_of(mission, cell)
    stages = plan_mission(mission, start, PlanOptions(problem="P3")).stages
    p3 = [one for one in stages if one.spec.role != "held"][-1].result.lin
    problem = mission.problem
    facets = choose_facets(problem, mission.polytopes, p3.iterate.mean, p3.factor)
    clearance = np.inf if cell.method == EVERY_NODE else mission.clearances[0]
    included = screened(facets, p3, clearance)
    run = Pipeline(mission, _solver_of_rows(mission, cell.method))
    provenance = Provenance(
        cell.method.formulation, cell.method.algorithm, cell.method.solver, "p3"
    )
    rows, cpu_begin = ChanceRows(problem, facets, included), process_time()
    done = make_plan(mission, run, lambda: run.solve(StageSpec("P2", rows), p3), provenance)
    return done, process_time() - cpu_begin


def _solver_of_rows(mission: Mission, method: Method) -> StageSolver:
    """The solver of P2 by a method."""
    if method.solver in NLP_SOLVERS:
        from formulations.nlp.solve import BY_UNO, VARIANTS
        from scp_recon.planning.ipopt import IpoptStages, casadi_arcs

        variant = BY_UNO if method.solver == UNO else VARIANTS[method.formulation]
        arcs = casadi_arcs(mission.flow)
        return IpoptStages(mission, arcs, variant, method.algorithm == "elastic")
    unguarded = Unguarded(mission.problem) if method.algorithm == UNGUARDED else None
    name = "scvx" if unguarded else method.algorithm  # of the same penalty
    form = "lifted" if method == EVERY_NODE else method.formulation
    planner = Planner(mission, formulation=form, algorithm=name, solver=method.solver)
    planner.algorithm = unguarded or planner.algorithm
    return planner


# --- without a safeguard ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Unguarded:
    """An `Algorithm` without safeguards: it linearises, solves and flies, and accepts every answer.

    Frozen covariances are used in this scheme: Rizza, Topputo et al. propagate the covariance with
    the previous solution, so that the convex program may be infeasible where the problem is not;
    Echigo et al. call that artificial infeasibility. The ratio tests of `scp_recon` prevent it.
    """

    problem: FlybyProblem

    penalty: ClassVar[Penalty] = "exact"
    feasible: ClassVar[float] = 1e-6
    max_iterations: ClassVar[int] = 20
    WEIGHT, STEP = 1e4, 1e-5

    def init(self, subproblem: Subproblem, lin: Linearisation) -> State:
        """Start from the guess, with a trust region so large that it never binds."""
        merit = subproblem.merit(lin, self.WEIGHT)
        return State(lin, merit, 2.0 * self.problem.dv_max, PenaltyParameters(self.WEIGHT))

    def resolving(self, resolution: float) -> Self:  # noqa: ARG002 -- of the protocol
        """The same algorithm: it has no test of stationarity."""
        return self

    def step(
        self, subproblem: Subproblem, dynamics: Dynamics, state: State, k: int, timing: Timing
    ) -> tuple[State, Record]:
        """Linearise, solve, fly."""
        trial = trial_step(subproblem, dynamics, state, state.radius, timing, float("inf"))
        new = State(trial.lin, trial.merit, state.radius, state.charge)
        return new, record_of(subproblem, state, new, k, trial)

    def terminate(self, subproblem: Subproblem, state: State, record: Record) -> Status | None:  # noqa: ARG002 -- of the protocol
        """Stop where the convex program has no feasible point, or the burns stand still.

        A feasible point costs at most n burns of dv_max; an elastic optimum that costs more proves that
        there is none.
        """
        promised = record.merit + record.actual - record.predicted
        if promised > self.problem.n_burns * self.problem.dv_max:
            return Status.INFEASIBLE
        if record.step > self.STEP:
            return None
        return Status.CONVERGED if record.violated <= self.feasible else Status.STALLED


# --- exact risk ------------------------------------------------------------------------------------

SEARCH_S = 60.0
"""Seconds of the processor that a reference may search, its start not counted."""


def solve_exact(cell: Cell, flights: int) -> Row:
    """Solve a cell of exact risk in this process, and check its probability independently."""
    del flights
    mission = Mission.from_scenario(load_scenario(cell.base, cell.overrides))
    found = _planned(mission, cell) if cell.method == REFERENCE else _searched(mission, cell)
    checked = check(mission, np.reshape(found.burns_m_s, (-1, 3)))
    return replace(
        found,
        problem="P2",
        total_dv_m_s=checked.total_dv_m_s,
        violation_m=checked.violation_m,
        asked=mission.scenario.risk.p_chance,
        reached=checked.probability,
        reached_error=checked.error,
    )


def _planned(mission: Mission, cell: Cell) -> Row:
    """Solve by the planner, as `solve --certify no` does."""
    begin = process_time()
    done = plan_mission(mission, initial_guess.cold(mission), PlanOptions(certify=False))
    row = _of_plan(cell, done, process_time() - begin)
    return replace(row, burns_m_s=_components(done.burns_m_s))


def _searched(mission: Mission, cell: Cell) -> Row:
    """Solve by a reference."""
    from experiments.solvers.compare_solvers.exact.search import search  # by CasADi

    starts = _starts(mission)
    begin = process_time()
    found = search(mission, starts, cell.method.solver, SEARCH_S)
    status = Status.CONVERGED if found.holds else Status.INFEASIBLE
    if found.out_of_time:
        status = Status.MAX_ITERATIONS
    return replace(
        empty_row(cell),
        status=status.value.name,
        detail=found.ended,
        iterations_p2=found.evaluations,
        cpu_s=process_time() - begin,
        burns_m_s=_components(found.burns * mission.units.speed_m_s),
    )


def _starts(mission: Mission) -> dict[str, Linearisation]:
    """Starts: SCP's solution of P3, and its plan with uniform risk, feasible or not."""
    guess = initial_guess.cold(mission)
    uniform = {"risk.allocation": "uniform", "risk.scope": "node"}
    even = Mission.from_scenario(mission.scenario.replace(uniform))
    found = plan_mission(even, guess, PlanOptions())
    p3 = next(stage for stage in found.stages if stage.name.startswith("P3"))
    return {"P3": p3.result.lin, "uniform": found.final.result.lin}


def _components(burns_m_s: np.ndarray) -> tuple[float, ...]:
    return tuple(burns_m_s.ravel().tolist())
