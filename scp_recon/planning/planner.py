"""Plan by sequential convex programming: P3, facets at its solution or exact risk, P2.

`Planner` lists the stages of a problem with their rows. A new limit is a constraint of the problem
(`mission.constraints`) or a kind of rows (`formulations.rows`); a new stage is one more `StageSpec`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from time import perf_counter
from typing import Any, Final, Generic, Literal, TypeVar

import numpy as np

from formulations.arrays import Array, Booleans
from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.facets import Facets
from formulations.problem.flyby import Iterate
from formulations.program.subproblem import Subproblem
from formulations.registry import FULL, make_subproblem
from formulations.rows.cones import Rows
from formulations.rows.exact import NodeRows
from formulations.rows.exact_flight import FlightRows
from formulations.rows.uniform import ChanceRows, DeterministicRows
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning.method import ALGORITHM, FORMULATION, SOLVER, FacetRounds
from scp_recon.planning.missions import continued, flown, make_plan, other_starts
from scp_recon.planning.plan import Plan, PlanningProblem, Provenance, Stage, StageSpec
from scp_recon.planning.records import Problem
from scp_recon.planning.stages import (
    RESOLUTION,
    Observer,
    Pipeline,
    StageSolver,
    path_ignores_burns,
    unobserved,
    without_partial_keep_out,
)
from scp_recon.scp.algorithms import ALGORITHMS
from scp_recon.scp.loop import Algorithm, run
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


AnyProblem = TypeVar("AnyProblem", bound=PlanningProblem)


class Planner(Generic[AnyProblem]):
    """A `StageSolver` by SCP that keeps its compiled subproblems and solvers; IPOPT's is derived.

    They serve any task with the same constraints, burn nodes and nodes: see `plan` and `replan`.

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

    method: Literal["scp", "ipopt"] = "scp"

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
            raise InputError(
                "algorithm",
                algorithm,
                "must be scvx or ptr where too few burns are left to meet the final state",
            )
        if formulation not in FULL:
            task.require_plain(f"the formulations {' and '.join(FULL)}, not with {formulation}")
        self._resolution = p3_resolution
        self._p2: StageSpec | None = None
        self._kept: dict[type[Rows], Subproblem] = {}

    @cached_property
    def p3(self) -> StageSpec:
        """P3 with all its constraints."""
        return StageSpec("P3", DeterministicRows(self.task.problem.open_loop, self._resolution))

    @cached_property
    def _open(self) -> StageSpec:
        """P3 without the keep-out sets of a part of the flight, judged by all rows."""
        problem = without_partial_keep_out(self.task.problem.open_loop)
        rows = DeterministicRows(problem, RESOLUTION)
        return StageSpec("P3", rows, "open", judges=self.p3.rows)

    def p3_stages(self, start: Linearisation) -> Sequence[StageSpec]:
        """P3, after the open stage if the start's path ignores its burns."""
        return [self._open, self.p3] if path_ignores_burns(start) else [self.p3]

    def p2_stage(self, facets: Facets, lin: Linearisation, *, again: bool = False) -> StageSpec:
        """See `StageSolver`; the last is kept. `again` from a solution of P2, which moves less."""
        included = screened(facets, lin, self.task.clearances[again])
        kept = self._p2.rows if self._p2 else None
        if (
            not isinstance(kept, ChanceRows)
            or kept.facets is not facets
            or (np.any(kept.included != included))
        ):
            self._p2 = StageSpec("P2", ChanceRows(self.task.problem, facets, included))
        assert self._p2 is not None
        return self._p2

    def exact_stages(self, *, growing: bool = False) -> Sequence[StageSpec]:
        """See `StageSolver`."""
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
        """See `StageSolver`. A stage that holds burns keeps the directions of the stage before it."""
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
    def others(self) -> Mapping[str, StageSolver]:
        """See `StageSolver`; none where another algorithm than the usual one was chosen.

        Nor with feedback, where each takes as long as a plan.
        """
        formulation, algorithm, solver = self.names
        may_miss = self.task.problem.miss_weight is not None
        names = ("ptr",) if may_miss else ("ptr", "scvx-star")
        return {
            name: Planner(
                self.task,
                formulation=formulation,
                algorithm=name,
                solver=solver,
                target=self.target,
            )
            for name in names
            if self._has_others and algorithm == ALGORITHM and self.task.problem.feedback is None
        }

    @cached_property
    def scout(self) -> StageSolver:
        """See `StageSolver`: this planner, if it plans as usual, or one that does."""
        usual = self.names == (FORMULATION, ALGORITHM, SOLVER)
        return self if usual else Planner(self.task)

    def plan(
        self: Planner[Mission],
        guess: Iterate | Plan,
        *,
        problem: Problem = "P2",
        facet_rounds: FacetRounds = 0,
        init: str = "given",
        observe: Observer | None = None,
        once: bool = False,
    ) -> Plan:
        """Solve P3 from the guess, choose the facets at its solution, and solve P2 from there.

        The guess may have defects. Exact risk continues from a plan, or a guess with gains, with its
        last stage, burns and gains together, and from the burns where that does not converge. Unless
        `once`, a stage that does not converge is tried from other starts (see `Pipeline.plan`), also
        where a last stage finds the case infeasible. In each of `facet_rounds` the facets are chosen
        again at the solution and P2 is solved again; a round is kept only if it is better (`rank`), so
        that facets cannot cycle. "settle" chooses them until none is cheaper: see `planning.settling`.
        Facets that leave nothing feasible are always chosen again, up to `CHOICES_MAX` times. Burns too
        small to execute are left out or raised (`missions.executable`). The observer is called after
        each iteration with the stage's name and the record.
        """
        mission = self.task
        pipeline = Pipeline(mission, self, observe or unobserved, facet_rounds)

        def work() -> Stage:
            start = flown(mission, guess) if isinstance(guess, Plan) else guess
            goes_on = problem == "P2" and (isinstance(guess, Plan) or start.gains.any())
            if goes_on and (stage := continued(mission, pipeline, start, once=once)):
                return stage
            return pipeline.plan(start, problem, () if once else other_starts(mission))

        known = guess.without_uncertainty if isinstance(guess, Plan) else None
        leads = problem == "P3" and self._resolution > 0.0
        made = self._provenance(init)
        return make_plan(mission, pipeline, work, *made, known, executes=not leads)

    def replan(self: Planner[Mission], last: Plan, initial_state: Array) -> Plan:
        """Solve P2 again for another initial state, from the last plan and with its facets.

        The state is that before the first burn, J2000, SI, shape (6,); its covariance is the mission's
        fraction of it. The last plan must be one of P2 by this planner; the new one's `mission` begins
        at the state.

        Raises:
            ValueError: if the plan is not one of P2, its mission differs in more than the initial
                state, or the state is not outside the body.
        """
        facets, lin = last.final.facets, last.final.result.lin
        if last.final.problem != "P2":
            raise ValueError("only a plan of P2 can be planned again")
        if last.mission.with_initial_state(initial_state).scenario != (
            self.task.with_initial_state(initial_state).scenario
        ):
            raise ValueError("the plan is of another mission")
        mission = self.task.with_initial_state(initial_state)
        pipeline = Pipeline(mission, self)

        def work() -> Stage:
            if facets is None:
                return pipeline.exact(pipeline.start(lin.iterate))
            # The last plan's iterate knows its factor; the facets are screened there.
            spec = self.p2_stage(facets, lin, again=True)
            return pipeline.choose_again(pipeline.solve(spec, pipeline.start(lin.iterate)))

        return make_plan(mission, pipeline, work, *self._provenance("plan"))

    def _provenance(self, init: str) -> tuple[Provenance, float | None]:
        """Words on how a plan is made, and the target probability of exact risk."""
        exact = self.task.risk.allocation == "exact"
        return Provenance(*self.names, init, self.method), self.target if exact else None


def plan(
    mission: Mission,
    guess: Iterate | Plan,
    *,
    formulation: str = FORMULATION,
    algorithm: str = ALGORITHM,
    solver: str = SOLVER,
    target: float | None = None,
    p3_resolution: float = 0.0,
    others: bool = True,
    **how: Any,
) -> Plan:
    """Plan a mission once: `Planner.plan` with its arguments and those of `Planner`."""
    planner = Planner(
        mission,
        formulation=formulation,
        algorithm=algorithm,
        solver=solver,
        target=target,
        p3_resolution=p3_resolution,
        others=others,
    )
    return planner.plan(guess, **how)


def screened(facets: Facets, lin: Linearisation, clearance: float) -> Booleans:
    """Facets that take part in the program of P2 to begin with, shape (facets,).

    Those farther from binding at an iterate than the clearance are checked after it, and restored if
    one of them turns out to matter.
    """
    return np.asarray(facets.margin(lin.iterate.mean, lin.spread.factor) < clearance)
