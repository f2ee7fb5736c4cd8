"""Solve one cell of the comparison of solvers, and judge its burns by code that no solver uses."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import pairwise
from time import process_time

import numpy as np
import pandas as pd
from scipy.special import ndtr, ndtri
from scipy.stats import qmc

from experiments.harness import Record, plan_figures
from experiments.solvers.cases import (
    EXACT,
    NLP_SOLVERS,
    PROBLEMS,
    UNO,
    Cell,
    Method,
    start_of,
)
from formulations.arrays import Array, Indices
from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import choose_facets
from formulations.problem.flyby import Iterate, factor_columns_used
from formulations.risk.lines import Directions
from formulations.rows.flight_probability import FlightProbability
from formulations.rows.node_probability import joint_events
from formulations.rows.uniform import ChanceRows
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.observation_time import joint_margins
from scp_recon.planning import initial_guess
from scp_recon.planning.missions import make_plan, other_starts
from scp_recon.planning.plan import Plan, Provenance, Stage, StageSpec
from scp_recon.planning.planner import Planner, screened
from scp_recon.planning.stages import Pipeline, StageSolver
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.status import Status

for form in ("condensed", "lifted"):
    # With CVXPY, which the copy of this process that solves a cell need not import again.
    importlib.import_module(f"formulations.program.{form}")

CONVERGED = Status.CONVERGED.value.name
FAILED = "failed"
"""Status of a cell that was ended or failed."""


def named(cell: Cell) -> Record:
    """Columns of a row that say which cell it is."""
    about = {key: value for key, value in vars(cell).items() if key not in ("overrides", "base")}
    return {"key": cell.key, **about, "method": cell.method.name, **asdict(cell.method)}


def posed(problem: str) -> Mission:
    """One of the problems that every method solves."""
    return Mission.from_scenario(load_scenario(*PROBLEMS[problem]))


def solve(cell: Cell) -> Record:
    """Solve a cell in this process: a row, SI.

    Columns besides those of `named`: status, a `Status` by name; problem, "P2" or, if it was not
    reached, "P3"; at_once, whether the first try solved it; total delta-v; heavy_merit_m_s, with
    SCvx's exact penalty and second weight, of the burns as flown; violation_m, the largest, velocities
    as metres per unit of time; iterations_p3 and iterations_p2; total_s by the clock and cpu_s of the
    processor, imports apart; setup_s of total_s; and with exact risk asked, reached and reached_error,
    required and checked probability.
    """
    mission = Mission.from_scenario(load_scenario(cell.base, cell.overrides))
    import_late(cell.method)
    begin = process_time()
    done = planned(mission, cell)
    effort = {
        "cpu_s": process_time() - begin,
        "total_s": done.total_s,
        "setup_s": done.timing.setup,
        "at_once": not any(stage.spec.start for _, stage in pairwise(done.stages)),
        "detail": "",
    }
    own = by_check(mission, done) if cell.group == EXACT else by_merit(mission, done)
    return {**named(cell), **plan_figures(done), **effort, **own}


def import_late(method: Method) -> None:
    """Import what a method imports late, before its time is taken."""
    late = method.solver.lower()
    importlib.import_module("scp_recon.planning.ipopt" if method.solver in NLP_SOLVERS else late)


def planned(mission: Mission, cell: Cell) -> Plan:
    """Plan P3, facets and P2 by a cell's method, or P2 from SCP's solution of P3 and its facets."""
    of, start, from_p3 = cell.method, start_of(mission, cell), cell.start == "p3"
    if of.solver not in NLP_SOLVERS and not from_p3:
        certify = False if cell.group == EXACT else None
        names = of.formulation, of.algorithm, of.solver
        options = PlanOptions("P2", "scp", *names, facet_rounds=0, certify=certify, starts=1)
        return plan_mission(mission, start, options)
    pipeline = Pipeline(mission, stage_solver(mission, of))

    def work() -> Stage:
        if not from_p3:
            return pipeline.plan(start, "P2", other_starts(mission))
        p3 = p3_solution(mission)
        facets = choose_facets(mission.problem, mission.polytopes, p3.iterate.mean, p3.factor)
        rows = ChanceRows(mission.problem, facets, screened(facets, p3, mission.clearances[0]))
        return pipeline.solve(StageSpec("P2", rows), p3)

    provenance = Provenance(of.formulation, of.algorithm, of.solver, cell.start)
    return make_plan(mission, pipeline, work, provenance)


def p3_solution(mission: Mission) -> Linearisation:
    """SCP's solution of P3 from the straight line, where no burn is held at zero."""
    stages = plan_mission(mission, initial_guess.cold(mission), PlanOptions(problem="P3")).stages
    return [one for one in stages if one.spec.role != "held"][-1].result.lin


def stage_solver(mission: Mission, method: Method) -> StageSolver:
    """The solver of stages by a method."""
    if method.solver in NLP_SOLVERS:
        from formulations.nlp.solve import BY_UNO, VARIANTS
        from scp_recon.planning.ipopt import IpoptStages, casadi_arcs

        variant = BY_UNO if method.solver == UNO else VARIANTS[method.formulation]
        elastic = method.algorithm == "elastic"
        return IpoptStages(mission, casadi_arcs(mission.flow), variant, elastic)
    form, name, solver = method.formulation, method.algorithm, method.solver
    return Planner(mission, formulation=form, algorithm=name, solver=solver)


def by_merit(mission: Mission, done: Plan) -> Record:
    """Cost, violation and merit of a plan's flight."""
    lin, merit, speed = done.final.result.lin, done.final.merit, mission.units.speed_m_s
    if not lin.is_dynamically_feasible:
        # A nonlinear program may end with gaps between its arcs, which no flight has.
        lin = rolled_out(mission, lin.iterate.burns)
    return {
        "problem": done.final.problem,
        "total_dv_m_s": lin.iterate.total_dv * speed,
        "heavy_merit_m_s": merit(lin, SCvx().weight_max) * speed,
        "violation_m": merit.worst_violation(lin) * mission.units.length_m,
    }


def by_check(mission: Mission, done: Plan) -> Record:
    """Violation and probability of a plan with exact risk, by the independent check."""
    reached, error = checked_probability(mission, done.burns_m_s)
    return {
        "problem": "P2",
        "violation_m": burns_violation_m(mission, done.burns_m_s),
        "asked": mission.scenario.risk.p_chance,
        "reached": reached,
        "reached_error": error,
    }


def rolled_out(mission: Mission, burns: Array) -> Linearisation:
    """The flight of some burns, shape (m, 3)."""
    problem = mission.problem
    mean = mission.dynamics.rollout(problem.initial_state, burns)
    return mission.dynamics.linearise(problem, Iterate(burns, mean))


def wide(frame: pd.DataFrame, index: Sequence[str], columns: str, values: str) -> list[Record]:
    """A row for each combination of `index`, with a column for each value of `columns`."""
    found = frame.pivot_table(values, [*index], columns, aggfunc="first", sort=False)
    rows: list[Record] = found.reset_index().to_dict("records")
    return rows


# --- the check of exact risk ----------------------------------------------------------------------

FINER = 4
"""Steps of the check's flight to one of the planner's."""
SEED = 71
SETS, DRAWS, DIRECTIONS = 8, 8192, 2048
"""Independently scrambled sets, and what each has: draws at nodes, directions of flights."""
FIRST_DRAWS = 4096
"""Draws with which candidates for the worst node are found."""
UNLIKE = 5.0
"""Standard errors from the worst node up to which another can be it."""


def burns_violation_m(mission: Mission, burns_m_s: Array) -> float:
    """Largest miss of a component of the final state, flown in finer steps, or of a burn's limit.

    Velocities count as metres per unit of time.
    """
    units, problem = mission.units, mission.problem
    burns = burns_m_s / units.speed_m_s
    finer = replace(mission.flow, substeps=FINER * mission.flow.substeps)
    end = Dynamics(finer, mission.burn_nodes).rollout(problem.initial_state, burns)[-1]
    miss = float(np.abs(end - problem.final_state).max())
    limits = min(float(margin.min()) for margin in problem.burn_margins(burns).values())
    return max(miss, -limits) * units.length_m


def checked_probability(mission: Mission, burns_m_s: Array) -> tuple[float, float]:
    """Probability of burns, m/s, shape (m, 3), and its standard error.

    At nodes the original limits are tested on many draws of the normal law, by code that no solver
    uses: the least probable constraint at the worst node counts. For whole flights it is the planner's
    own estimate, but along directions that no plan has seen.
    """
    lin = rolled_out(mission, burns_m_s / mission.units.speed_m_s)
    of = worst_node if mission.scenario.risk.scope == "node" else whole_flight
    found = of(mission, lin)
    return float(found.mean()), float(found.std(ddof=1) / np.sqrt(len(found)))


def whole_flight(mission: Mission, lin: Linearisation) -> Array:
    """Probability by sets of directions of other seeds than the planner's."""
    events = joint_events(mission.problem.constraints)
    nodes = np.unique(np.concatenate([event.nodes for event in events]))
    dimension = factor_columns_used(mission.problem, nodes)
    found = []
    for seed in range(SETS // 2):
        normal = _normal(dimension, DIRECTIONS, seed)
        directions = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        g = FlightProbability(events, Directions(directions, np.ones(len(directions))))(
            lin.iterate.mean[:, :3], lin.factor[:, :3]
        )
        found.append(float(ndtr(g.value)))
    return np.array(found)


def worst_node(mission: Mission, lin: Linearisation) -> Array:
    """Least probability of any joint constraint at any node, by sets of draws."""
    every = np.arange(mission.problem.n_nodes)
    first = _shares(mission, lin, every, _normal(3, FIRST_DRAWS, SETS)).min(axis=0)
    variance = max(first.min() * (1.0 - first.min()), 1.0 / FIRST_DRAWS) / FIRST_DRAWS
    nodes = every[first <= first.min() + UNLIKE * np.sqrt(variance)]
    sets = (_normal(3, DRAWS, seed) for seed in range(SETS))
    found = np.array([_shares(mission, lin, nodes, draws).ravel() for draws in sets])
    return found[:, found.mean(axis=0).argmin()]


def _shares(mission: Mission, lin: Linearisation, nodes: Indices, draws: Array) -> Array:
    """Share of draws that keeps each joint constraint at each node, shape (constraints, nodes)."""
    factor, seen = lin.factor[nodes, :3], np.isin(nodes, mission.window_nodes)
    values, axes = np.linalg.eigh(factor @ factor.swapaxes(1, 2))
    root = axes * np.sqrt(np.maximum(values, 0.0))[:, None]
    at = lin.iterate.mean[nodes, None, :3] + draws @ root.swapaxes(1, 2)
    at *= mission.units.length_m
    safe = np.linalg.norm(at, axis=2) >= mission.scenario.safety.radius_min_m
    found = [safe.mean(axis=1)]
    for margin in joint_margins(mission, mission.times_s[nodes[seen]], at[seen]).values():
        found.append(np.ones(len(nodes)))
        found[-1][seen] = (margin >= 0.0).mean(axis=1)
    return np.array(found)


def _normal(dimension: int, count: int, seed: int) -> Array:
    """Quasi-random standard normal vectors, shape (count, dimension)."""
    points = qmc.Sobol(dimension, scramble=True, rng=np.random.default_rng([SEED, seed]))
    return np.asarray(ndtri(points.random(count)))
