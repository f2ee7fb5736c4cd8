"""Plan by SCP in three stages: P3, facets at its solution, P2; more facet rounds on request."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, partial
from time import perf_counter
from typing import Final, Literal

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
from scp_recon.planning.method import ALGORITHM, FORMULATION, SOLVER
from scp_recon.planning.mission_stages import MissionRunner
from scp_recon.planning.plan import Plan, Provenance, Stage
from scp_recon.planning.stages import (
    CHOICES_MAX,
    HELD_STAGE,
    LED_STAGE,
    RESOLUTION,
    Observer,
    Task,
    without_parting_sets,
)
from scp_recon.scp.algorithms import ALGORITHMS
from scp_recon.scp.loop import Algorithm, run

FEW_LINES, FEW_WITH_GAINS, LINES = 512, 1024, 4096
"""Directions, each taken both ways, in which a plan of whole flights looks: first, first with corrected
burns, and finally. With gains the kinks between few directions stop the search early."""

COARSE, FINE = 1e-3, 1e-5
COARSE_WITH_GAINS, FINE_WITH_GAINS = 1e-2, 1e-4
"""Relative reduction of the merit at which their stages stop; sampling errs by more. Gains are many,
and the merit is flat in them. Few directions, aimed at flights without gains, tell little of flights
with them: with 1e-3 that stage took up to 38 iterations in their kinks."""

WEIGHT = 100.0
"""First penalty weight with such a limit. Its multiplier may exceed the usual weight of ten. At the
next weight of a thousand, the resolution of the probability of whole flights would hide the
possible reductions of cost."""


ITERATIONS_WITH_GAINS = 100
"""Limit of a stage's iterations where burns are corrected: twice the usual one."""

LED_ITERATIONS, LED_RISK = 30, 0.3
"""The preliminary stage with gains, if no plan without gains is feasible: its largest number of
iterations, and its nodes' risk over that of whole flights. Flights fail more often than any of
their nodes."""


def plan(
    mission: Mission,
    guess: Iterate | Plan,
    *,
    problem: Literal["P3", "P2"] = "P2",
    formulation: str = FORMULATION,
    algorithm: str = ALGORITHM,
    solver: str = SOLVER,
    target: float | None = None,
    p3_resolution: float = 0.0,
    facet_rounds: int = 0,
    choices: int = CHOICES_MAX,
    init: str = "given",
    observe: Observer | None = None,
    once: bool = False,
) -> Plan:
    """Plan a mission once: `Planner.plan` with its arguments and those of `Planner`."""
    planner = Planner(
        mission,
        formulation=formulation,
        algorithm=algorithm,
        solver=solver,
        target=target,
        p3_resolution=p3_resolution,
    )
    return planner.plan(
        guess,
        problem=problem,
        facet_rounds=facet_rounds,
        choices=choices,
        init=init,
        observe=observe,
        once=once,
    )


class ScpStages:
    """A `RowsSolver` by SCP that keeps its compiled subproblems and solvers.

    They serve any task with the same constraints, burn nodes and nodes. `target` is the probability of
    exact constraints, by default the task's. `p3_resolution` is the relative reduction of the merit at
    which P3 stops if P2 follows.

    Raises:
        InputError: if the algorithm cannot weigh a miss of the final state where that is needed.
    """

    def __init__(
        self,
        task: Task,
        *,
        formulation: str = FORMULATION,
        algorithm: str = ALGORITHM,
        solver: str = SOLVER,
        target: float | None = None,
        p3_resolution: float = 0.0,
    ) -> None:
        self.task = task
        self.p3_resolution: Final = p3_resolution
        self.target: Final = task.risk.p_chance if target is None else target
        self.formulation: Final = formulation
        self.solver: Final = solver
        self.algorithm_name: Final = algorithm
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
        self._formulation = formulation
        self._p2_rows: ChanceRows | None = None
        self._exact_rows: Sequence[tuple[str, Rows]] = ()
        self._kept: dict[type[Rows], Subproblem] = {}

    @cached_property
    def p3_rows(self) -> DeterministicRows:
        """See `RowsSolver`."""
        return DeterministicRows(self.task.problem.open_loop, self.p3_resolution)

    @cached_property
    def first_stage_rows(self) -> DeterministicRows:
        """P3's rows without the keep-out sets of a part of the flight."""
        return DeterministicRows(without_parting_sets(self.task.problem.open_loop), RESOLUTION)

    def p2_rows(self, facets: Facets, lin: Linearisation, *, again: bool = False) -> ChanceRows:
        """See `RowsSolver`; the last are kept. `again` from a solution of P2, which moves less."""
        included = screened(facets, lin, self.task.clearances[again])
        kept = self._p2_rows
        if kept is None or kept.facets is not facets or np.any(kept.included != included):
            self._p2_rows = kept = ChanceRows(self.task.problem, facets, included)
        return kept

    def subproblem(self, rows: Rows) -> Subproblem:
        """The convex subproblem with some rows; the last ones of P3 and of P2 are kept."""
        kept = self._kept.get(type(rows))
        if kept is None or kept.merit.rows is not rows:
            penalty = self.algorithm.penalty
            kept = make_subproblem(rows.problem, rows, self._formulation, self.solver, penalty)
            self._kept[type(rows)] = kept
        return kept

    def exact_rows(self) -> Sequence[tuple[str, Rows]]:
        """See `RowsSolver`. A plan of whole flights begins at one of nodes, then with few directions.

        A whole flight never has a larger probability than its nodes. It is therefore infeasible if
        the nodes are. A plan with corrected burns starts from a plan without. The rows are made
        once, because drawing the directions takes time.
        """
        if self.formulation not in FULL:
            needs = f"goes with the formulations {' and '.join(FULL)}, not with {self.formulation}"
            raise InputError("risk.allocation", "'exact'", needs)
        problem, target = self.task.problem, self.target
        if not self._exact_rows and self.task.risk.scope == "node":
            self._exact_rows = [("", NodeRows(problem, target))]
            if problem.feedback is not None:
                open_loop = NodeRows(problem.open_loop, target, COARSE)
                closed = NodeRows(problem, target, FINE_WITH_GAINS)
                self._exact_rows = [(".open", open_loop), ("", closed)]
        elif not self._exact_rows:
            few, rough, fine = FEW_LINES, COARSE, FINE
            if problem.feedback is not None:
                few, rough, fine = FEW_WITH_GAINS, COARSE_WITH_GAINS, FINE_WITH_GAINS
            coarse = FlightRows(problem, target, few, rough)
            self._exact_rows = [
                (".node", NodeRows(problem.open_loop, target, COARSE)),
                (".coarse", coarse),
                ("", FlightRows(problem, target, LINES, fine, coarse)),
            ]
        return self._exact_rows

    @cached_property
    def leading_rows(self) -> NodeRows | None:
        """See `RowsSolver`: of nodes, for whole flights.

        The probability at nodes is smooth. The probability of flights in few directions has kinks,
        where the search would stop.
        """
        if self.task.problem.feedback is None or self.task.risk.scope == "node":
            return None
        return NodeRows(self.task.problem, 1.0 - LED_RISK * (1.0 - self.target), COARSE)

    def solve(
        self, name: str, rows: Rows, start: Linearisation, dynamics: Dynamics, observe: Observer
    ) -> Stage:
        """See `RowsSolver`."""
        begin = perf_counter()
        # A stage that holds burns looks where the one before it did.
        if (
            isinstance(rows, FlightRows)
            and rows.problem.feedback is not None
            and not name.endswith(HELD_STAGE)
        ):
            rows.aim(start)
        subproblem = self.subproblem(rows)
        setup = perf_counter() - begin
        algorithm = self.algorithm
        if name.endswith(LED_STAGE):
            led = self._special | {"max_iterations": LED_ITERATIONS}
            algorithm = ALGORITHMS[self.algorithm_name](**led)
        algorithm = algorithm.resolving(rows.resolution)
        result = run(subproblem, dynamics, start, algorithm, partial(observe, name))
        result.timing.setup += setup
        facets = rows.facets if isinstance(rows, ChanceRows) else None
        return Stage(name, result, subproblem.merit, facets, algorithm.feasible)


class Planner(ScpStages):
    """Plans a mission by SCP, and plans it again from other initial states: see `ScpStages`."""

    task: Mission

    @property
    def mission(self) -> Mission:
        """The mission that is planned."""
        return self.task

    def plan(
        self,
        guess: Iterate | Plan,
        *,
        problem: Literal["P3", "P2"] = "P2",
        facet_rounds: int = 0,
        choices: int = CHOICES_MAX,
        init: str = "given",
        observe: Observer | None = None,
        once: bool = False,
    ) -> Plan:
        """Solve P3 from the guess, choose the facets at its solution, and solve P2 from there.

        The guess may have defects. Exact risk goes on from a plan with its last stage, burns and gains
        at once, and from the plan's burns where that does not converge. Unless `once`, a stage that
        does not converge is tried from other starts: see `StageRunner.plan`. In each of `facet_rounds`
        the facets are chosen again at the solution and P2 is solved again; a round is kept only if it
        is better (`standing`), so that facets cannot cycle. Facets that leave nothing feasible are
        always chosen again, up to `choices` times. Burns too small to execute are left out or raised
        (`MissionRunner.executable`). The observer is called after each iteration with the stage's name
        and the record.
        """
        runner = MissionRunner(self.mission, self, observe, facet_rounds, choices)

        def work() -> Stage:
            stage = runner.go_on(guess) if isinstance(guess, Plan) and problem == "P2" else None
            if stage is None:
                start = runner.flown(guess) if isinstance(guess, Plan) else guess
                stage = runner.plan(start, problem, once=once)
            return runner.executable(stage)

        plan = runner.run(work, self._provenance(init))
        return replace(plan, target=self._target)

    def replan(self, last: Plan, initial_state: Array, *, observe: Observer | None = None) -> Plan:
        """Solve P2 again for another initial state, from the last plan and with its facets.

        The state is that before the first burn, J2000, SI, shape (6,); its covariance is the mission's
        fraction of it. The last plan must be one of P2 by this planner; the new one's `mission` begins
        at the state.

        Raises:
            ValueError: if the plan is not one of P2, its mission differs in more than the initial
                state, or the state is not outside the body.
        """
        facets = last.final.facets
        if last.final.problem != "P2":
            raise ValueError("only a plan of P2 can be planned again")
        if last.mission.with_initial_state(initial_state).scenario != (
            self.mission.with_initial_state(initial_state).scenario
        ):
            raise ValueError("the plan is of another mission")
        mission = self.mission.with_initial_state(initial_state)
        runner = MissionRunner(mission, self, observe)

        def again() -> Stage:
            if facets is None:
                return runner.solve_exact("P2", runner.start(last.final.result.lin.iterate))
            # The last plan's iterate knows its factor; the facets are screened there.
            rows = self.p2_rows(facets, last.final.result.lin, again=True)
            start = runner.start(last.final.result.lin.iterate)
            return runner.choose_again(runner.restore("P2", rows, start))

        return replace(
            runner.run(lambda: runner.executable(again()), self._provenance("plan")),
            target=self._target,
        )

    @property
    def _target(self) -> float | None:
        return self.target if self.mission.scenario.risk.allocation == "exact" else None

    def _provenance(self, init: str) -> Provenance:
        return Provenance(self.formulation, self.algorithm_name, self.solver, init)


def screened(facets: Facets, lin: Linearisation, clearance: float) -> Booleans:
    """Facets that take part in the program of P2 to begin with, shape (facets,).

    Those farther from binding at an iterate than the clearance are checked after it, and restored if
    one of them turns out to matter.
    """
    return np.asarray(facets.margin(lin.iterate.mean, lin.factor) < clearance)
