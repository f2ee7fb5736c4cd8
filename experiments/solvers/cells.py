"""Solve one cell of the comparison of solvers, and judge its burns by code that no solver uses."""

from __future__ import annotations

import importlib
import resource
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from time import process_time
from typing import ClassVar, Self

import numpy as np
from scipy.special import ndtr, ndtri
from scipy.stats import qmc

from experiments.harness import Record
from experiments.solvers.cases import (
    EVERY_NODE,
    EXACT,
    NLP_SOLVERS,
    UNGUARDED,
    UNO,
    Cell,
    Method,
    start_of,
)
from formulations.arrays import Array, Indices
from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import choose_facets
from formulations.problem.flyby import FlybyProblem, Iterate, factor_columns_used
from formulations.program.subproblem import MeritFunction, Penalty, PenaltyParameters, Subproblem
from formulations.risk.directions import Directions
from formulations.rows.flight_probability import FlightProbability
from formulations.rows.node_probability import joint_events
from formulations.rows.uniform import ChanceRows
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.observation_time import ALL, joint_margins
from scp_recon.planning.missions import make_plan, other_starts
from scp_recon.planning.plan import Plan, Provenance, StageSpec
from scp_recon.planning.planner import Planner, screened
from scp_recon.planning.stages import Pipeline, StageSolver
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.algorithms import ALGORITHMS, SCvx
from scp_recon.scp.loop import Record as Iteration
from scp_recon.scp.loop import State, Timing, record_of, trial_step
from scp_recon.scp.status import Status

for form in ("condensed", "lifted"):
    # With CVXPY, which the copy of this process that solves a cell need not import again.
    importlib.import_module(f"formulations.program.{form}")

CONVERGED = Status.CONVERGED.value.name
FAILED = "failed"
"""Status of a cell that was ended or failed."""


def named(cell: Cell) -> Record:
    """Columns of a row that say which cell it is."""
    return {
        "key": cell.key,
        "group": cell.group,
        "scenario": cell.scenario,
        "start": cell.start,
        "seed": cell.seed,
        "method": cell.method.name,
        **asdict(cell.method),
        "repeat": cell.repeat,
    }


def solve(cell: Cell, flights: int) -> Record:
    """Solve a cell in this process: a row, SI.

    Columns besides those of `named`: status, a `Status` by name; problem, "P2" or, if it was not
    reached, "P3"; at_once, whether the first try solved it; total delta-v and burns; merit_m_s and
    heavy_merit_m_s, with the exact penalty of SCvx, first and second weight, of the burns as flown;
    violation_m, the largest, velocities as metres per unit of time; iterations_p3 and iterations_p2;
    total_s by the clock and cpu_s of the processor, imports apart; setup_s and solver_s of total_s;
    peak_mib of memory; observed_s, the mean observation time of `flights` flights, if any; and with
    exact risk asked, reached and reached_error, required and checked probability.
    """
    mission = Mission.from_scenario(load_scenario(cell.base, cell.overrides))
    for name in _needs(cell.method):
        importlib.import_module(name)
    begin = process_time()
    done = from_p3(mission, cell) if cell.start == "p3" else whole(mission, cell)
    effort = {"cpu_s": process_time() - begin, **effort_of(done)}
    peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # on Linux, so far
    own = by_check(mission, done) if cell.group == EXACT else by_merit(mission, done, flights)
    return {**named(cell), **effort, "peak_mib": peak_kib / 1024.0, **own}


def _needs(method: Method) -> tuple[str, ...]:
    """Modules that a method imports late; they are imported before its time is taken."""
    return ("scp_recon.planning.ipopt" if method.solver in NLP_SOLVERS else method.solver.lower(),)


def whole(mission: Mission, cell: Cell) -> Plan:
    """Plan P3, facets and P2 by one method."""
    start, method = start_of(mission, cell), cell.method
    if method.solver in NLP_SOLVERS:
        run, others = Pipeline(mission, stage_solver(mission, method)), other_starts(mission)
        return make_plan(mission, run, lambda: run.plan(start, "P2", others), provenance(cell))
    names = (method.formulation, method.algorithm, method.solver)
    return plan_mission(mission, start, PlanOptions("P2", "scp", *names, certify=_certify(cell)))


def _certify(cell: Cell) -> bool | None:
    return False if cell.group == EXACT else None


def provenance(cell: Cell) -> Provenance:
    """By what a plan is made."""
    return Provenance(
        cell.method.formulation, cell.method.algorithm, cell.method.solver, cell.start
    )


def from_p3(mission: Mission, cell: Cell) -> Plan:
    """Solve P2 from SCP's P3 solution with its facets, restoring facets found violated."""
    p3 = p3_solution(mission, start_of(mission, cell))
    problem = mission.problem
    facets = choose_facets(problem, mission.polytopes, p3.iterate.mean, p3.factor)
    clearance = np.inf if cell.method == EVERY_NODE else mission.clearances[0]
    rows = ChanceRows(problem, facets, screened(facets, p3, clearance))
    run = Pipeline(mission, stage_solver(mission, cell.method))
    return make_plan(mission, run, lambda: run.solve(StageSpec("P2", rows), p3), provenance(cell))


def p3_solution(mission: Mission, start: Iterate) -> Linearisation:
    """SCP's solution of P3 where no burn is held at zero."""
    stages = plan_mission(mission, start, PlanOptions(problem="P3")).stages
    return [one for one in stages if one.spec.role != "held"][-1].result.lin


def stage_solver(mission: Mission, method: Method, most: int | None = None) -> StageSolver:
    """The solver of stages by a method, which stops after `most` iterations of P2 if given."""
    if method.solver in NLP_SOLVERS:
        from formulations.nlp.solve import BY_UNO, VARIANTS
        from scp_recon.planning.ipopt import IpoptStages, casadi_arcs

        variant = BY_UNO if method.solver == UNO else VARIANTS[method.formulation]
        if most is not None:
            variant = replace(variant, p2=replace(variant.p2, max_iterations=most))
        return IpoptStages(
            mission, casadi_arcs(mission.flow), variant, method.algorithm == "elastic"
        )
    unguarded = Unguarded(mission.problem) if method.algorithm == UNGUARDED else None
    name = "scvx" if unguarded else method.algorithm  # of the same penalty
    form = "lifted" if method == EVERY_NODE else method.formulation
    planner = Planner(mission, formulation=form, algorithm=name, solver=method.solver)
    planner.algorithm = unguarded or planner.algorithm
    if most is not None:
        planner.algorithm = ALGORITHMS[name](max_iterations=most)
    return planner


# --- rows -----------------------------------------------------------------------------------------


def effort_of(done: Plan) -> Record:
    """Status, iterations and times of a plan."""
    names = [stage.name[:2] for stage in done.stages for _ in stage.result.records]
    return {
        "status": done.status.value.name,
        "detail": "",
        "at_once": not any(stage.spec.start for _, stage in pairwise(done.stages)),
        "iterations_p3": names.count("P3"),
        "iterations_p2": names.count("P2"),
        "total_s": done.total_s,
        "setup_s": done.timing.setup,
        "solver_s": done.timing.conic_solver,
    }


def by_merit(mission: Mission, done: Plan, flights: int) -> Record:
    """Cost, violation and, by samples if any, observation time of a plan's flight."""
    lin, merit, speed = done.final.result.lin, done.final.merit, mission.units.speed_m_s
    if not lin.is_dynamically_feasible:
        # A nonlinear program may end with gaps between its arcs, which no flight has.
        lin = rolled_out(mission, lin.iterate.burns)
    weights, burns = SCvx(), lin.iterate.burns * speed
    observed = np.nan
    if flights:
        observed = fly_many(FlightConfig(mission, burns), samples=flights).held[ALL].mean().value
    return {
        "problem": "P2" if isinstance(merit.rows, ChanceRows) else "P3",
        "total_dv_m_s": lin.iterate.total_dv * speed,
        "merit_m_s": merit(lin, weights.weight) * speed,
        "heavy_merit_m_s": merit(lin, weights.weight_max) * speed,
        "violation_m": merit.worst_violation(lin) * mission.units.length_m,
        "observed_s": observed,
        "burns_m_s": " ".join(f"{x:.9g}" for x in burns.ravel()),
    }


def by_check(mission: Mission, done: Plan) -> Record:
    """Cost, violation and probability of a plan with exact risk, by the independent check."""
    reached, error = checked_probability(mission, done.burns_m_s)
    return {
        "problem": "P2",
        "total_dv_m_s": done.total_dv_m_s,
        "violation_m": burns_violation_m(mission, done.burns_m_s),
        "asked": mission.scenario.risk.p_chance,
        "reached": reached,
        "reached_error": error,
        "burns_m_s": " ".join(f"{x:.9g}" for x in done.burns_m_s.ravel()),
    }


def merit_of(mission: Mission, burns: Array, rows: ChanceRows) -> float:
    """Merit with SCvx's first weight and all facets of burns as flown, m/s."""
    every = ChanceRows(mission.problem, rows.facets, np.ones_like(rows.included))
    merit = MeritFunction(mission.problem, every)(rolled_out(mission, burns), SCvx().weight)
    return merit * mission.units.speed_m_s


def rolled_out(mission: Mission, burns: Array) -> Linearisation:
    """The flight of some burns, shape (m, 3)."""
    problem = mission.problem
    mean = mission.dynamics.rollout(problem.initial_state, burns)
    return mission.dynamics.linearise(problem, Iterate(burns, mean))


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
    return of(mission, lin)


def whole_flight(mission: Mission, lin: Linearisation) -> tuple[float, float]:
    """Probability by directions of other seeds than the planner's, and its standard error."""
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
    return _mean(np.array(found))


def worst_node(mission: Mission, lin: Linearisation) -> tuple[float, float]:
    """Least probability of any joint constraint at any node, by draws, and its standard error."""
    first = _kept(mission, lin, np.arange(mission.problem.n_nodes), _normal(3, FIRST_DRAWS, SETS))
    worst = min(p.min() for _, p in first.values())
    most = worst + UNLIKE * np.sqrt(max(worst * (1.0 - worst), 1.0 / FIRST_DRAWS) / FIRST_DRAWS)
    sets = [_normal(3, DRAWS, seed) for seed in range(SETS)]
    candidates = {name: nodes[p <= most] for name, (nodes, p) in first.items()}
    nodes = np.unique(np.concatenate(list(candidates.values())))
    again = [_kept(mission, lin, nodes, draws) for draws in sets]
    found = [
        np.stack([one[name][1][np.isin(one[name][0], wanted)] for one in again])
        for name, wanted in candidates.items()
        if len(wanted)
    ]
    every = np.concatenate(found, axis=1)
    return _mean(every[:, np.argmin(every.mean(axis=0))])


def _kept(
    mission: Mission, lin: Linearisation, nodes: Indices, draws: Array
) -> dict[str, tuple[Indices, Array]]:
    """For each joint constraint its nodes among the given ones, and its probability there."""
    length, times = mission.units.length_m, mission.times_s[nodes]
    factor = lin.factor[nodes, :3]
    values, axes = np.linalg.eigh(factor @ factor.swapaxes(1, 2))
    root = axes * np.sqrt(np.maximum(values, 0.0))[:, None]
    at = length * (lin.iterate.mean[nodes, None, :3] + draws @ root.swapaxes(1, 2))
    safe = np.linalg.norm(at, axis=2) >= mission.scenario.safety.radius_min_m
    found = {"safety_radius": (nodes, safe.mean(axis=1))}
    seen = np.isin(nodes, mission.window_nodes)
    if seen.any():
        for name, margin in joint_margins(mission, times[seen], at[seen]).items():
            found[name] = nodes[seen], (margin >= 0.0).mean(axis=1)
    return found


def _normal(dimension: int, count: int, seed: int) -> Array:
    """Quasi-random standard normal vectors, shape (count, dimension)."""
    points = qmc.Sobol(dimension, scramble=True, rng=np.random.default_rng([SEED, seed]))
    return np.asarray(ndtri(points.random(count)))


def _mean(found: Array) -> tuple[float, float]:
    """Mean and its standard error."""
    return float(found.mean()), float(found.std(ddof=1) / np.sqrt(len(found)))


# --- without a safeguard --------------------------------------------------------------------------


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
    ) -> tuple[State, Iteration]:
        """Linearise, solve, fly."""
        trial = trial_step(subproblem, dynamics, state, state.radius, timing, float("inf"))
        new = State(trial.lin, trial.merit, state.radius, state.charge)
        return new, record_of(subproblem, state, new, k, trial)

    def terminate(self, subproblem: Subproblem, state: State, record: Iteration) -> Status | None:  # noqa: ARG002 -- of the protocol
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
