"""One cell of the comparison, solved and measured: a row of the table."""

from __future__ import annotations

import importlib
import resource
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from time import perf_counter, process_time

import numpy as np

from experiments.compare_cases import IPOPT, UNGUARDED, Cell, Method, initial_guess
from experiments.compare_row import Row, empty_row
from experiments.unguarded import Unguarded
from formulations.facets import choose_facets, included_rows
from formulations.lifting import Linearisation
from formulations.problem import Iterate
from formulations.program.subproblem import Evaluation
from formulations.registry import make_subproblem
from formulations.rows import P2Rows
from scp_recon.algorithms import ALGORITHMS
from scp_recon.campaign import Setting, fly_campaign
from scp_recon.mission import Mission
from scp_recon.observing import ALL
from scp_recon.planner import CLEARANCE_M, PROGRAM_NODES_MAX, plan
from scp_recon.scenario import load_scenario
from scp_recon.scp import Algorithm, Result, run
from scp_recon.scvx import TrustRegion
from scp_recon.stages import Plan
from scp_recon.status import Status


def solve_cell(cell: Cell, flights: int) -> Row:
    """Solve a cell in this process.

    Args:
        cell: what to solve.
        flights: of the Monte Carlo estimate of the observation time.
    """
    mission = Mission.from_scenario(load_scenario(None, cell.overrides))
    for name in _needs(cell.method):
        importlib.import_module(name)
    found = _from_p3(mission, cell) if cell.start == "p3" else _whole(mission, cell)
    speed, length = mission.units.speed_m_s, mission.units.length_m
    lin = found.lin if found.lin.is_flown else _flown(mission, found.lin)
    burns = lin.iterate.burns * speed
    weights = TrustRegion()
    setting, peak = Setting(mission, burns), _peak_mib()
    observed = fly_campaign(setting, samples=flights).held[ALL].mean().value if flights else np.nan
    worst = max(float(v.max(initial=0.0)) for v in found.subproblem.violations(lin).values())
    return replace(
        empty_row(cell),
        status=found.status.value.name,
        problem="P2" if isinstance(found.subproblem.rows, P2Rows) else "P3",
        total_dv_m_s=lin.iterate.total_dv * speed,
        merit_m_s=found.subproblem.merit(lin, weights.weight) * speed,
        heavy_merit_m_s=found.subproblem.merit(lin, weights.weight_max) * speed,
        violation_m=worst * length,
        iterations_p3=found.iterations_p3,
        iterations_p2=found.iterations_p2,
        first_status=found.first_status,
        from_arc=found.from_arc,
        total_s=found.total_s,
        cpu_s=found.cpu_s,
        solver_s=found.solver_s,
        peak_mib=peak,
        observed_s=observed,
        burns_m_s=tuple(burns.ravel().tolist()),
    )


def _flown(mission: Mission, lin: Linearisation) -> Linearisation:
    """The burns flown: a nonlinear program may end with gaps between its arcs, which no flight has."""
    burns, problem = lin.iterate.burns, mission.problem
    mean = mission.dynamics.rollout(problem.initial_state, burns)
    return mission.dynamics.linearise(problem, Iterate(burns, mean))


def _needs(method: Method) -> tuple[str, ...]:
    """Modules that a method imports where it uses them, which is not to count as its time."""
    if method.solver == IPOPT:
        return ("scp_recon.ipopt",)
    form = "lifted" if method.formulation == "lifted" else "condensed"
    return (f"formulations.program.{form}", method.solver.lower())


def _peak_mib() -> float:
    """Largest resident set of this process so far; Linux counts in KiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


@dataclass(frozen=True)
class _Found:
    """Where a method ended, and what it took."""

    status: Status
    lin: Linearisation
    subproblem: Evaluation
    iterations_p3: int
    iterations_p2: int
    first_status: str
    from_arc: bool
    total_s: float
    cpu_s: float
    solver_s: float


def _whole(mission: Mission, cell: Cell) -> _Found:
    """P3, facets and P2 by one method."""
    start, method = initial_guess(mission, cell), cell.method
    begin = process_time()
    if method.solver == IPOPT:
        from scp_recon import ipopt

        elastic = method.algorithm == "elastic"
        done = ipopt.plan(mission, start, variant=method.formulation, elastic=elastic)
    else:
        done = plan(
            mission,
            start,
            formulation=method.formulation,
            algorithm=method.algorithm,
            solver=method.solver,
        )
    return _of_plan(done, process_time() - begin)


def _of_plan(done: Plan, cpu_s: float) -> _Found:
    counts = {stage.name: 0 for stage in done.stages}
    for stage in done.stages:
        counts[stage.name] += len(stage.result.records)
    return _Found(
        status=done.final.result.status,
        lin=done.final.result.lin,
        subproblem=done.final.subproblem,
        iterations_p3=sum(n for name, n in counts.items() if name.startswith("P3")),
        iterations_p2=sum(n for name, n in counts.items() if name.startswith("P2")),
        first_status=_first_status(done),
        from_arc=done.final.begun_again,
        total_s=done.total_s,
        cpu_s=cpu_s,
        solver_s=done.timing.conic_solver,
    )


def _first_status(done: Plan) -> str:
    """How the first try ended, where there was a second."""
    for before, stage in pairwise(done.stages):
        if stage.begun_again:
            return before.result.status.value.name
    return ""


def _from_p3(mission: Mission, cell: Cell) -> _Found:
    """P2 from SCP's P3 solution and the facets there, restoring facets that should not be left out."""
    p3 = plan(mission, initial_guess(mission, cell), problem="P3").final.result.lin
    problem = mission.problem
    facets = choose_facets(problem, mission.polytopes, p3.iterate.mean, p3.factor)
    margin = facets.margin(p3.iterate.mean, p3.factor)
    clearance = CLEARANCE_M / mission.units.length_m
    included = included_rows(facets, margin, clearance, PROGRAM_NODES_MAX)
    solve = _solver_of_p2(mission, cell.method)
    begin, cpu_begin = perf_counter(), process_time()
    lin, iterations, solver_s = p3, 0, 0.0
    while True:
        rows = P2Rows(problem, facets, included)
        subproblem, result = solve(rows, lin)
        lin = result.lin
        iterations += len(result.records)
        solver_s += result.timing.conic_solver
        missed = rows.missed(lin, TrustRegion.feasible)
        if not missed.any():
            break
        included = included | missed
    return _Found(
        status=result.status,
        lin=lin,
        subproblem=subproblem,
        iterations_p3=0,
        iterations_p2=iterations,
        first_status="",
        from_arc=False,
        total_s=perf_counter() - begin,
        cpu_s=process_time() - cpu_begin,
        solver_s=solver_s,
    )


def _solver_of_p2(
    mission: Mission, method: Method
) -> Callable[[P2Rows, Linearisation], tuple[Evaluation, Result]]:
    """P2 on given rows from a given iterate, by SCP or by IPOPT."""
    if method.solver == IPOPT:
        from formulations.nlp import VARIANTS
        from scp_recon.ipopt import IpoptStages, casadi_arcs

        variant, arcs = VARIANTS[method.formulation], casadi_arcs(mission.dynamics)
        solver = IpoptStages(mission, arcs, variant, method.algorithm == "elastic")

        def by_ipopt(rows: P2Rows, start: Linearisation) -> tuple[Evaluation, Result]:
            stage = solver.solve("P2", rows, start)
            return stage.subproblem, stage.result

        return by_ipopt
    algorithm: Algorithm = (
        Unguarded(mission.problem)
        if method.algorithm == UNGUARDED
        else ALGORITHMS[method.algorithm]()
    )

    def by_scp(rows: P2Rows, start: Linearisation) -> tuple[Evaluation, Result]:
        subproblem = make_subproblem(
            mission.problem, rows, method.formulation, method.solver, algorithm.penalty
        )
        return subproblem, run(subproblem, mission.dynamics, start, algorithm, lambda _: None)

    return by_scp
