"""Run the stages of any task by any method: P3, P2, and both again from other starts.

A keep-out set is linearised by the plane that touches it nearest to the iterate, so an iterate
stays on its side of the set. If a guess does not obey the dynamics, its path says nothing about the
right side. P3 then begins with a first stage without the keep-out sets that apply to a part of the
flight. The answer of the first stage hardly depends on the guess. P3 continues with all sets, on
the side nearest to that answer. The first stage costs at most as much as any plan with all sets. If
its answer keeps all sets, no nearby plan is better.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import numpy as np

from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import Facets, Polytopes, choose_facets
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.program.subproblem import MeritFunction
from formulations.rows.cones import Rows
from formulations.rows.uniform import ChanceRows, DeterministicRows
from scp_recon.planning.plan import Stage
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.loop import Record, Timing
from scp_recon.scp.status import Status

OTHER_OPTIMUM = 0.999
"""Ratio of two merits below which the runs ended at different optima."""

OTHER_BURNS = 1e-2
"""Difference of a burn component, nondimensional, above which they did so too."""

FIRST_STAGE = ".open"
"""Suffix of the stage that leads to a P3 whose guess is no flight."""

LED_STAGE = ".led"
"""Suffix of the stage that leads to gains where there is no plan without."""

HELD_STAGE = ".held"
"""Suffix of a stage in which burns are held that would be too small to execute."""

RESOLUTION = 1e-3
"""Relative reduction of the merit at which the first stage stops: P3 goes on from there."""

NO_BURN = 1e-6
"""Total delta-v, nondimensional, below which a guess has no burns that could be wrong."""

CHOICES_MAX = 4
"""Further choices of facets before P2 is called infeasible, where there is another choice."""

Observer = Callable[[str, Record], None]


class Spent(Protocol):
    """Required probability, and the way to spend the risk: see `scp_recon.scenario.schema.Risk`."""

    @property
    def p_chance(self) -> float:
        """Required probability."""

    @property
    def allocation(self) -> Literal["uniform", "exact"]:
        """Split of the risk: "uniform" over facets, or "exact" by the probabilities of the sets."""

    @property
    def scope(self) -> Literal["node", "flight"]:
        """What must hold with that probability: each node, or the whole flight."""


class Task(Protocol):
    """The task to plan: a mission, or an `ImpulsiveProblem`."""

    @property
    def problem(self) -> FlybyProblem:
        """The nondimensional problem."""

    @property
    def dynamics(self) -> Dynamics:
        """Its flow with its burns."""

    @property
    def polytopes(self) -> Polytopes:
        """Polytopes that approximate regions where risk is split evenly."""

    @property
    def risk(self) -> Spent:
        """How risk is spent."""

    @property
    def clearances(self) -> tuple[float, float]:
        """Margins beyond which facets stay out of a program at first: from P3, and from P2."""

    def require_plain(self, needs: str) -> None:
        """Refuse feedback and limits on the final covariance, which go with `needs` alone.

        Raises:
            InputError: if there is either.
        """


class RowsSolver(Protocol):
    """Solves P3 or P2 for one set of rows; SCP and IPOPT differ only in this class."""

    @property
    def p3_rows(self) -> DeterministicRows:
        """P3's constraints."""

    @property
    def first_stage_rows(self) -> DeterministicRows | None:
        """Rows that P3 begins with where its guess is no flight; None if it begins with all."""

    def p2_rows(self, facets: Facets, lin: Linearisation) -> ChanceRows:
        """P2's constraints on given facets; the program includes those near an iterate."""

    def exact_rows(self) -> Sequence[tuple[str, Rows]]:
        """P2's constraints with the true probabilities, one stage leading to the next, by name.

        Raises:
            InputError: if the method has no such rows.
        """

    @property
    def leading_rows(self) -> Rows | None:
        """Rows of a preliminary stage with gains, if there is no plan without gains; else None."""

    def solve(
        self, name: str, rows: Rows, start: Linearisation, dynamics: Dynamics, observe: Observer
    ) -> Stage:
        """Solve a stage from a start; its status says if it was interrupted."""


@dataclass
class StageRunner:
    """State of one planning run: stages and timings so far. For `facet_rounds` see `Planner.plan`."""

    task: Task
    solver: RowsSolver
    observe: Observer | None = None
    facet_rounds: int = 0
    choices: int = CHOICES_MAX
    stages: list[Stage] = field(default_factory=list)
    timing: Timing = field(default_factory=Timing)
    _chosen: dict[str, int] = field(default_factory=dict)

    def plan(self, guess: Iterate, problem: Literal["P3", "P2"], *, once: bool = False) -> Stage:
        """Solve P3 from a guess, after a first stage if it is no flight, and P2 from there.

        If P3 does not converge from the guess, it is tried from other starts, and also if P2 does not:
        P3 may have stopped at a bad local optimum. If none converges, the facets are chosen again. The
        best of all tries counts. With `once` there is no other start.
        """
        if problem == "P2" and self.task.risk.allocation == "exact":
            self.solver.exact_rows()  # a method that has none says so before any work
        firsts: list[Stage] = []
        finals: list[Stage] = []
        for letter, start in [("", guess)] if once else self.starts(guess):
            p3 = self._solve_p3(f"P3{letter}", self.start(start))
            known = any(same_optimum(p3, other) for other in firsts)
            firsts.append(p3)
            if p3.result.status is not Status.CONVERGED or known:
                continue
            finals.append(p3 if problem == "P3" else self._solve_p2(f"P2{letter}", p3))
            if finals[-1].result.status is Status.CONVERGED:
                return finals[-1]
        if not finals:
            p3 = max(firsts, key=standing)
            lost = problem == "P3" or p3.result.status is Status.SOLVER_FAILED
            finals.append(p3 if lost else self._solve_p2(p3.name.replace("P3", "P2"), p3))
        for final in [final for final in finals if final.facets]:
            finals.append(self.choose_again(final))
            if finals[-1].result.status is Status.CONVERGED:
                break
        return max(finals, key=standing)

    def choose_again(self, stage: Stage) -> Stage:
        """Solve P2 again with facets chosen at the last end, until one converges; return the best.

        Infeasibility with one choice of facets says little about other choices, so a few are tried.
        A try that ends without a verdict does not count.
        """
        name, tries = stage.name.partition(".")[0], [stage]
        while tries[-1].result.status is Status.INFEASIBLE and len(tries) <= self.choices:
            last = [s for s in self.stages if s.name.partition(".")[0] == name][-1]
            tries.append(self._with_facets(name, last.result.lin))
        verdicts = (Status.CONVERGED, stage.result.status)
        return max((one for one in tries if one.result.status in verdicts), key=standing)

    def starts(self, guess: Iterate) -> Iterator[tuple[str, Iterate]]:
        """The guess and other starts, each with the letter of its stages."""
        yield "", guess

    def start(self, guess: Iterate) -> Linearisation:
        """Linearise at a guess, moved to the problem's initial state."""
        problem, mean = self.task.problem.open_loop, guess.mean.copy()
        mean[0] = problem.initial_state
        if not problem.coasts:
            mean[0, 3:] += guess.burns[0]
        return self.task.dynamics.linearise(problem, Iterate(guess.burns, mean))

    def _solve_p3(self, name: str, start: Linearisation) -> Stage:
        """Solve P3, after a first stage if the start is no flight; all rows judge both."""
        rows, first = self.solver.p3_rows, self.solver.first_stage_rows
        if first is not None and contradicts_itself(start):
            stage = self.solve(f"{name}{FIRST_STAGE}", first, start, rows)
            start = stage.result.lin
        return self.solve(name, rows, start)

    def _solve_p2(self, name: str, start: Stage) -> Stage:
        """Solve P2 from the end of a stage, and again with new facets as long as that helps."""
        if self.task.risk.allocation == "exact":
            return self.solve_exact(name, start.result.lin)
        final = self._with_facets(name, start.result.lin)
        for _ in range(self.facet_rounds):
            again = self._with_facets(name, final.result.lin)
            if not standing(again) > standing(final):
                break
            final = again
        return final

    def solve_exact(self, name: str, lin: Linearisation) -> Stage:
        """Solve P2 with the true probabilities, after quicker stages as long as they converge.

        A case without an open-loop plan may have a plan with corrections. If there are rows of a
        preliminary stage with gains, the last stage follows however that stage ends. A start with
        gains keeps them, and needs no stage without gains.
        """
        feedback, leading = self.task.problem.feedback, None
        corrected = lin.iterate.gains.any()
        for way, rows in self.solver.exact_rows():
            if (leading is not None and way) or (
                corrected and rows.problem.feedback is not feedback
            ):
                continue
            stage = self.solve(name + way, rows, lin)
            lin = stage.result.lin
            if stage.result.status is Status.CONVERGED:
                continue
            if rows.problem.feedback is feedback:
                break
            leading = self.solver.leading_rows
            if leading is not None:
                lin = self.solve(f"{name}{LED_STAGE}", leading, lin).result.lin
        return stage

    def _with_facets(self, name: str, lin: Linearisation) -> Stage:
        """Solve P2 with facets chosen at the start; the name gets the number of the choice."""
        task, chosen = self.task, self._chosen
        chosen[name] = chosen.get(name, 0) + 1
        name = name if chosen[name] == 1 else f"{name}.{chosen[name]}"
        facets = choose_facets(task.problem, task.polytopes, lin.iterate.mean, lin.factor)
        return self.restore(name, self.solver.p2_rows(facets, lin), lin)

    def restore(self, name: str, rows: ChanceRows, lin: Linearisation) -> Stage:
        """Solve P2, and again with facets that were left out of the program and are violated."""
        while True:
            stage = self.solve(name, rows, lin)
            lin = stage.result.lin
            missed = rows.missed(lin, stage.tolerance)
            if not missed.any():
                return stage
            rows = ChanceRows(self.task.problem, rows.facets, rows.included | missed)

    def solve(
        self, name: str, rows: Rows, start: Linearisation, judges: Rows | None = None
    ) -> Stage:
        """Solve one stage, judged by `judges`, by default its own rows.

        Raises:
            KeyboardInterrupt: if it was interrupted.
        """
        observe = self.observe or (lambda *_: None)
        start = start.known(rows.problem.feedback)
        stage = self.solver.solve(name, rows, start, self.task.dynamics, observe)
        stage = replace(stage, result=replace(stage.result, lin=stage.result.lin.telling))
        if judges is not None:
            stage = replace(stage, merit=MeritFunction(self.task.problem, judges))
        self.stages.append(stage)
        self.timing.add(stage.result.timing)
        if stage.result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return stage


def contradicts_itself(lin: Linearisation) -> bool:
    """Whether a guess has burns, but its path has larger velocity defects than these.

    Two kinds of guesses do not contradict themselves: a coarse trajectory of another tool, and a
    path without burns, such as the paper's straight line.
    """
    kicks = float(np.linalg.norm(lin.defects[:-1, 3:], axis=1).sum())
    return NO_BURN < lin.iterate.total_dv < kicks


def without_parting_sets(problem: FlybyProblem) -> FlybyProblem:
    """The problem without the keep-out sets of a part of the flight.

    Sets of the whole flight stay: they keep the path away from the dynamics' singularity.
    """
    kept = [c for c in problem.constraints if c.keep == "in" or len(c.nodes) == problem.n_nodes]
    return replace(problem, constraints=tuple(kept))


def same_optimum(one: Stage, other: Stage) -> bool:
    """Whether two runs of P3 ended at the same optimum."""
    low, high = sorted((_merit(one), _merit(other)))
    apart = np.abs(one.result.lin.iterate.burns - other.result.lin.iterate.burns).max()
    alike = low > OTHER_OPTIMUM * high and bool(apart < OTHER_BURNS)
    return one.result.status is other.result.status and alike


def standing(stage: Stage) -> tuple[int, float]:
    """Rank of a run, the better the greater: by how it ended, then by cost.

    It ended solved (3), at a point that violates nothing (2), otherwise (1), or without an answer of
    the solver (0).
    """
    rank = 0 if stage.result.status is Status.SOLVER_FAILED else 1
    if stage.result.status is Status.CONVERGED:
        rank = 3
    elif stage.merit.worst_violation(stage.result.lin) <= stage.tolerance:
        rank = 2
    return rank, -_merit(stage)


def _merit(stage: Stage) -> float:
    return stage.merit(stage.result.lin, SCvx().weight)
