"""Plan by CasADi and IPOPT: the reference for sequential convex programming."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np

from formulations.arrays import Array
from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import Linearisation
from formulations.nlp.program import Arcs, Start
from formulations.nlp.solve import VARIANTS, NlpOutcome, NlpResult, Outer, Variant, solve_nlp
from formulations.problem.facets import Facets
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.program.subproblem import MeritFunction
from formulations.rows.cones import Rows
from formulations.rows.drift import DriftRows
from formulations.rows.uniform import ChanceRows
from scp_recon.errors import InputError, option
from scp_recon.mission.constraints import AS_PRINTED, require_without
from scp_recon.mission.mission import Mission
from scp_recon.physics.flow import GridFlow
from scp_recon.physics.forces import STEP, ForceModel, acceleration
from scp_recon.planning.plan import Plan, Stage, StageSpec
from scp_recon.planning.planner import Planner
from scp_recon.planning.records import Problem
from scp_recon.planning.solver import Observer
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.loop import Record, Result, Timing
from scp_recon.scp.status import Status


def casadi_arcs(flow: GridFlow) -> Arcs:
    """The flow map of `flow.propagate` over CasADi symbols: same forces, scheme and substeps."""
    forces, halves = flow.forces, np.linspace(0.0, 1.0, 2 * flow.substeps + 1)
    # Surroundings are numbers of each arc, at the ends and middles of its steps.
    moments = forces.moment(flow.starts[:, None] + flow.durations[:, None] * halves)
    arcs = flow.durations[:, None]
    if moments is not None:
        arcs = np.hstack([arcs, np.moveaxis(moments, (0, 1), (2, 3)).reshape(flow.arcs, -1)])
    state, arc = ca.SX.sym("x", 6), ca.SX.sym("h", arcs.shape[1])
    h = arc[0] / flow.substeps

    def moment(half: int) -> list[list[ca.SX]] | None:
        rows = range(1 + 12 * half, 13 + 12 * half, 3) if forces.timed else ()
        return [ca.vertsplit(arc[first : first + 3]) for first in rows] or None

    def rate(y: ca.SX, half: int) -> ca.SX:
        push = ca.vertcat(*acceleration(y[0], y[1], y[2], forces, moment(half)))
        for one, ahead, behind in pushes:
            sides = (acceleration(y[0], y[1], y[2], side, None) for side in (ahead, behind))
            push += one / (2.0 * STEP) * (ca.vertcat(*next(sides)) - ca.vertcat(*next(sides)))
        return ca.vertcat(y[3:], push)

    def end() -> ca.SX:
        y = state
        for k in range(0, 2 * flow.substeps, 2):
            k1 = rate(y, k)
            k2 = rate(y + 0.5 * h * k1, k + 1)
            k3 = rate(y + 0.5 * h * k2, k + 1)
            k4 = rate(y + h * k3, k + 2)
            y = y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return y

    pushes: list[tuple[ca.SX, ForceModel, ForceModel]] = []
    known, partials = Arcs(ca.Function("flow", [state, arc], [end()]), arcs), flow.partials
    if partials is None:
        return known
    all_of = ca.SX.sym("w", partials.count)
    moving = ca.vertsplit(all_of[partials.columns.tolist()]) if len(partials.columns) else []
    pushes += zip(moving, partials.ahead, partials.behind, strict=True)
    slope = ca.substitute(ca.jacobian(end(), all_of), all_of, ca.SX.zeros(partials.count, 1))
    return replace(known, by_parameters=ca.Function("by_parameters", [state, arc], [slope]))


def plan(
    mission: Mission,
    guess: Iterate,
    *,
    problem: Problem = "P2",
    variant: str = "tuned",
    elastic: bool = False,
    **how: Any,
) -> Plan:
    """Plan as `Planner.plan`, with its other arguments.

    The variant is a key of `formulations.nlp.solve.VARIANTS`. With `elastic`, violations are penalised
    as in SCP instead of forbidden. The observer is called with each line of IPOPT's log once a run is
    over.

    Returns:
        A plan, whose linearisations are those of the dynamics at IPOPT's iterates.

    Raises:
        InputError: if burns are corrected by feedback or risk is exact, which IPOPT does not plan; or
            if the variant as printed is asked for limits that the paper does not have.
    """
    scp, forms = option("method", "scp"), partial(option, "formulation")
    if problem == "P2":
        if mission.risk.allocation == "exact":
            raise InputError("risk.allocation", "'exact'", f"goes with {scp} only")
        require_without(("feedback",), mission.scenario, scp)
        plain = not (mission.flow.forces.timed or mission.problem.drifts)
        if variant != "shooting" or not plain:
            needs = (
                f"{scp}, or with {forms('shooting')} if no force depends on time, without drifts"
            )
            require_without(("knowledge",), mission.scenario, needs)
    if variant == "printed":
        needs = f"{scp}, or with {forms('tuned')} or shooting"
        require_without(AS_PRINTED, mission.scenario, needs)
    return IpoptPlanner(mission, variant, elastic=elastic).plan(guess, problem=problem, **how)


class IpoptPlanner(Planner[Mission]):
    """Plans by IPOPT, with arcs over CasADi symbols, in place of SCP; without exact risk.

    Args:
        task: the mission to plan.
        variant: name of a variant, or the variant.
        elastic: whether violations are penalised instead of forbidden.
    """

    method = "ipopt"

    def __init__(self, task: Mission, variant: str | Variant, *, elastic: bool = False) -> None:
        super().__init__(task)
        name = variant if isinstance(variant, str) else "own"
        self.variant = VARIANTS[variant] if isinstance(variant, str) else variant
        self.elastic, self.arcs = elastic, casadi_arcs(task.flow)
        self.names = name, "interior point, elastic" if elastic else "interior point", "IPOPT"

    def p3_stages(self, start: Linearisation) -> Sequence[StageSpec]:
        """P3 alone: IPOPT's programs have all constraints from the start."""
        del start
        return [self.p3]

    def p2_stage(self, facets: Facets, lin: Linearisation, *, again: bool = False) -> StageSpec:
        """P2 with given facets, screened as of SCP if the variant screens them."""
        if self.variant.screened:
            return super().p2_stage(facets, lin, again=again)
        return StageSpec(
            "P2", ChanceRows(self.task.problem, facets, np.ones(len(facets.node), bool))
        )

    def solve(
        self, spec: StageSpec, start: Linearisation, dynamics: Dynamics, observe: Observer
    ) -> Stage:
        """Solve P3 or, on the included facets of its rows, P2.

        An elastic problem that stays violated is solved again with SCP's second weight.
        """
        begin, rows = perf_counter(), spec.rows
        algorithm = SCvx()
        merit = MeritFunction(rows.problem, rows)
        setup = perf_counter() - begin
        weights = (algorithm.weight, algorithm.weight_max) if self.elastic else (None,)
        runs: list[NlpResult] = []
        lin, status = start, Status.SOLVER_FAILED
        for weight in weights:
            lin, run = self._run(rows, lin, dynamics, weight)
            runs.append(run)
            violated = merit.worst_violation(lin) > algorithm.feasible
            status = _status(run.outcome, violated=violated, elastic=self.elastic)
            if not violated or status is Status.INTERRUPTED:
                break
        result = Result(status, lin, _records(runs), _timing(runs, setup))
        for record in result.records:
            observe(spec.name, record)
        return Stage(spec, result, merit, algorithm.feasible)

    def _run(
        self, rows: Rows, lin: Linearisation, dynamics: Dynamics, penalty: float | None
    ) -> tuple[Linearisation, NlpResult]:
        problem, start = lin.problem, Start(lin.iterate, lin.factor)
        facets = rows.carried if isinstance(rows, ChanceRows) else None
        outer = drift_rows(problem, dynamics) if facets is not None and problem.drifts else None
        run = solve_nlp(problem, self.arcs, facets, start, self.variant, penalty, outer)
        if not (np.isfinite(run.iterate.burns).all() and np.isfinite(run.iterate.mean).all()):
            return lin, replace(run, outcome=NlpOutcome.FAILED)
        run.iterate.burns[list(problem.held)] = 0.0  # IPOPT keeps them zero within its tolerances
        return dynamics.linearise(problem, run.iterate), run


def drift_rows(problem: FlybyProblem, dynamics: Dynamics) -> Outer:
    """Rows of drifts as functions of the burns, by the planner's law of drifts."""
    rows = DriftRows(problem, 0)

    def values(burns: Array) -> tuple[Array, Array]:
        mean = dynamics.rollout(problem.initial_state, burns)
        lin = dynamics.linearise(problem, Iterate(burns, mean))
        margins = np.concatenate([one.margin for one in rows.margins(lin).values()])
        return margins, np.concatenate([cone.values[:, 0] for cone in rows.cones(lin)])

    return Outer(tuple(drift.name for drift in problem.drifts), values)


def _status(outcome: NlpOutcome, *, violated: bool, elastic: bool) -> Status:
    """IPOPT's status, except where constraints are violated all the same."""
    if outcome in (NlpOutcome.SOLVED, NlpOutcome.ACCEPTABLE):
        if not violated:
            return Status.CONVERGED
        return Status.INFEASIBLE if elastic else Status.SOLVER_FAILED
    return {
        NlpOutcome.INFEASIBLE: Status.INFEASIBLE,
        NlpOutcome.LIMIT: Status.MAX_ITERATIONS,
        NlpOutcome.INTERRUPTED: Status.INTERRUPTED,
    }.get(outcome, Status.SOLVER_FAILED)


def _records(runs: list[NlpResult]) -> tuple[Record, ...]:
    """IPOPT's log as iterations without trust region; its violation is one over all rows."""
    records: list[Record] = []
    for run in runs:
        seconds = run.solve_s / max(len(run.iterations) - 1, 1)
        for before, line in zip(run.iterations, run.iterations[1:], strict=False):
            record = Record(
                k=len(records) + 1,
                merit=line.objective,
                predicted=0.0,
                actual=before.objective - line.objective,
                accepted=True,
                trust_radius=0.0,
                total_dv=line.objective,
                max_violation=line.violation,
                max_defect=line.violation,
                step=line.step,
                solver_s=seconds,
            )
            records.append(record)
    return tuple(records)


def _timing(runs: list[NlpResult], setup: float) -> Timing:
    """Times in SCP's categories: evaluations count as linearisation, the rest of IPOPT as solver."""
    evaluate = sum(run.evaluate_s for run in runs)
    return Timing(
        setup=setup + sum(run.build_s for run in runs),
        linearise=evaluate,
        conic_solver=sum(run.solve_s for run in runs) - evaluate,
    )
