"""Vary one thing in how P2 is solved: its iterations, its form, its program, or its parameters.

Four studies, each of rows that a function measures case by case. Their tables have the cases and the
methods; after Ctrl-C each continues with the missing rows.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import product
from time import process_time
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
import pandas as pd

from experiments.frontier import EXACT
from experiments.harness import Findings, Record, Session, Study, plan_figures
from experiments.solvers.cases import IPOPT, ONE_FACTOR, PROBLEMS, Method
from experiments.solvers.cells import (
    CONVERGED,
    import_late,
    merit_of,
    p3_solution,
    posed,
    stage_solver,
    wide,
)
from formulations.problem.facets import choose_facets
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.program import model, solvers, subproblem
from formulations.program.certificate import ConeProgram
from formulations.rows.uniform import ChanceRows
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.jobs.processes import Limits, Processes
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan, StageSpec
from scp_recon.planning.planner import Planner
from scp_recon.planning.stages import Pipeline, unobserved
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.algorithms import ALGORITHMS, SCvx
from scp_recon.scp.status import Status

if TYPE_CHECKING:
    from formulations.nlp.solve import Variant

T = TypeVar("T")


def better_of_two(work: Callable[[], T]) -> tuple[T, float]:
    """The answer of a work that is done twice, and the less of its seconds of the processor."""
    times = []
    for _ in range(2):
        begin = process_time()
        found = work()
        times.append(process_time() - begin)
    return found, min(times)


# --- accuracy: stopped after every iteration ------------------------------------------------------

METHODS = tuple(one for one in ONE_FACTOR if one.solver in ("CLARABEL", IPOPT))
"""All solve P2 as it is but frozen-stm; the program as printed takes too long to be run so often."""
NEAR = {"within_1e2_s": 1e-2, "within_1e4_s": 1e-4, "within_1e6_s": 1e-6}
"""Relative errors of the merit, by column."""
ENOUGH = 1_000
"""More iterations than a method takes."""


class Begun(NamedTuple):
    """P2 of a problem as every method gets it: the start, a solution of P3, and its rows."""

    mission: Mission
    start: Iterate
    rows: ChanceRows


def begin_p2(name: str) -> Begun:
    """P2 of a problem by its name, with the facets that the default plan's program has."""
    mission = posed(name)
    plan = plan_mission(mission, initial_guess.cold(mission), PlanOptions(facet_rounds=0))
    free = [stage for stage in plan.stages if stage.spec.role != "held"]
    p3 = [stage for stage in free if stage.name.startswith("P3")][-1]
    rows = free[-1].merit.rows
    assert isinstance(rows, ChanceRows)
    return Begun(mission, p3.result.lin.iterate, rows)


def stopped_row(begun: Mapping[str, Begun], case: tuple[str, Method, int]) -> Record:
    """Solve P2 of a problem by a method that stops after some iterations."""
    name, method, most = case
    mission, guess, rows = begun[name]
    import_late(method)
    start = mission.dynamics.linearise(mission.problem, guess)
    since = process_time()
    solver = stage_solver(mission, method, max_iterations=most)
    stage = solver.solve(StageSpec("P2", rows), start, mission.dynamics, unobserved)
    seconds = process_time() - since
    return {
        "problem": name,
        "method": method.name,
        "iterations": len(stage.result.records),
        "ended": stage.result.status is not Status.MAX_ITERATIONS,
        "processor_s": seconds,
        "merit_m_s": merit_of(mission, stage.result.lin.iterate.burns, rows),
    }


def with_errors(rows: Sequence[Record]) -> pd.DataFrame:
    """Rows, runs of a method from the shortest on, with the errors of their merits.

    The error is relative to the least merit of the problem's ends. No run counts more seconds than a
    longer one: other work on the machine only lengthens them.
    """
    found = pd.DataFrame(rows)
    of_a_method = found[::-1].groupby(["problem", "method"])
    least = found[found.ended].groupby("problem").merit_m_s.min()
    error = (found.merit_m_s / found.problem.map(least) - 1.0).abs()
    return found.assign(processor_s=of_a_method.processor_s.cummin(), error=error)


def reached(found: pd.DataFrame) -> list[Record]:
    """When each method comes near and stays: a row a problem and method; NaN where it does not."""
    rows = []
    for (problem, method), own in found.groupby(["problem", "method"], sort=False):
        largest, end = own.error[::-1].cummax(), own.iloc[-1]  # from here on
        row = {"problem": problem, "method": method, "iterations": int(end.iterations)}
        row |= {name: own.processor_s[largest <= near].min() for name, near in NEAR.items()}
        rows.append(row | {"end_s": end.processor_s, "end_error": end.error})
    return rows


def accuracy(session: Session) -> Findings:
    """Trace how near to the optimum of P2 each method is after how many of the processor's seconds.

    P2 of the comparison's three problems is solved from one solution of P3, on the facets that its plan
    needs. Each method is run again and again, each time one iteration longer, in a process of its own;
    its seconds include building the program, not imports. The burns at its end are flown. What counts
    is their merit, with SCvx's first weight and all facets: its error is relative to the least of all
    methods. OUT/accuracy.csv has a row for each run, reached.csv when each method comes and stays near.
    """
    begun, store = {name: begin_p2(name) for name in PROBLEMS}, session.store()

    def solved(label: str, cases: Iterable[tuple[str, Method, int]]) -> list[Record]:
        alone = Processes(1, Limits(apart=True))
        work = partial(stopped_row, begun)
        return session.rows(label, work, cases, store, executor=alone)

    pairs, rows = [*product(PROBLEMS, METHODS)], list[Record]()
    for pair, end in zip(pairs, solved("ends", [(*p, ENOUGH) for p in pairs]), strict=True):
        before = [(*pair, most) for most in range(1, end["iterations"])]
        rows += [*solved(f"{pair[0]}, {pair[1].name}", before), end]
    found = with_errors(rows)
    return Findings({"accuracy": found, "reached": reached(found)})


# --- lifted: forms of the convex program ----------------------------------------------------------

FORMS = ("condensed", "lifted")
AT_NODES = EXACT | {"risk.p_chance": 0.9}
CASES: dict[str, dict[str, Any]] = {
    "uniform": {},
    "uniform, all facets": {},
    "exact, nodes": AT_NODES,
    "exact, flight": AT_NODES | {"risk.scope": "flight"},
}
"""Changes to the scenario."""


@contextmanager
def noted() -> Iterator[list[ConeProgram]]:
    """Record the cone programs that Clarabel gets within the context."""
    programs: list[ConeProgram] = []

    class Noting(solvers.Clarabel):
        """Clarabel with a record of its programs."""

        def solve(self, program: ConeProgram) -> solvers.Answer:
            programs.append(program)
            return super().solve(program)

    usual = solvers.SOLVERS["CLARABEL"]
    solvers.SOLVERS["CLARABEL"] = Noting
    try:
        yield programs
    finally:
        solvers.SOLVERS["CLARABEL"] = usual


def form_row(case: tuple[str, str]) -> Record:
    """Solve a case in a form, after everything that its start needs."""
    name, form = case
    mission = Mission.from_scenario(load_scenario().replace(CASES[name]))
    planner, lin = Planner(mission, formulation=form), p3_solution(mission)
    if mission.scenario.risk.allocation == "exact":
        spec = planner.exact_stages()[-1]
        if name == "exact, flight":  # which begins at the plan of nodes
            usual = Planner(mission)
            lin = Pipeline(mission, usual).solve(usual.exact_stages()[0], lin).result.lin
    else:
        facets = choose_facets(mission.problem, mission.polytopes, lin.iterate.mean, lin.factor)
        spec = planner.p2_stage(facets, lin)
        if name == "uniform, all facets":
            every = ChanceRows(mission.problem, facets, np.ones(len(facets.node), dtype=bool))
            spec = StageSpec("P2", every)
    with noted() as programs:
        stage, seconds = better_of_two(lambda: Pipeline(mission, planner).solve(spec, lin))
    largest = max(programs, key=lambda program: program.matrix.nnz)
    rows, variables = largest.matrix.shape
    return {
        "risk": name,
        "form": form,
        "variables": variables,
        "rows": rows,
        "nonzeros": largest.matrix.nnz,
        "iterations": len(stage.result.records),
        "total_dv_m_s": stage.result.lin.iterate.total_dv * mission.units.speed_m_s,
        "processor_s": seconds,
    }


def lifted(session: Session) -> Findings:
    """Compare the sizes and the times of P2 in its lifted and its condensed form.

    P2 of the default scenario is solved in both forms from the same start with the same facets: with
    uniform risk, near facets or all, and with exact risk of nodes and of whole flights. OUT/lifted.csv
    has a row for each: the largest cone program that Clarabel got, iterations, delta-v, and the
    processor's seconds, the better of two runs.
    """
    rows = session.rows("cases", form_row, product(CASES, FORMS), session.store())
    return Findings({"lifted": rows})


# --- nlp_tricks: from the printed nonlinear program to the tuned one ------------------------------

FOR_SPRAL = {"OMP_CANCELLATION": "TRUE", "OMP_PROC_BIND": "TRUE"}
"""Settings of OpenMP that SPRAL needs before it is loaded."""


def tricks() -> dict[str, Variant]:
    """Variants from printed to tuned, and alternatives, each named by its difference."""
    os.environ.update(FOR_SPRAL)
    from formulations.nlp.covariance import Covariance, Factor, initial_deviation
    from formulations.nlp.shooting import ArcStyle, MultipleShooting, SingleShooting
    from formulations.nlp.solve import (
        VARIANTS,
        Settings,
        Variant,
        paper_covariance,
        scaled_covariance,
    )

    def unique(problem: FlybyProblem) -> Covariance:
        return Covariance(problem, unique=True)

    def factor(problem: FlybyProblem) -> Factor:
        return Factor(problem, unit=initial_deviation(problem))

    scaled, plain, adaptive = scaled_covariance, Settings(), Settings(barrier="adaptive")
    multiple: dict[str, tuple[Any, ArcStyle, bool, bool, Settings]] = {
        "+ margins as signed distances": (paper_covariance, "called", True, False, plain),
        "+ 21 unique entries": (unique, "called", True, False, plain),
        "+ covariance in units of the initial one": (scaled, "called", True, False, plain),
        "+ facets far from binding left out": (scaled, "called", True, True, plain),
        "+ covariance up to the last facet only": (scaled, "called", False, True, plain),
        "+ adaptive barrier": (scaled, "called", False, True, adaptive),
        "+ one map over all arcs": (scaled, "mapped", False, True, adaptive),
        "+ derivatives arc by arc = tuned": (scaled, "differentiated", False, True, adaptive),
        "tuned, but a factor instead of the covariance": (
            *(factor, "differentiated", False, True),
            adaptive,
        ),
    }
    tuned, single, bfgs = (
        VARIANTS["tuned"],
        SingleShooting(),
        replace(adaptive, hessian="limited-memory"),
    )
    found = {
        name: Variant(MultipleShooting(spread, arcs, whole=whole), of, of, screened)
        for name, (spread, arcs, whole, screened, of) in multiple.items()
    }
    return {
        "as printed: 36 entries, angles as ratios": VARIANTS["printed"],
        **found,
        "tuned, but L-BFGS instead of exact Hessians": replace(tuned, p2=bfgs),
        "tuned, but SPRAL instead of MUMPS": replace(
            tuned, p2=replace(adaptive, linear_solver="spral")
        ),
        "single shooting, exact Hessians": Variant(single, adaptive, adaptive),
        "single shooting, L-BFGS = shooting": VARIANTS["shooting"],
    }


def trick_row(name: str) -> Record:
    """Solve P2 of the default scenario with a trick, from SCP's solution of P3 and its facets."""
    chosen = tricks()[name]
    from scp_recon.planning.ipopt import IpoptStages, casadi_arcs

    mission = posed("recon_b")
    start = p3_solution(mission)
    facets = choose_facets(mission.problem, mission.polytopes, start.iterate.mean, start.factor)
    solver = IpoptStages(mission, casadi_arcs(mission.flow), chosen)
    begin = process_time()
    stage = solver.solve(solver.p2_stage(facets, start), start, mission.dynamics, unobserved)
    seconds, run = process_time() - begin, stage.runs[-1]
    return {
        "trick": name,
        "status": f"{stage.result.status.value.name.replace('_', ' ')} ({run.status})",
        "delta-v m/s": f"{stage.result.lin.iterate.total_dv * mission.units.speed_m_s:.6f}",
        "unknowns": str(run.unknowns),
        "rows": str(run.rows),
        "iterations": str(max(len(run.iterations) - 1, 0)),
        "processor s": f"{seconds:.2f}",
    }


def nlp_tricks(session: Session) -> Findings:
    """Measure how much each trick speeds up the nonlinear program.

    P2 of the default scenario is solved from SCP's P3 solution, with the facets chosen there: first
    with the tricks that lead from the program as the paper prints it to the tuned one, each added to
    those before; then with alternatives to one of them. The table goes to OUT/nlp_tricks.csv.
    """
    rows = session.rows("tricks", trick_row, tricks(), session.store())
    return Findings({"nlp_tricks": rows})


# --- sensitivity: parameters of the loop ----------------------------------------------------------

DYNAMICS = "dynamics weight"
FACTORS = {
    "penalty weight": ("weight", SCvx.weight),
    "first radius": ("initial_radius", SCvx.initial_radius),
    DYNAMICS: ("", subproblem.DYNAMICS_WEIGHT),
}
"""By name an attribute of `ExactPenalty` and its usual value in the planner's units; SCvx and PTR have
the same. The dynamics weight is a constant of the program."""
MULTIPLES = (0.001, 0.01, 0.1, 1.0, 10.0, 100.0, 1000.0)
VARIED = ("scvx", "ptr")


@contextmanager
def dynamics_weight(weight: float) -> Iterator[None]:
    """Weigh the miss of the final state so much within the context, in the program and the merit."""
    usual = subproblem.DYNAMICS_WEIGHT
    try:
        for module in (subproblem, model):
            vars(module).update(DYNAMICS_WEIGHT=weight)
        yield
    finally:
        for module in (subproblem, model):
            vars(module).update(DYNAMICS_WEIGHT=usual)


def parameter_row(case: tuple[str, str, str, float]) -> Record:
    """Plan a problem by an algorithm with a factor at a multiple of its usual value."""
    problem, algorithm, name, multiple = case
    mission, (attribute, usual) = posed(problem), FACTORS[name]
    start, value = initial_guess.cold(mission), multiple * usual

    def plan() -> Plan:
        planner = Planner(mission, algorithm=algorithm)
        if attribute:
            planner.algorithm = ALGORITHMS[algorithm](**{attribute: value})
        return planner.plan(start)

    with dynamics_weight(value if name == DYNAMICS else subproblem.DYNAMICS_WEIGHT):
        found, seconds = better_of_two(plan)
    return {
        "problem": problem,
        "algorithm": algorithm,
        "factor": name,
        "multiple": multiple,
        "value": value,
        **plan_figures(found),
        "processor_s": seconds,
    }


def compared(rows: Sequence[Record]) -> pd.DataFrame:
    """Rows with the relative difference of their delta-v from the least plan's of the problem."""
    found = pd.DataFrame(rows)
    least = found[found.status == CONVERGED].groupby("problem").total_dv_m_s.min()
    return found.assign(off=found.total_dv_m_s / found.problem.map(least) - 1.0)


def by_value(found: pd.DataFrame) -> list[Record]:
    """A row for each value of a factor, a column for each problem: delta-v, or the status."""
    cost = found.total_dv_m_s.map("{:.6f}".format)
    ends = cost.where(found.status == CONVERGED, found.status.str.replace("_", " "))
    counts = found.iterations_p3.astype(str) + " + " + found.iterations_p2.astype(str)
    index = ("algorithm", "factor", "multiple", "value")
    return wide(found.assign(cell=ends + " (" + counts + ")"), index, "problem", "cell")


def sensitivity(session: Session) -> Findings:
    """Vary the penalty weight, the first trust-region radius and the dynamics weight, one at a time.

    The three problems of `compare_solvers` are planned from the straight line, in the condensed form by
    Clarabel, each time with one of these at a multiple of its usual value. SCvx bounds a step by the
    radius r, PTR charges ||s||^2 / (2 r). The dynamics weight charges the miss of the final state that
    many times as much as a constraint. They belong to the loop, not to a scenario, and no value of them
    is refused. OUT/sensitivity.csv has a row for each plan; the processor's seconds are the better of
    two runs. OUT/by_value.csv has a row for each value, and a column for each problem: delta-v in m/s,
    or the status without a plan, and P3's and P2's iterations.
    """
    cases = [(problem, *rest) for *rest, problem in product(VARIED, FACTORS, MULTIPLES, PROBLEMS)]
    found = compared(session.rows("plans", parameter_row, cases, session.store()))
    return Findings({"sensitivity": found, "by_value": by_value(found)})


STUDY = {
    study.__name__: Study(study.__doc__, study)
    for study in (accuracy, lifted, nlp_tricks, sensitivity)
}
