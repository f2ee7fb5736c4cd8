"""Solve a stage by sequential convex programming, and list the stages of P3 and P2 with their rows.

A new limit is a constraint of the problem (`mission.constraints`) or a kind of rows
(`formulations.rows`); a new stage is one more `StageSpec`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from time import perf_counter
from typing import Any, Final, Generic, Protocol, TypeVar

import numpy as np

from formulations.arrays import Booleans
from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import Facets, choose_facets
from formulations.program.subproblem import Subproblem
from formulations.registry import FULL, make_subproblem
from formulations.rows.cones import Rows
from formulations.rows.exact import NodeRows
from formulations.rows.exact_flight import FlightRows
from formulations.rows.uniform import ChanceRows, DeterministicRows
from scp_recon.errors import InputError
from scp_recon.planning.method import ALGORITHM, FORMULATION, SOLVER
from scp_recon.planning.plan import PlanningProblem, Stage, StageSpec
from scp_recon.scp.algorithms import ALGORITHMS
from scp_recon.scp.loop import Algorithm, Record, run
from scp_recon.scp.verdict import REACH, decide

FEW_LINES, FEW_WITH_GAINS, LINES = 512, 1024, 4096
"""Directions, each taken both ways, by which the probability of whole flights is computed: in the
coarse stage, in the coarse stage with corrected burns, and in the final stage. With gains the kinks
between few directions stop the search early."""

FEW_ERR = 0.05
"""Standard deviations by which few directions may miss what many tell: the coarse stage called cases
infeasible by up to 0.005 that the final stage solves. With gains a stage takes too
long for the doubt."""

COARSE, FINE = 1e-3, 1e-5
COARSE_WITH_GAINS, FINE_WITH_GAINS = 1e-2, 1e-4
FINE_WITH_DRIFTS = 3e-5
"""Relative reduction of the merit at which a coarse and a final stage stop; sampling errs by more.
Gains are many, and the merit is flat in them. Few directions, aimed at flights without gains, say
little about flights with gains: with 1e-3 the coarse stage took up to 38 iterations in their kinks."""

WEIGHT = 100.0
"""First penalty weight with a limit on the final covariance, whose multiplier may exceed the usual
weight of ten. At the next weight of a thousand, the resolution of the probability of whole flights
would hide the possible reductions of cost."""


GROWN = 0.65, 0.8, 0.9
"""Radii of the balls that drifts keep out of, over their own, in stages that lead out of them. Larger
steps end inside the next ball."""

ITERATIONS_WITH_GAINS = 100
"""Limit of a stage's iterations where burns are corrected: twice the usual one."""

LED_ITERATIONS, LED_RISK = 30, 0.3
"""Of the stage that leads to gains if no plan without gains is feasible: limit of its iterations, and
risk at a node over the risk of a whole flight. Flights fail more often than any of their nodes."""

RESOLUTION = 1e-3
"""Relative reduction of the merit at which the open stage stops: P3 continues from there."""

NO_BURN = 1e-6
"""Total delta-v, nondimensional, below which a guess has no burns that could be wrong."""

AnyProblem = TypeVar("AnyProblem", bound=PlanningProblem)


class Observer(Protocol):
    """Observes planning."""

    def __call__(self, stage: str, record: Record, /) -> None:
        """Called after each iteration with the name of the stage and the record."""


def unobserved(stage: str, record: Record, /) -> None:
    """Ignore an iteration."""


class StageSolver(Generic[AnyProblem]):
    """Lists and solves stages; keeps its compiled subproblems and solvers. IPOPT's is derived.

    They serve any task with the same constraints, burn nodes and nodes.

    Args:
        task: the problem to plan.
        formulation: of the convex program.
        algorithm: "scvx", "ptr" or "scvx-star".
        solver: of the convex programs.
        target: probability of exact constraints, by default the task's.
        p3_resolution: relative reduction of the merit at which P3 stops if P2 follows.
        others: whether other algorithms are tried where exact risk ends badly.

    Raises:
        InputError: if the algorithm cannot weigh a miss of the final state where that is needed.
    """

    def __init__(
        self,
        task: AnyProblem,
        *,
        formulation: str = FORMULATION,
        algorithm: str = ALGORITHM,
        solver: str = SOLVER,
        target: float | None = None,
        p3_resolution: float = 0.0,
        others: bool = True,
    ) -> None:
        self.task, self._has_others = task, others
        self.target: Final = task.risk.p_chance if target is None else target
        self.names = formulation, algorithm, solver
        limited = any(limit is not None for limit in task.problem.final_spread)
        special: dict[str, float] = {"weight": WEIGHT} if limited else {}
        if task.problem.feedback is not None:
            special["max_iterations"] = ITERATIONS_WITH_GAINS
        self.algorithm: Algorithm = ALGORITHMS[algorithm](**special)
        self._special = special
        if self.algorithm.penalty == "augmented" and task.problem.miss_weight is not None:
            must = "must be scvx or ptr where too few burns are left to meet the final state"
            raise InputError("algorithm", algorithm, must)
        if formulation not in FULL:
            task.require_plain(f"the formulations {' and '.join(FULL)}, not with {formulation}")
        self._resolution = p3_resolution
        self._p2: StageSpec | None = None
        self._kept: dict[type[Rows], Subproblem] = {}

    @cached_property
    def p3(self) -> StageSpec:
        """P3 with all its constraints."""
        return StageSpec("P3", DeterministicRows(self.task.problem.open_loop, self._resolution))

    def p3_stages(self, start: Linearisation) -> Sequence[StageSpec]:
        """Stages of P3 from a start: first an open stage if its path ignores its burns.

        A keep-out set is linearised by the plane that touches it nearest to the iterate, so an iterate
        stays on its side of the set. If a guess does not obey the dynamics, its path says nothing about
        the right side. The open stage has no keep-out sets of a part of the flight, and its answer
        hardly depends on the guess; P3 continues with all sets, on the side nearest to that answer. It
        costs at most as much as any plan with all sets, and is judged by all rows. Sets of the whole
        flight stay: they keep the path away from the dynamics' singularity.
        """
        return [self._open, self.p3] if path_ignores_burns(start) else [self.p3]

    @cached_property
    def _open(self) -> StageSpec:
        problem = self.task.problem.open_loop
        kept = [c for c in problem.constraints if c.keep == "in" or len(c.nodes) == problem.n_nodes]
        rows = DeterministicRows(replace(problem, constraints=tuple(kept)), RESOLUTION)
        return StageSpec("P3", rows, "open", judges=self.p3.rows)

    def p2_stage(self, facets: Facets, lin: Linearisation, *, again: bool = False) -> StageSpec:
        """P2 with given facets; its program includes those near an iterate. The last is kept.

        It moves less if begun `again`, from a solution of P2.
        """
        included = screened(facets, lin, self.task.clearances[again])
        kept = self._p2.rows if self._p2 else None
        if (
            self._p2 is None
            or not isinstance(kept, ChanceRows)
            or kept.facets is not facets
            or np.any(kept.included != included)
        ):
            self._p2 = StageSpec("P2", ChanceRows(self.task.problem, facets, included))
        return self._p2

    def exact_stages(self, *, growing: bool = False) -> Sequence[StageSpec]:
        """Stages of P2 with exact risk, each started from the end of the one before.

        If `growing`, stages whose drifts keep out of smaller balls come first.

        Raises:
            InputError: if the method cannot plan exact risk.
        """
        formulation = self.names[0]
        if formulation not in FULL:
            needs = f"goes with the formulations {' and '.join(FULL)}, not with {formulation}"
            raise InputError("risk.allocation", "'exact'", needs)
        if not growing:
            return self._exact
        plain = self.task.problem.open_loop
        grown = []
        for share in GROWN:
            drifts = tuple(drift.shrunk(share) for drift in plain.drifts)
            rows = NodeRows(replace(plain, drifts=drifts), self.target, COARSE)
            grown.append(StageSpec("P2", rows, "grown", is_required=True))
        return [*grown, *self._exact]

    @cached_property
    def _exact(self) -> list[StageSpec]:
        """The stages of exact risk, made once, because drawing the directions takes time.

        A plan of whole flights begins at one of nodes, then with few directions. A whole flight never
        has a larger probability than its nodes. It is therefore infeasible if the nodes are. A plan
        with corrected burns starts from a plan without; a case without such a plan may have one with
        corrections, to which the stage "led" leads. That stage is of nodes also for whole flights: the
        probability at nodes is smooth, that of flights in few directions has kinks, where the search
        would stop.
        """
        problem, target = self.task.problem, self.target
        gains, plain = problem.feedback is not None, problem.open_loop
        if self.task.risk.scope == "node":
            if not gains:
                resolution = FINE_WITH_DRIFTS if problem.drifts else 0.0
                return [StageSpec("P2", NodeRows(problem, target, resolution), is_required=True)]
            closed = NodeRows(problem, target, FINE_WITH_GAINS)
            return [
                StageSpec("P2", NodeRows(plain, target, COARSE), "open"),
                StageSpec("P2", closed, is_required=True),
            ]
        few, rough, fine, led, doubt = FEW_LINES, COARSE, FINE, None, FEW_ERR
        if gains:
            few, rough, fine, doubt = FEW_WITH_GAINS, COARSE_WITH_GAINS, FINE_WITH_GAINS, 0.0
            least = NodeRows(problem, 1.0 - LED_RISK * (1.0 - target), COARSE)
            led = StageSpec("P2", least, "led", max_iterations=LED_ITERATIONS)
        nodes, coarse = NodeRows(plain, target, COARSE), FlightRows(problem, target, few, rough)
        whole = FlightRows(problem, target, LINES, fine, coarse)
        return [
            StageSpec("P2", nodes, "node", is_required=not gains, fallback=led),
            StageSpec("P2", coarse, "coarse", is_required=True, doubt=doubt),
            StageSpec("P2", whole, is_required=True),
        ]

    def subproblem(self, rows: Rows) -> Subproblem:
        """The convex subproblem with some rows; the last ones of P3 and of P2 are kept."""
        kept = self._kept.get(type(rows))
        if kept is None or kept.merit.rows is not rows:
            formulation, _, solver = self.names
            penalty = self.algorithm.penalty
            kept = make_subproblem(rows.problem, rows, formulation, solver, penalty)
            self._kept[type(rows)] = kept
        return kept

    def solve(
        self, spec: StageSpec, start: Linearisation, dynamics: Dynamics, observe: Observer
    ) -> Stage:
        """Solve a stage from a start; its status says if it was interrupted.

        A stage that holds burns keeps the directions of the stage before it.
        """
        begin, rows, algorithm = perf_counter(), spec.rows, self.algorithm
        if isinstance(rows, FlightRows) and rows.problem.feedback and spec.role != "held":
            rows.aim(start)
        subproblem = self.subproblem(rows)
        setup = perf_counter() - begin
        if spec.max_iterations is not None:
            own: dict[str, Any] = {"max_iterations": spec.max_iterations}
            if spec.weight is not None:
                own |= dict.fromkeys(("weight", "weight_max", "weight_limit"), spec.weight)
            algorithm = ALGORITHMS[self.names[1]](**self._special | own)
        resolution = max(rows.resolution, spec.resolution)
        algorithm = algorithm.resolving(resolution)
        seen, rough = partial(observe, spec.name), spec.max_iterations is not None
        result = run(subproblem, dynamics, start, algorithm, seen, rough=rough)
        formulation, _, solver = self.names
        # Frozen derivatives prove nothing, and a stage of few iterations is not asked to.
        if formulation in FULL and not rough:
            slopes = None
            if isinstance(rows, FlightRows):
                rows = rows.bundled()
                near = rows.sloped(REACH)
                slopes = partial(make_subproblem, rows.problem, near, "condensed", solver)
            make = partial(make_subproblem, rows.problem, rows, formulation, solver)
            result = decide(make, slopes, dynamics, result, resolution, seen)
        result.timing.setup += setup
        return Stage(spec, result, subproblem.merit, algorithm.feasible)

    @cached_property
    def others(self) -> Mapping[str, StageSolver[AnyProblem]]:
        """Other algorithms by their names, for exact risk where the usual one ends badly.

        None where another was chosen, nor with feedback, where each takes as long as a plan.
        """
        formulation, algorithm, solver = self.names
        if not self._has_others or algorithm != ALGORITHM or self.task.problem.feedback is not None:
            return {}
        may_miss = self.task.problem.miss_weight is not None
        make = partial(StageSolver, self.task, formulation=formulation, solver=solver)
        names = ("ptr",) if may_miss else ("ptr", "scvx-star")
        return {name: make(algorithm=name, target=self.target) for name in names}

    @cached_property
    def scout(self) -> StageSolver[AnyProblem]:
        """The method that chooses facets for this one: the quickest, the same for every method."""
        usual = self.names == (FORMULATION, ALGORITHM, SOLVER)
        return self if usual else StageSolver(self.task)


def path_ignores_burns(lin: Linearisation) -> bool:
    """Whether a guess has burns, but its path has larger velocity defects than these.

    Two kinds of guesses are no such path: a coarse trajectory of another tool, and a path without
    burns, such as the paper's straight line.
    """
    kicks = float(np.linalg.norm(lin.defects[:-1, 3:], axis=1).sum())
    return NO_BURN < lin.iterate.total_dv < kicks


def facets_at(task: PlanningProblem, lin: Linearisation) -> Facets:
    """Facets chosen along a path: see `choose_facets`."""
    return choose_facets(task.problem, task.polytopes, lin.iterate.mean, lin.spread.factor)


def screened(facets: Facets, lin: Linearisation, clearance: float) -> Booleans:
    """Facets that take part in the program of P2 to begin with, shape (facets,).

    Those farther from binding at an iterate than the clearance are checked after it, and restored if
    one of them turns out to matter.
    """
    return np.asarray(facets.margin(lin.iterate.mean, lin.spread.factor) < clearance)
