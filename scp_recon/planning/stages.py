"""Run the stages of a plan by any method: P3, P2, and both again from other starts.

A stage is data (`plan.StageSpec`): a problem's rows, and what follows if it does not converge. A
`StageSolver` lists the stages of P3 and P2 and solves one; `Pipeline.run` is the loop over a list.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Generic

import numpy as np

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import Iterate
from formulations.program.subproblem import MeritFunction
from formulations.rows.drift import HOPELESS
from formulations.rows.uniform import ChanceRows
from scp_recon.planning.method import SETTLE, FacetRounds
from scp_recon.planning.plan import Stage, StageSpec, is_converged, merit_of, rank
from scp_recon.planning.records import Problem
from scp_recon.planning.settling import Settling
from scp_recon.planning.solver import AnyProblem, Observer, StageSolver, facets_at, unobserved
from scp_recon.scp.loop import Timing
from scp_recon.scp.status import Status
from scp_recon.scp.verdict import UNDECIDED

OTHER_OPTIMUM = 0.999
"""Ratio of two merits below which the runs ended at different optima."""

OTHER_BURNS = 1e-2
"""Burns whose components differ by more, nondimensional, are different optima."""

HARDLY = 0.5
"""Share of a least violation above which that of a run without a verdict refutes nothing."""
DOUBTFUL = 1.3
"""Cost of exact risk over P3's above which other algorithms are tried: it may be a poor optimum."""

CHOICES_MAX = 4
"""Further choices of facets before P2 is called infeasible, where there is another choice."""


@dataclass
class Pipeline(Generic[AnyProblem]):
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

    task: AnyProblem
    solver: StageSolver[Any]
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
        lin, problem = p3.result.lin, self.task.problem
        if self.task.risk.allocation == "exact":
            final = self.exact(lin, letter)
            # A drift may be so far inside a ball that its row knows no way out.
            margins = {} if is_converged(final) or not problem.drifts else final.margins
            if any(margins[one.name].margin.min() < HOPELESS for one in problem.drifts if margins):
                grown = self.run(self.solver.exact_stages(growing=True), lin, letter)
                final = grown if is_converged(grown) else final
            doubtful = final.result.is_weighed or merit_of(final) > DOUBTFUL * merit_of(p3)
            return self._by_others(final, p3) if doubtful and is_converged(final) else final
        scouting = Pipeline(self.task, self.solver.scout)
        settling = Settling(self.task, scouting.solve)
        if problem.drifts:  # P3 has none, so its path says little about the facets
            lin = settling.exact_path(lin)
        best = self._with_facets(lin, letter)
        if self.facet_rounds == SETTLE:
            settled = settling(best, p3)
            assert settled.facets is not None
            lin = settled.result.lin.with_drifts(settled.drifts)
            spec = replace(self.solver.p2_stage(settled.facets, lin), role="settled")
            found = self.run([spec], lin, letter)
            if found.result.status is Status.STALLED:  # too near to its end for frozen derivatives
                found = max(found, self.run([spec], p3.result.lin, letter), key=rank)
            best = max(best, found, key=rank)
        else:
            for _ in range(self.facet_rounds):
                again = self._with_facets(best.result.lin, letter)
                if not rank(again) > rank(best):
                    break
                best = again
        self.timing.add(scouting.timing)
        return best

    def exact(self, lin: Linearisation, letter: str = "") -> Stage:
        """Solve P2 with exact risk; a start with gains keeps them and skips stages without gains."""
        stages, feedback = self.solver.exact_stages(), self.task.problem.feedback
        if lin.iterate.gains.any():
            stages = [one for one in stages if one.rows.problem.feedback is feedback]
        return self.run(stages, lin, letter)

    def _by_others(self, found: Stage, p3: Stage) -> Stage:
        """Solve P2 with exact risk by other algorithms too, whose stages end in their names.

        An end without a verdict says less than a proof that a hardly larger violation is the least.
        """
        best = found
        for name, solver in self.solver.others.items():
            runs = Pipeline(self.task, solver, self.observe)
            named = [
                replace(spec, title=f"{replace(spec, start=p3.spec.start).name}.{name}")
                for spec in solver.exact_stages()
            ]
            other = runs.run(named, p3.result.lin, p3.spec.start)
            proved = best.result.status is Status.INFEASIBLE and other.result.status in UNDECIDED
            says_less = proved and other.violation > HARDLY * best.violation
            better = rank(other) > rank(best, saving=1.0 - OTHER_OPTIMUM)
            best = other if better and not says_less else best
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
            if facets is not None and facets.are_near(facets_at(self.task, lin)):
                break
            tries.append(self._with_facets(lin, letter))
        verdicts = (Status.CONVERGED, stage.result.status)
        return max((one for one in tries if one.result.status in verdicts), key=rank)

    def _with_facets(self, lin: Linearisation, letter: str) -> Stage:
        """Solve P2 with facets chosen at a start."""
        facets = facets_at(self.task, lin)
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
            in_doubt = spec.doubt and stage.violation < spec.doubt
            if spec.is_required and not in_doubt:
                break
            if spec.fallback is not None:
                waiting = [spec.fallback, waiting[-1]]
        return stage

    def solve(self, spec: StageSpec, start: Linearisation) -> Stage:
        """Solve one stage, and again with facets that were left out of its program and are violated.

        A start without means of drifts has those that the last stage found.

        Raises:
            KeyboardInterrupt: if it was interrupted.
        """
        while True:
            problem = spec.rows.problem
            start = start.known(problem.feedback)
            if problem.drifts and not start.iterate.drifts:
                known = (one.drifts for one in reversed(self.stages))
                start = start.with_drifts(next(filter(None, known), {}))
            stage = self.solver.solve(spec, start, self.task.dynamics, self.observe)
            start = stage.result.lin.informed
            stage = replace(stage, result=replace(stage.result, lin=start))
            if spec.judges is not None:
                stage = replace(stage, merit=MeritFunction(self.task.problem, spec.judges))
            self.stages.append(stage)
            self.timing.add(stage.result.timing)
            if stage.result.status is Status.INTERRUPTED:
                raise KeyboardInterrupt
            rows = spec.rows
            if not isinstance(rows, ChanceRows):
                return stage
            missed = rows.missed(start, stage.tolerance)
            if not missed.any():
                return stage
            every = ChanceRows(self.task.problem, rows.facets, rows.included | missed)
            spec = replace(spec, rows=every)


def same_optimum(one: Stage, other: Stage) -> bool:
    """Whether two runs of P3 ended at the same optimum."""
    low, high = sorted((merit_of(one), merit_of(other)))
    apart = np.abs(one.result.lin.iterate.burns - other.result.lin.iterate.burns).max()
    alike = low > OTHER_OPTIMUM * high and bool(apart < OTHER_BURNS)
    return one.result.status is other.result.status and alike
