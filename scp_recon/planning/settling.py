"""Settle the facets of P2: choose them again along the plans that they allow, until none is cheaper.

A keep-out polytope is a disjunction: any of its facets keeps the spacecraft outside. Which one does so
at the least delta-v is known only with the plan. Facets are therefore chosen again along each plan
(`choose_facets`), and P2 is solved again, roughly. Once a new choice is no cheaper, facets change only
at nodes where the new ones hold too (`Facets.where_they_hold`), which cannot lose the plan. Facets and
plan together are a local optimum. Rounds therefore begin along P2's plan with P3's facets, and along a
rough plan with exact risk at nodes, which needs no facets; the cheaper end counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import Facets, choose_facets
from formulations.rows.exact import NodeRows
from formulations.rows.uniform import ChanceRows
from scp_recon.planning.plan import Stage, StageSpec, is_converged, rank
from scp_recon.planning.problem import PlanningProblem

ROUGH = 1e-3
"""Relative reduction of the merit at which a round stops; a choice that saves less is no better."""

PATH = 1e-2
"""The same of the plan with exact risk, of which only the path counts."""

ROUND_ITERATIONS, FIRST_ITERATIONS = 8, 12
"""Limits of iterations of a round: from a plan with neighbouring facets, and from any other path."""

ROUNDS_MAX = 30
"""Limit of the number of rounds along the plans of one path."""

CHOICES_MAX = 4
"""Choices of facets along paths that violate them, after which a path is given up."""

NEAR_P3 = 1.01
"""Cost of P2 over P3's, which no choice of facets undercuts, up to which no further path is tried."""

Run = Callable[[StageSpec, Linearisation], Stage]


@dataclass(frozen=True)
class Settling:
    """Rounds of choosing facets: the problem to plan, and what runs a stage from a start."""

    task: PlanningProblem
    run: Run

    def __call__(self, first: Stage, p3: Stage) -> Stage | None:
        """The best round, from a plan of P2 with facets along P3's path; None if none has a plan."""
        found = [self._along_plan(first) if is_converged(first) else self.along(first.result.lin)]
        cost, least = (one.merit.cost(one.result.lin) for one in (found[0], p3))
        if not is_converged(found[0]) or cost > NEAR_P3 * least:
            found.append(self.along(self.exact_path(p3.result.lin)))
        best = max(found, key=rank)
        return best if is_converged(best) else None

    def exact_path(self, start: Linearisation) -> Linearisation:
        """A rough plan with exact risk at nodes, from a start."""
        rows = NodeRows(self.task.problem.open_loop, self.task.risk.p_chance, PATH)
        return self.run(StageSpec("P2", rows, "node"), start).result.lin

    def along(self, lin: Linearisation) -> Stage:
        """Settle along a path; the best choice so far where none has a plan."""
        tries: list[Stage] = []
        while len(tries) < CHOICES_MAX:
            tries.append(self._round(self._fresh(lin), lin, FIRST_ITERATIONS))
            if is_converged(tries[-1]):
                return self._along_plan(tries[-1])
            lin = tries[-1].result.lin
        return max(tries, key=rank)

    def _along_plan(self, best: Stage) -> Stage:
        """Choose facets along a plan and those that follow, all anew and then where they hold."""
        rounds = 0
        for holding in (False, True):
            gains = True
            while gains and rounds < ROUNDS_MAX:
                rounds += 1
                lin, facets = best.result.lin, self._fresh(best.result.lin)
                if holding and best.facets is not None:
                    facets = best.facets.where_they_hold(facets, lin.iterate.mean, lin.factor)
                again = self._round(facets, lin, ROUND_ITERATIONS)
                gains = rank(again) > rank(best, saving=ROUGH)
                best = max(best, again, key=rank)
        return best

    def _round(self, facets: Facets, lin: Linearisation, iterations: int) -> Stage:
        """Solve P2 roughly with given facets from a start."""
        included = facets.margin(lin.iterate.mean, lin.factor) < self.task.clearances[1]
        rows = ChanceRows(self.task.problem, facets, included, ROUGH)
        return self.run(StageSpec("P2", rows, "settled", max_iterations=iterations), lin)

    def _fresh(self, lin: Linearisation) -> Facets:
        task = self.task
        return choose_facets(task.problem, task.polytopes, lin.iterate.mean, lin.factor)
