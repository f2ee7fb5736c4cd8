"""The three-stage planner: P3, facets at its solution, P2; and more facet rounds on request."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Literal

from formulations.facets import Facets, choose_facets, included_rows
from formulations.formulations import make_subproblem
from formulations.lifting import Linearisation
from formulations.problem import Iterate
from formulations.rows import P2Rows, P3Rows, Rows
from formulations.subproblem import Evaluation
from scp_recon.algorithms import ALGORITHMS
from scp_recon.errors import InputError
from scp_recon.guess import ballistic
from scp_recon.mission import Mission
from scp_recon.scp import Algorithm, Record, Result, Timing, run
from scp_recon.scvx import TrustRegion
from scp_recon.status import Status

Observer = Callable[[str, Record], None]

PROGRAM_NODES_MAX = 48
"""Nodes in the convex program of P2 to begin with: its memory grows with them times the factor."""

CLEARANCE_M = 200.0
"""Facets farther than this from binding stay out of the convex program, and are checked after it."""


@dataclass(frozen=True)
class Stage:
    """A run of the SCP on one problem.

    Attributes:
        name: "P3", "P2", "P2.2" with the facets chosen a second time, ...
        result: how it ended and where.
        subproblem: of which it was; it knows the constraints' margins.
        facets: of P2, None for P3.
        tolerance: violation that counted as none.
    """

    name: str
    result: Result
    subproblem: Evaluation
    facets: Facets | None
    tolerance: float


@dataclass(frozen=True)
class Plan:
    """All stages; the last one in `stages` that `final` names holds the answer."""

    stages: tuple[Stage, ...]
    final: Stage
    timing: Timing
    total_s: float


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
    """Solve P3 from the guess, choose the facets at its solution, and solve P2 from there.

    Where P3 does not converge from the guess it is tried once more from the ballistic arc.

    Args:
        mission: what to plan.
        guess: initial iterate, which may have defects.
        problem: "P3" stops after the first stage.
        formulation: a key of `formulations.subproblem.FORMULATIONS`.
        algorithm: a key of `algorithms.ALGORITHMS`.
        solver: one of `formulations.conic.installed()`.
        facet_rounds: how often to choose the facets again at the solution and solve again. A round
            is kept only while it lowers the merit, so that facets cannot cycle.
        observe: called after each iteration with the stage's name and the record.
    """
    started = perf_counter()
    work = _Work(
        mission, formulation, solver, ALGORITHMS[algorithm](), observe or (lambda _, __: None)
    )
    try:
        final = work.solve_p3(guess)
        if final.result.status is not Status.CONVERGED:
            final = work.retry_p3(final)
        if problem == "P2" and final.result.status is not Status.SOLVER_FAILED:
            final = work.solve_p2("P2", final.result.lin)
            for round_ in range(2, facet_rounds + 2):
                again = work.solve_p2(f"P2.{round_}", final.result.lin)
                if not _better(again, final):
                    break
                final = again
    except KeyboardInterrupt:
        if not work.stages:
            raise
        final = work.interrupted()
    return Plan(tuple(work.stages), final, work.timing, perf_counter() - started)


@dataclass
class _Work:
    """What accumulates while the stages are solved."""

    mission: Mission
    formulation: str
    solver: str
    algorithm: Algorithm
    observe: Observer
    stages: list[Stage] = field(default_factory=list)
    timing: Timing = field(default_factory=Timing)

    def solve_p3(self, guess: Iterate, name: str = "P3") -> Stage:
        """P3 from a guess; whatever it says, the flight starts where the problem does."""
        problem, mean = self.mission.problem, guess.mean.copy()
        mean[0] = problem.initial_state
        mean[0, 3:] += guess.burns[0]
        start = self.mission.dynamics.linearise(problem, Iterate(guess.burns, mean))
        return self._run(name, P3Rows(self.mission.problem), start, None)

    def retry_p3(self, failed: Stage) -> Stage:
        """P3 once more from the ballistic arc; the better of the two.

        A straight line may pass through the body's centre, where nothing can be linearised.
        """
        try:
            guess = ballistic(self.mission)
        except InputError:
            return failed
        again = self.solve_p3(guess, "P3.2")
        return again if _better(again, failed) else failed

    def solve_p2(self, name: str, start: Linearisation) -> Stage:
        """P2 with the facets chosen at the start, restoring those that should not be left out."""
        mission, lin = self.mission, start
        facets = choose_facets(mission.problem, mission.polytopes, lin.iterate.mean, lin.factor)
        margin = facets.margin(lin.iterate.mean, lin.factor)
        clearance = CLEARANCE_M / mission.units.length_m
        included = included_rows(facets, margin, clearance, PROGRAM_NODES_MAX)
        while True:
            rows = P2Rows(mission.problem, facets, included)
            stage = self._run(name, rows, lin, facets)
            missed = rows.missed(stage.result.lin, self.algorithm.feasible)
            if not missed.any():
                return stage
            included, lin = included | missed, stage.result.lin

    def _run(self, name: str, rows: Rows, start: Linearisation, facets: Facets | None) -> Stage:
        """One run of the SCP; an interrupted one ends the work."""
        begin = perf_counter()
        subproblem = make_subproblem(
            self.mission.problem, rows, self.formulation, self.solver, self.algorithm.penalty
        )
        self.timing.setup += perf_counter() - begin
        result = run(
            subproblem,
            self.mission.dynamics,
            start,
            self.algorithm,
            lambda record: self.observe(name, record),
        )
        self.timing.add(result.timing)
        self.stages.append(Stage(name, result, subproblem, facets, self.algorithm.feasible))
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return self.stages[-1]

    def interrupted(self) -> Stage:
        """The best stage so far, marked as interrupted: one that converged on P2 before any other."""
        solved = [s for s in self.stages if s.facets and s.result.status is Status.CONVERGED]
        best = (solved or self.stages)[-1]
        if best.facets is None:
            best = min(self.stages, key=_merit)
        return replace(best, result=replace(best.result, status=Status.INTERRUPTED))


def _better(new: Stage, old: Stage) -> bool:
    """Whether a run is worth keeping instead: first converged, then cheaper."""
    if new.result.status is not old.result.status:
        return new.result.status is Status.CONVERGED
    return _merit(new) < _merit(old)


def _merit(stage: Stage) -> float:
    return stage.subproblem.merit(stage.result.lin, TrustRegion().weight)
