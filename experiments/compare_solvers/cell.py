"""One cell of the comparison, solved and measured: a row of the table."""

from __future__ import annotations

import importlib
import resource
from dataclasses import dataclass, replace
from itertools import pairwise
from time import process_time

import numpy as np

from experiments.compare_solvers.cases import IPOPT, UNGUARDED, Cell, Method, start_of
from experiments.compare_solvers.row import Row, empty_row
from experiments.compare_solvers.unguarded import Unguarded
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import choose_facets
from formulations.problem.flyby import Iterate
from formulations.program.merit import MeritFunction
from formulations.rows.chance import ChanceRows
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import (
    CLEARANCE_M,
    PROGRAM_NODES_MAX,
    Planner,
    ScpStages,
    plan,
)
from scp_recon.planning.provenance import Provenance
from scp_recon.planning.screening import screened
from scp_recon.planning.stages import RowsSolver, StageRunner
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.scvx import SCvx
from scp_recon.scp.status import Status


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
    lin = found.lin if found.lin.is_dynamically_feasible else _flown(mission, found.lin)
    burns = lin.iterate.burns * speed
    weights = SCvx()
    config, peak = FlightConfig(mission, burns), _peak_mib()
    observed = fly_many(config, samples=flights).held[ALL].mean().value if flights else np.nan
    return replace(
        empty_row(cell),
        status=found.status.value.name,
        problem="P2" if isinstance(found.merit.rows, ChanceRows) else "P3",
        total_dv_m_s=lin.iterate.total_dv * speed,
        merit_m_s=found.merit(lin, weights.weight) * speed,
        heavy_merit_m_s=found.merit(lin, weights.weight_max) * speed,
        violation_m=found.merit.worst_violation(lin) * length,
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
        return ("scp_recon.planning.ipopt",)
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
    merit: MeritFunction
    iterations_p3: int
    iterations_p2: int
    first_status: str
    from_arc: bool
    total_s: float
    cpu_s: float
    solver_s: float


def _whole(mission: Mission, cell: Cell) -> _Found:
    """P3, facets and P2 by one method."""
    start, method = start_of(mission, cell), cell.method
    begin = process_time()
    if method.solver == IPOPT:
        from scp_recon.planning import ipopt

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
        merit=done.final.merit,
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
    p3 = plan(mission, start_of(mission, cell), problem="P3").final.result.lin
    problem = mission.problem
    facets = choose_facets(problem, mission.polytopes, p3.iterate.mean, p3.factor)
    included = screened(mission, facets, p3, CLEARANCE_M, PROGRAM_NODES_MAX)
    runner = StageRunner(mission, _solver_of_rows(mission, cell.method))
    provenance = Provenance(
        cell.method.formulation, cell.method.algorithm, cell.method.solver, "p3"
    )
    rows, cpu_begin = ChanceRows(problem, facets, included), process_time()
    done = runner.run(lambda: runner.restore("P2", rows, p3), provenance)
    return _of_plan(done, process_time() - cpu_begin)


def _solver_of_rows(mission: Mission, method: Method) -> RowsSolver:
    """What solves P2 by a method."""
    if method.solver == IPOPT:
        from formulations.nlp.solve import VARIANTS
        from scp_recon.planning.ipopt import IpoptStages, casadi_arcs

        variant, arcs = VARIANTS[method.formulation], casadi_arcs(mission.dynamics)
        return IpoptStages(mission, arcs, variant, method.algorithm == "elastic")
    unguarded = Unguarded(mission.problem) if method.algorithm == UNGUARDED else None
    name = "scvx" if unguarded else method.algorithm  # of the same penalty
    planner = Planner(mission, formulation=method.formulation, algorithm=name, solver=method.solver)
    return ScpStages(planner, mission, unguarded or planner.algorithm)
