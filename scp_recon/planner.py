"""The three-stage planner: P3, facets at its solution, P2; and more facet rounds on request."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from time import perf_counter
from typing import Final, Literal

import numpy as np

from formulations.facets import Facets, choose_facets, included_rows
from formulations.lifting import Linearisation
from formulations.problem import Iterate
from formulations.program.subproblem import Subproblem
from formulations.regions import Array
from formulations.registry import make_subproblem
from formulations.rows import P2Rows, P3Rows, Rows
from scp_recon.algorithms import ALGORITHMS
from scp_recon.mission import Mission
from scp_recon.scp import Record, Timing, run
from scp_recon.stages import Observer, Plan, Stage, better, finish, solve_in_stages
from scp_recon.status import Status

PROGRAM_NODES_MAX = 48
"""Nodes in CVXPY's program of P2 to begin with: its memory grows with them times the factor."""

CLEARANCE_M, CLEARANCE_AGAIN_M = 200.0, 40.0
"""Facets farther than this from binding stay out of the convex program, and are checked after it.

The second figure is for starting at a solution of P2, which moves less than one of P3.
"""


def plan(
    mission: Mission,
    guess: Iterate,
    *,
    problem: Literal["P3", "P2"] = "P2",
    formulation: str = "condensed",
    algorithm: str = "scvx",
    solver: str = "CLARABEL",
    facet_rounds: int = 0,
    observe: Observer | None = None,
) -> Plan:
    """Plan a mission once: `Planner.plan` with its arguments and those of `Planner`."""
    planner = Planner(mission, formulation=formulation, algorithm=algorithm, solver=solver)
    return planner.plan(guess, problem=problem, facet_rounds=facet_rounds, observe=observe)


class Planner:
    """Plans a mission, and plans it again from other initial states.

    Keeps its convex subproblems: their sparsity, and what a solver or CVXPY made of it.

    Args:
        mission: what to plan.
        formulation: one of `formulations.registry.FORMULATIONS`.
        algorithm: a key of `algorithms.ALGORITHMS`.
        solver: one of `formulations.program.solvers.installed()`.
    """

    def __init__(
        self,
        mission: Mission,
        *,
        formulation: str = "condensed",
        algorithm: str = "scvx",
        solver: str = "CLARABEL",
    ) -> None:
        self.mission: Final = mission
        self.formulation: Final = formulation
        self.solver: Final = solver
        self.algorithm: Final = ALGORITHMS[algorithm]()
        self._p2_rows: P2Rows | None = None
        self._kept: dict[type[Rows], Subproblem] = {}

    def plan(
        self,
        guess: Iterate,
        *,
        problem: Literal["P3", "P2"] = "P2",
        facet_rounds: int = 0,
        observe: Observer | None = None,
    ) -> Plan:
        """Solve P3 from the guess, choose the facets at its solution, and solve P2 from there.

        What does not converge is tried once more from the ballistic arc: see `solve_in_stages`.

        Args:
            guess: initial iterate, which may have defects.
            problem: "P3" stops after the first stage.
            facet_rounds: how often to choose the facets again at the solution and solve again. A
                round is kept only while it lowers the merit, so that facets cannot cycle.
            observe: called after each iteration with the stage's name and the record.
        """
        work = _Work(self, self.mission, observe, facet_rounds)
        return finish(work, lambda: solve_in_stages(work, guess, problem))

    def replan(self, last: Plan, initial_state: Array, *, observe: Observer | None = None) -> Plan:
        """Solve P2 again for another initial state, from the last plan and with its facets.

        Args:
            last: a plan of P2 by this planner.
            initial_state: before the first burn, J2000, SI, shape (6,). Its covariance is as large a
                fraction of it as the mission says.
            observe: called after each iteration with the stage's name and the record.

        Returns:
            A plan whose `mission` is the one from that state.

        Raises:
            ValueError: if the plan is not one of P2, or of a mission that differs in more than the
                initial state; or if the state is none outside the body.
        """
        if last.final.facets is None:
            raise ValueError("only a plan of P2 can be planned again")
        if last.mission.with_initial_state(initial_state).scenario != (
            self.mission.with_initial_state(initial_state).scenario
        ):
            raise ValueError("the plan is of another mission")
        mission = self.mission.with_initial_state(initial_state)
        work = _Work(self, mission, observe)
        final = last.final
        return finish(work, lambda: work.solve_p2_again(final))

    @cached_property
    def p3_rows(self) -> P3Rows:
        """P3's constraints."""
        return P3Rows(self.mission.problem)

    def p2_rows(self, facets: Facets, lin: Linearisation, clearance_m: float) -> P2Rows:
        """P2's constraints, those in the program that an iterate comes near; the last are kept."""
        margin = facets.margin(lin.iterate.mean, lin.factor)
        clearance = clearance_m / self.mission.units.length_m
        lifted = self.formulation == "lifted"
        nodes_max = PROGRAM_NODES_MAX if lifted else self.mission.problem.n_nodes
        included = included_rows(facets, margin, clearance, nodes_max)
        kept = self._p2_rows
        if kept is None or kept.facets is not facets or np.any(kept.included != included):
            self._p2_rows = kept = P2Rows(self.mission.problem, facets, included)
        return kept

    def subproblem(self, rows: Rows) -> Subproblem:
        """The convex subproblem with some rows; of P3 and of P2 the one made last is kept."""
        kept = self._kept.get(type(rows))
        if kept is None or kept.rows is not rows:
            kept = make_subproblem(
                self.mission.problem, rows, self.formulation, self.solver, self.algorithm.penalty
            )
            self._kept[type(rows)] = kept
        return kept


@dataclass
class _Work:
    """What accumulates while the stages of one plan are solved."""

    planner: Planner
    mission: Mission
    observe: Observer | None
    facet_rounds: int = 0
    stages: list[Stage] = field(default_factory=list)
    timing: Timing = field(default_factory=Timing)

    def start(self, guess: Iterate) -> Linearisation:
        """Linearised at a guess; whatever it says, the flight starts where the problem does."""
        problem, mean = self.mission.problem, guess.mean.copy()
        mean[0] = problem.initial_state
        mean[0, 3:] += guess.burns[0]
        return self.mission.dynamics.linearise(problem, Iterate(guess.burns, mean))

    def solve_p3(self, guess: Iterate, name: str) -> Stage:
        """P3 from a guess."""
        return self._run(name, self.planner.p3_rows, self.start(guess), None)

    def solve_p2(self, start: Stage, name: str) -> Stage:
        """P2 from where a stage ended, and again with new facets as long as that helps."""
        final = self._solve_p2(name, start.result.lin)
        for round_ in range(2, self.facet_rounds + 2):
            again = self._solve_p2(f"{name}.{round_}", final.result.lin)
            if not better(again, final):
                break
            final = again
        return final

    def _solve_p2(self, name: str, lin: Linearisation) -> Stage:
        """P2 with the facets chosen at the start."""
        mission = self.mission
        facets = choose_facets(mission.problem, mission.polytopes, lin.iterate.mean, lin.factor)
        return self._restoring(name, self.planner.p2_rows(facets, lin, CLEARANCE_M), lin)

    def solve_p2_again(self, last: Stage) -> Stage:
        """P2 from the iterate of a stage and with its facets."""
        lin, facets = last.result.lin, last.facets
        assert facets is not None
        rows = self.planner.p2_rows(facets, lin, CLEARANCE_AGAIN_M)
        return self._restoring("P2", rows, self.start(lin.iterate))

    def _restoring(self, name: str, rows: P2Rows, lin: Linearisation) -> Stage:
        """P2, again with the facets that were left out of the program where they turn out missed."""
        while True:
            stage = self._run(name, rows, lin, rows.facets)
            lin = stage.result.lin
            missed = rows.missed(lin, self.planner.algorithm.feasible)
            if not missed.any():
                return stage
            rows = P2Rows(self.mission.problem, rows.facets, rows.included | missed)

    def _run(self, name: str, rows: Rows, start: Linearisation, facets: Facets | None) -> Stage:
        """One run of the SCP; an interrupted one ends the work."""
        begin = perf_counter()
        subproblem = self.planner.subproblem(rows)
        self.timing.setup += perf_counter() - begin
        algorithm, observe = self.planner.algorithm, self.observe

        def seen(record: Record) -> None:
            if observe:
                observe(name, record)

        result = run(subproblem, self.mission.dynamics, start, algorithm, seen)
        self.timing.add(result.timing)
        self.stages.append(Stage(name, result, subproblem, facets, algorithm.feasible))
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return self.stages[-1]
