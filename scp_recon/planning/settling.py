"""Settle the facets of P2: choose them again along the plans that they allow, until none is cheaper.

A keep-out polytope is a disjunction: any of its facets keeps the spacecraft outside. Which one does so
at the least delta-v is known only with the plan. Facets are therefore chosen again along each flight
(`choose_facets`), and P2 is solved again, roughly. Once a new choice is no better, facets change only
at nodes where the new ones hold too (`Facets.where_they_hold`), which cannot lose the plan. A round is
judged by cost and violations at the first penalty weight, which is raised once the facets have settled:
facets chosen along flights that violate them a little are far cheaper than those along dear plans.

Facets and plan together are a local optimum. Rounds therefore begin along a rough plan whose regions
are half-spaces that touch them, which is exact risk to first order. Unless that ends near the rough
plan's cost, they begin also along P2's plan with P3's facets; where that is no plan, or needed a larger
weight, along its end and P3's path; and where all these end dear, along a rough plan with exact risk at
nodes, from the rough plan and, where nothing holds yet, from P3's. The cheapest end counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import Facets, touching_facets
from formulations.rows.exact import NodeRows
from formulations.rows.uniform import ChanceRows
from scp_recon.planning.method import FACET_ROUNDS_MAX
from scp_recon.planning.plan import PlanningProblem, Stage, StageSpec, is_converged, merit_of
from scp_recon.planning.solver import facets_at, screened
from scp_recon.scp.algorithms import SCvx

ROUGH = 1e-3
"""Relative reduction of the merit at which a round stops."""

WORTH = 2e-4
"""Relative reduction of the merit below which a choice is no better."""

WEIGHTS = (SCvx.weight, 1000.0)
"""Penalty weights of violations: of all rounds, and of those that follow where violations are left."""

HOLDS = 1e-4
"""Violation, nondimensional, that a rough round leaves where there is a plan."""

FIRST_ITERATIONS, ANEW_ITERATIONS, HOLDING_ITERATIONS = 8, 2, 1
"""Limits of iterations of a round: from any flight, and from one with neighbouring facets, chosen all
anew or where they hold."""

TOUCHING_ROUNDS, TOUCHING_ITERATIONS = 2, 3
"""Rounds of the rough plan with half-spaces that touch the regions, and their iterations."""

NEAR, DEAR = 1.01, 1.05
"""Cost over that of the rough plan up to which no further path is tried, and cost over P3's above which
a plan with exact risk is worth its time: up to 0.6 % lay behind paths that ended 8 to 20 % above P3."""

PATH = 1e-2
"""Relative reduction of the merit at which that plan stops, of which only the path counts."""

Run = Callable[[StageSpec, Linearisation], Stage]


@dataclass(frozen=True)
class Settling:
    """Rounds of choosing facets: the problem to plan, and what runs a stage from a start."""

    task: PlanningProblem
    run: Run

    def __call__(self, first: Stage, p3: Stage) -> Stage:
        """The best round of all paths, from the plan of P2 with facets along P3's path."""
        lin = p3.result.lin
        for _ in range(TOUCHING_ROUNDS):
            touching = touching_facets(self.task.problem, lin.iterate.mean)
            rough = self._round(touching, lin, TOUCHING_ITERATIONS, WEIGHTS[0])
            lin = rough.result.lin
        begun: list[Facets] = []
        found = self._along([lin], begun)
        if _price(found[0]) > NEAR * max(rough.cost, p3.cost):
            if is_converged(first) and not first.result.is_weighed:
                found.append(self._settled(first, WEIGHTS[0]))
            else:
                found += self._along([one.result.lin for one in (p3, first)], begun)
            if min(_price(one) for one in found) > DEAR * p3.cost:
                found += self._along([self.exact_path(lin)], begun)
            if min(_price(one) for one in found) == math.inf:
                found += self._along([self.exact_path(p3.result.lin)], begun)
        return self._best(found)

    def exact_path(self, start: Linearisation) -> Linearisation:
        """A rough plan with exact risk at nodes, from a start."""
        rows = NodeRows(self.task.problem.open_loop, self.task.risk.p_chance, PATH)
        return self.run(StageSpec("P2", rows, "node"), start).result.lin

    def _along(self, paths: Sequence[Linearisation], begun: list[Facets]) -> list[Stage]:
        """Settle at the first weight along each path on which no earlier path's facets are chosen."""
        found = []
        for lin in paths:
            facets = facets_at(self.task, lin)
            if any(facets.are_near(others) for others in begun):
                continue
            begun.append(facets)
            first = self._round(facets, lin, FIRST_ITERATIONS, WEIGHTS[0])
            found.append(self._settled(first, WEIGHTS[0]))
        return found

    def _best(self, settled: Sequence[Stage]) -> Stage:
        """The best of flights settled at the first weight, which is raised where violations are left.

        Not where the merit is above the cost of a plan: a larger weight makes no merit smaller.
        """
        best: list[Stage] = []
        for one in sorted(settled, key=merit_of):
            least = min((_price(other) for other in best), default=math.inf)
            if one.violation <= HOLDS:
                best.append(one)
            elif merit_of(one) < least:
                assert one.facets is not None
                weight = WEIGHTS[1]
                again = self._round(one.facets, one.result.lin, FIRST_ITERATIONS, weight)
                best.append(self._settled(again, weight))
        return max(best, key=lambda one: (one.violation <= HOLDS, -merit_of(one, WEIGHTS[1])))

    def _settled(self, best: Stage, weight: float) -> Stage:
        """Choose facets along a flight and those that follow, all anew and then where they hold."""
        rounds, known = 0, best.facets if is_converged(best) else None
        for holding, iterations in ((False, ANEW_ITERATIONS), (True, HOLDING_ITERATIONS)):
            gains = True
            while gains and rounds < FACET_ROUNDS_MAX:
                rounds += 1
                lin, facets = best.result.lin, facets_at(self.task, best.result.lin)
                if holding and best.facets is not None:
                    facets = best.facets.where_they_hold(
                        facets, lin.iterate.mean, lin.spread.factor
                    )
                if known is not None and known.are_near(facets):
                    break
                again = self._round(facets, lin, iterations, weight)
                merit, least = merit_of(again, weight), merit_of(best, weight)
                gains = merit < (1.0 - WORTH) * least
                best = again if merit < least else best
                known = facets if best is not again or is_converged(again) else None
        return best

    def _round(self, facets: Facets, lin: Linearisation, iterations: int, weight: float) -> Stage:
        """Solve P2 roughly with given facets and penalty weight from a start."""
        included = screened(facets, lin, self.task.clearances[1])
        rows = ChanceRows(self.task.problem, facets, included, ROUGH)
        spec = StageSpec("P2", rows, "settled", max_iterations=iterations, weight=weight)
        return self.run(spec, lin)


def _price(stage: Stage) -> float:
    """Cost of a plan; without bound where violations are left."""
    return stage.cost if stage.violation <= HOLDS else math.inf
