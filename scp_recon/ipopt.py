"""The paper's three stages by CasADi and IPOPT: the reference of the sequential convex programs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Literal

import casadi as ca
import numpy as np

from formulations.facets import Facets, choose_facets, included_rows
from formulations.lifting import Linearisation
from formulations.nlp import VARIANTS, NlpOutcome, NlpResult, Variant, solve_nlp
from formulations.nlp_program import Arcs, Start
from formulations.problem import Iterate
from formulations.program.subproblem import Evaluation
from formulations.rows import P2Rows, P3Rows, Rows
from scp_recon.dynamics import Dynamics
from scp_recon.forces import acceleration
from scp_recon.mission import Mission
from scp_recon.planner import CLEARANCE_M
from scp_recon.scp import Record, Result, Timing
from scp_recon.scvx import TrustRegion
from scp_recon.stages import Observer, Plan, Stage, finish, solve_in_stages
from scp_recon.status import Status


@dataclass(frozen=True)
class NlpStage(Stage):
    """A stage that IPOPT solved.

    Attributes:
        runs: IPOPT's results, the last one that of the stage; two where the penalty had to be
            raised.
    """

    runs: tuple[NlpResult, ...]


def casadi_arcs(dynamics: Dynamics) -> Arcs:
    """The flow map of `flow.propagate` over CasADi symbols: same forces, scheme and substeps."""
    state, duration = ca.SX.sym("x", 6), ca.SX.sym("h")
    h = duration / dynamics.substeps

    def rate(y: ca.SX) -> ca.SX:
        return ca.vertcat(y[3:], *acceleration(y[0], y[1], y[2], dynamics.forces))

    y = state
    for _ in range(dynamics.substeps):
        k1 = rate(y)
        k2 = rate(y + 0.5 * h * k1)
        k3 = rate(y + 0.5 * h * k2)
        k4 = rate(y + h * k3)
        y = y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return Arcs(ca.Function("flow", [state, duration], [y]), dynamics.durations)


def plan(
    mission: Mission,
    guess: Iterate,
    *,
    problem: Literal["P3", "P2"] = "P2",
    variant: str = "tuned",
    elastic: bool = False,
    observe: Observer | None = None,
) -> Plan:
    """Solve P3 from the guess, choose the facets at its solution, and solve P2 from there.

    What does not converge is tried once more from the ballistic arc, as `Planner.plan` does.

    Args:
        mission: what to plan.
        guess: initial iterate, which may have defects.
        problem: "P3" stops after the first stage.
        variant: a key of `formulations.nlp.VARIANTS`.
        elastic: weigh violations as the sequential convex programs do, instead of forbidding them.
        observe: called with each line of IPOPT's log once a run is over.

    Returns:
        A plan of `NlpStage`s, whose linearisations are those of the dynamics at IPOPT's iterates.
    """
    arcs = casadi_arcs(mission.dynamics)
    work = _Work(IpoptStages(mission, arcs, VARIANTS[variant], elastic), mission, observe)
    return finish(work, lambda: solve_in_stages(work, guess, problem))


@dataclass
class _Work:
    """What accumulates while the stages of one plan are solved."""

    solver: IpoptStages
    mission: Mission
    observe: Observer | None
    stages: list[Stage] = field(default_factory=list)
    timing: Timing = field(default_factory=Timing)

    def solve_p3(self, guess: Iterate, name: str) -> Stage:
        """P3 from a guess."""
        dynamics, flyby = self.mission.dynamics, self.mission.problem
        return self._run(name, P3Rows(flyby), dynamics.linearise(flyby, guess))

    def solve_p2(self, start: Stage, name: str) -> Stage:
        """P2, again with the facets that were left out of the program where they turn out missed."""
        lin = start.result.lin
        rows = self.solver.facet_rows(lin)
        while True:
            stage = self._run(name, rows, lin)
            lin = stage.result.lin
            missed = rows.missed(lin, stage.tolerance)
            if not missed.any():
                return stage
            rows = P2Rows(self.mission.problem, rows.facets, rows.included | missed)

    def _run(self, name: str, rows: Rows, start: Linearisation) -> Stage:
        """One stage; an interrupted one ends the work."""
        stage = self.solver.solve(name, rows, start)
        self.stages.append(stage)
        self.timing.add(stage.result.timing)
        for record in stage.result.records:
            if self.observe:
                self.observe(name, record)
        if stage.result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return stage


@dataclass(frozen=True)
class IpoptStages:
    """One stage by IPOPT: what the planner does by sequential convex programming.

    Attributes:
        mission: what to plan.
        arcs: its dynamics over CasADi symbols.
        variant: how the programs are posed.
        elastic: weigh violations instead of forbidding them.
    """

    mission: Mission
    arcs: Arcs
    variant: Variant
    elastic: bool = False

    def facet_rows(self, lin: Linearisation) -> P2Rows:
        """P2's rows with the facets chosen at a P3 solution, screened as the planner screens them."""
        mission = self.mission
        facets = choose_facets(mission.problem, mission.polytopes, lin.iterate.mean, lin.factor)
        margin = facets.margin(lin.iterate.mean, lin.factor)
        clearance = CLEARANCE_M / mission.units.length_m if self.variant.screened else np.inf
        return P2Rows(
            mission.problem,
            facets,
            included_rows(facets, margin, clearance, mission.problem.n_nodes),
        )

    def solve(self, name: str, rows: Rows, start: Linearisation) -> NlpStage:
        """Solve P3 or, on the included facets of its rows, P2.

        An elastic problem that stays violated is weighed once more with the largest penalty, as
        `TrustRegion` does.
        """
        begin = perf_counter()
        algorithm = TrustRegion()
        subproblem = Evaluation(self.mission.problem, rows)
        setup = perf_counter() - begin
        weights = (algorithm.weight, algorithm.weight_max) if self.elastic else (None,)
        runs: list[NlpResult] = []
        lin, status = start, Status.SOLVER_FAILED
        for weight in weights:
            lin, run = self._run(rows, lin, weight)
            runs.append(run)
            violated = _worst(subproblem, lin) > algorithm.feasible
            status = _status(run.outcome, violated=violated, elastic=self.elastic)
            if not violated or status is Status.INTERRUPTED:
                break
        result = Result(status, lin, _records(runs), _timing(runs, setup))
        facets = rows.facets if isinstance(rows, P2Rows) else None
        return NlpStage(name, result, subproblem, facets, algorithm.feasible, tuple(runs))

    def _run(
        self, rows: Rows, lin: Linearisation, penalty: float | None
    ) -> tuple[Linearisation, NlpResult]:
        mission = self.mission
        facets = _included(rows) if isinstance(rows, P2Rows) else None
        start = Start(lin.iterate, lin.factor)
        run = solve_nlp(mission.problem, self.arcs, facets, start, self.variant, penalty)
        if not (np.isfinite(run.iterate.burns).all() and np.isfinite(run.iterate.mean).all()):
            return lin, replace(run, outcome=NlpOutcome.FAILED)
        return mission.dynamics.linearise(mission.problem, run.iterate), run


def _included(rows: P2Rows) -> Facets:
    names = Facets.__annotations__
    return Facets(*(getattr(rows.facets, name)[rows.included] for name in names))


def _worst(subproblem: Evaluation, lin: Linearisation) -> float:
    return max(float(v.max(initial=0.0)) for v in subproblem.violations(lin).values())


def _status(outcome: NlpOutcome, *, violated: bool, elastic: bool) -> Status:
    """IPOPT's word, but for what is violated in spite of it."""
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
    """Evaluations of functions and derivatives count as linearisation, the rest of IPOPT as solver."""
    evaluate = sum(run.evaluate_s for run in runs)
    return Timing(
        setup=setup + sum(run.build_s for run in runs),
        linearise=evaluate,
        conic_solver=sum(run.solve_s for run in runs) - evaluate,
    )
