"""Run the stages of a plan by any method: P3, P2, and both again from other starts.

A stage is data (`plan.StageSpec`): a problem's rows, and what follows if it does not converge. A
`StageSolver` lists the stages of P3 and P2 and solves one; `Pipeline.run` is the loop over a list.

A keep-out set is linearised by the plane that touches it nearest to the iterate, so an iterate
stays on its side of the set. If a guess does not obey the dynamics, its path says nothing about the
right side. P3 then begins with an open stage, without the keep-out sets of a part of the flight. The
answer of the open stage hardly depends on the guess. P3 continues with all sets, on the side nearest
to that answer. The open stage costs at most as much as any plan with all sets. If its answer keeps
all sets, no nearby plan is better.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import Facets, choose_facets
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.program.subproblem import MeritFunction
from formulations.rows.drift import HOPELESS
from formulations.rows.uniform import ChanceRows
from scp_recon.planning.method import SETTLE, FacetRounds
from scp_recon.planning.plan import PlanningProblem, Stage, StageSpec, is_converged, merit_of, rank
from scp_recon.planning.records import Problem
from scp_recon.planning.settling import Settling
from scp_recon.scp.loop import Record, Timing
from scp_recon.scp.status import Status
from scp_recon.scp.verdict import UNDECIDED

OTHER_OPTIMUM = 0.999
"""Ratio of two merits below which the runs ended at different optima."""

OTHER_BURNS = 1e-2
"""Burns whose components differ by more, nondimensional, are different optima."""

HARDLY = 0.5
"""Share of a least violation above which that of a run without a verdict refutes nothing."""
RESOLUTION = 1e-3
"""Relative reduction of the merit at which the open stage stops: P3 continues from there."""

NO_BURN = 1e-6
"""Total delta-v, nondimensional, below which a guess has no burns that could be wrong."""

DOUBTFUL = 1.3
"""Cost of exact risk over P3's above which other algorithms are tried: it may be a poor optimum."""

CHOICES_MAX = 4
"""Further choices of facets before P2 is called infeasible, where there is another choice."""


class Observer(Protocol):
    """Observes planning."""

    def __call__(self, stage: str, record: Record, /) -> None:
        """Called after each iteration with the name of the stage and the record."""


def unobserved(stage: str, record: Record, /) -> None:
    """Ignore an iteration."""


class StageSolver(Protocol):
    """A method, SCP or IPOPT: the stages that it needs, and how it solves one."""

    def p3_stages(self, start: Linearisation) -> Sequence[StageSpec]:
        """Stages of P3 from a start."""

    def p2_stage(self, facets: Facets, lin: Linearisation) -> StageSpec:
        """P2 with given facets; its program includes those near an iterate."""

    def exact_stages(self, *, growing: bool = False) -> Sequence[StageSpec]:
        """Stages of P2 with exact risk, each started from the end of the one before.

        If `growing`, stages whose drifts keep out of smaller balls come first.

        Raises:
            InputError: if the method cannot plan exact risk.
        """

    def solve(
        self, spec: StageSpec, start: Linearisation, dynamics: Dynamics, observe: Observer
    ) -> Stage:
        """Solve a stage from a start; its status says if it was interrupted."""

    @property
    def others(self) -> Mapping[str, StageSolver]:
        """Other algorithms by their names, for exact risk where this one ends badly."""

    @property
    def scout(self) -> StageSolver:
        """The method that chooses facets for this one: the quickest, the same for every method."""


@dataclass
class Pipeline:
    """One planning run, with the stages and timings so far.

    Attributes:
        task: the problem to plan.
        solver: the method.
        observe: called after each iteration.
        facet_rounds: times that facets may be chosen again at a solution of P2, to improve it; or
            "settle", until no choice is cheaper.
        stages: all stages that were run.
        timing: of all stages, s.
    """

    task: PlanningProblem
    solver: StageSolver
    observe: Observer = unobserved
    facet_rounds: FacetRounds = 0
    stages: list[Stage] = field(default_factory=list)
    timing: Timing = field(default_factory=Timing)

    def plan(
        self, guess: Iterate, problem: Problem, others: Iterable[tuple[str, Iterate]] = ()
    ) -> Stage:
        """Solve P3 from a guess, and P2 from there; return the best stage.

        If either does not converge from the guess, both are tried from the `others`, each with the
        letter of its stages: P3 may have stopped at a bad local optimum. If none converges, the facets
        are chosen again.
        """
        p2_exact = problem == "P2" and self.task.risk.allocation == "exact"
        if p2_exact:
            self.solver.exact_stages()  # a method that has none says so before any work
        firsts: list[Stage] = []
        finals: list[Stage] = []
        for letter, start in itertools.chain([("", guess)], others):
            lin = self.start(start)
            p3 = self.run(self.solver.p3_stages(lin), lin, letter)
            known = any(same_optimum(p3, other) for other in firsts)
            firsts.append(p3)
            if p3.result.status is not Status.CONVERGED or known:
                continue
            finals.append(p3 if problem == "P3" else self.p2(p3, letter))
            if finals[-1].result.status is Status.CONVERGED:
                return finals[-1]
        if not finals:
            p3 = max(firsts, key=rank)
            lost = problem == "P3" or p3.result.status is Status.SOLVER_FAILED
            finals.append(p3 if lost else self.p2(p3, p3.spec.start))
        if p2_exact and (last := max(finals, key=rank)).problem == "P2":
            cheapest = max(
                (one for one in firsts if is_converged(one)), key=rank, default=firsts[0]
            )
            finals.append(self._by_others(last, cheapest))
        chosen_once = [final for final in finals if final.facets is not None]
        for final in chosen_once if self.facet_rounds != SETTLE else []:
            finals.append(self.choose_again(final))
            if finals[-1].result.status is Status.CONVERGED:
                break
        return max(finals, key=rank)

    def start(self, guess: Iterate) -> Linearisation:
        """Linearise at a guess, moved to the problem's initial state."""
        problem, mean = self.task.problem.open_loop, guess.mean.copy()
        mean[0] = problem.initial_state
        if not problem.coasts:
            mean[0, 3:] += guess.burns[0]
        return self.task.dynamics.linearise(
            problem, Iterate(guess.burns, mean, drifts=guess.drifts)
        )

    def p2(self, p3: Stage, letter: str = "") -> Stage:
        """Solve P2 from the end of P3, and again with new facets as long as that improves it."""
        lin = p3.result.lin
        if self.task.risk.allocation == "exact":
            final = self.exact(lin, letter)
            if not is_converged(final) and _is_hopeless(final):
                grown = self.run(self.solver.exact_stages(growing=True), lin, letter)
                final = grown if is_converged(grown) else final
            doubtful = final.result.is_weighed or merit_of(final) > DOUBTFUL * merit_of(p3)
            return self._by_others(final, p3) if doubtful and is_converged(final) else final
        if self.task.problem.drifts:  # P3 has none, so its path says little about the facets
            scouting = Pipeline(self.task, self.solver.scout)
            lin = Settling(self.task, scouting.solve).exact_path(lin)
            self.timing.add(scouting.timing)
        final = self._with_facets(lin, letter)
        if self.facet_rounds == SETTLE:
            return self._settled(final, p3)
        for _ in range(self.facet_rounds):
            again = self._with_facets(final.result.lin, letter)
            if not rank(again) > rank(final):
                break
            final = again
        return final

    def _settled(self, first: Stage, p3: Stage) -> Stage:
        """Settle the facets by the scout's rounds, and solve P2 with them; return the better plan."""
        scouting = Pipeline(self.task, self.solver.scout)
        settled = Settling(self.task, scouting.solve)(first, p3)
        self.timing.add(scouting.timing)
        assert settled.facets is not None
        lin = settled.result.lin.with_drifts(settled.drifts)
        spec = replace(self.solver.p2_stage(settled.facets, lin), role="settled")
        found = self.run([spec], lin, first.spec.start)
        if found.result.status is Status.STALLED:  # too near to its end for frozen derivatives
            found = max(found, self.run([spec], p3.result.lin, first.spec.start), key=rank)
        return max(first, found, key=rank)

    def exact(self, lin: Linearisation, letter: str = "") -> Stage:
        """Solve P2 with exact risk; a start with gains keeps them and skips stages without gains."""
        stages, feedback = self.solver.exact_stages(), self.task.problem.feedback
        if lin.iterate.gains.any():
            stages = [one for one in stages if one.rows.problem.feedback is feedback]
        return self.run(stages, lin, letter)

    def _by_others(self, found: Stage, p3: Stage) -> Stage:
        """Solve P2 with exact risk by other algorithms too, whose stages end in their names."""
        best = found
        for name, solver in self.solver.others.items():
            runs = Pipeline(self.task, solver, self.observe)
            named = [
                replace(spec, title=f"{replace(spec, start=p3.spec.start).name}.{name}")
                for spec in solver.exact_stages()
            ]
            other = runs.run(named, p3.result.lin, p3.spec.start)
            better = rank(other) > rank(best, saving=1.0 - OTHER_OPTIMUM)
            best = other if better and not _says_less(other, best) else best
            self.stages += runs.stages
            self.timing.add(runs.timing)
        return best

    def choose_again(self, stage: Stage) -> Stage:
        """Solve P2 again with facets chosen at the last end, until one converges; return the best.

        Infeasibility with one choice of facets says little about other choices, so a few are tried.
        A try that ends without a verdict does not count. Where the facets chosen at an end are those
        that it has, as where the final state determines the burns, there is no other choice.
        """
        letter, tries = stage.spec.start, [stage]
        while tries[-1].result.status is Status.INFEASIBLE and len(tries) <= CHOICES_MAX:
            same = [s for s in self.stages if s.problem == stage.problem and s.spec.start == letter]
            lin, facets = same[-1].result.lin, same[-1].facets
            if facets is not None and facets.are_near(self._facets_at(lin)):
                break
            tries.append(self._with_facets(lin, letter))
        verdicts = (Status.CONVERGED, stage.result.status)
        return max((one for one in tries if one.result.status in verdicts), key=rank)

    def _facets_at(self, lin: Linearisation) -> Facets:
        mean, factor = lin.iterate.mean, lin.spread.factor
        return choose_facets(self.task.problem, self.task.polytopes, mean, factor)

    def _with_facets(self, lin: Linearisation, letter: str) -> Stage:
        """Solve P2 with facets chosen at a start."""
        facets = self._facets_at(lin)
        chosen = [one.spec for one in self.stages if one.facets is not None]
        last = max((spec.choice for spec in chosen if spec.start == letter), default=0)
        spec = replace(self.solver.p2_stage(facets, lin), choice=last + 1)
        return self.run([spec], lin, letter)

    def run(self, specs: Iterable[StageSpec], start: Linearisation, letter: str = "") -> Stage:
        """Run stages in order, each from the end of the one before; return the last that was run."""
        waiting, lin = list(specs), start
        while waiting:
            spec = waiting.pop(0)
            stage = self.solve(replace(spec, start=letter or spec.start), lin)
            lin = stage.result.lin
            if stage.result.status is Status.CONVERGED:
                continue
            in_doubt = spec.doubt and stage.merit.worst_violation(lin) < spec.doubt
            if spec.is_required and not in_doubt:
                break
            if spec.fallback is not None:
                waiting = [spec.fallback, waiting[-1]]
        return stage

    def solve(self, spec: StageSpec, start: Linearisation) -> Stage:
        """Solve one stage, and again with facets that were left out of its program and are violated.

        Raises:
            KeyboardInterrupt: if it was interrupted.
        """
        while True:
            stage = self._solve_once(spec, start)
            rows, start = spec.rows, stage.result.lin
            if not isinstance(rows, ChanceRows):
                return stage
            missed = rows.missed(start, stage.tolerance)
            if not missed.any():
                return stage
            every = ChanceRows(self.task.problem, rows.facets, rows.included | missed)
            spec = replace(spec, rows=every)

    def _near_drifts(self, start: Linearisation, spec: StageSpec) -> Linearisation:
        """The start, with the means of drifts that the last stage found if it has none."""
        if start.iterate.drifts or not spec.rows.problem.drifts:
            return start
        known = (one.drifts for one in reversed(self.stages))
        return start.with_drifts(next(filter(None, known), {}))

    def _solve_once(self, spec: StageSpec, start: Linearisation) -> Stage:
        start = self._near_drifts(start.known(spec.rows.problem.feedback), spec)
        stage = self.solver.solve(spec, start, self.task.dynamics, self.observe)
        stage = replace(stage, result=replace(stage.result, lin=stage.result.lin.informed))
        if spec.judges is not None:
            stage = replace(stage, merit=MeritFunction(self.task.problem, spec.judges))
        self.stages.append(stage)
        self.timing.add(stage.result.timing)
        if stage.result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return stage


def path_ignores_burns(lin: Linearisation) -> bool:
    """Whether a guess has burns, but its path has larger velocity defects than these.

    Two kinds of guesses are no such path: a coarse trajectory of another tool, and a path without
    burns, such as the paper's straight line.
    """
    kicks = float(np.linalg.norm(lin.defects[:-1, 3:], axis=1).sum())
    return NO_BURN < lin.iterate.total_dv < kicks


def without_partial_keep_out(problem: FlybyProblem) -> FlybyProblem:
    """The problem without the keep-out sets of a part of the flight.

    Sets of the whole flight stay: they keep the path away from the dynamics' singularity.
    """
    kept = [c for c in problem.constraints if c.keep == "in" or len(c.nodes) == problem.n_nodes]
    return replace(problem, constraints=tuple(kept))


def _is_hopeless(stage: Stage) -> bool:
    """Whether a drift at a run's end is so far inside a ball that its row knows no way out."""
    margins, drifts = stage.margins, stage.merit.problem.drifts
    return any(margins[drift.name].margin.min() < HOPELESS for drift in drifts)


def _says_less(one: Stage, other: Stage) -> bool:
    """Whether a run ended without a verdict where another proved a hardly larger violation least."""
    least = (run.merit.worst_violation(run.result.lin) for run in (one, other))
    undecided = other.result.status is Status.INFEASIBLE and one.result.status in UNDECIDED
    return undecided and next(least) > HARDLY * next(least)


def same_optimum(one: Stage, other: Stage) -> bool:
    """Whether two runs of P3 ended at the same optimum."""
    low, high = sorted((merit_of(one), merit_of(other)))
    apart = np.abs(one.result.lin.iterate.burns - other.result.lin.iterate.burns).max()
    alike = low > OTHER_OPTIMUM * high and bool(apart < OTHER_BURNS)
    return one.result.status is other.result.status and alike
