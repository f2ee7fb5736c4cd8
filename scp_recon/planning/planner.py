"""Plan a mission by sequential convex programming: P3, facets at its solution or exact risk, P2.

Around the stages: other starts, interrupts, and burns too small to execute.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from time import perf_counter
from typing import Any, Literal

import numpy as np

from formulations.arrays import Array, Booleans
from formulations.problem.flyby import Iterate
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning.initial_guess import ballistic, circular, from_burns
from scp_recon.planning.method import ALGORITHM, FORMULATION, SOLVER, FacetRounds
from scp_recon.planning.plan import Plan, Provenance, Stage, rank
from scp_recon.planning.records import Problem, WithoutUncertainty
from scp_recon.planning.solver import AnyProblem, Observer, StageSolver, unobserved
from scp_recon.planning.stages import Pipeline, same_optimum
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scp.status import Status

RESOLVED = 1e-6
"""Relative difference of two merits that stages leave open."""

NEITHER = "and neither is a plan"
"""End of the warning of burns that stay too small."""

TINY = 1e-300
"""Stands for zero in a quotient."""


class Planner(StageSolver[AnyProblem]):
    """Plans missions from a guess or a plan, with programs that it compiles once: see `StageSolver`."""

    method: Literal["scp", "ipopt"] = "scp"

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
        small to execute are left out or raised (`executable`). The observer is called after
        each iteration with the stage's name and the record.
        """
        mission = self.task
        pipeline = Pipeline(mission, self, observe or unobserved, facet_rounds)

        def work() -> Stage:
            start = flown(mission, guess) if isinstance(guess, Plan) else guess
            goes_on = problem == "P2" and (isinstance(guess, Plan) or start.gains.any())
            if goes_on and (stage := continued(pipeline, start, once=once)):
                return stage
            return pipeline.plan(start, problem, () if once else other_starts(mission))

        known = guess.without_uncertainty if isinstance(guess, Plan) else None
        leads = problem == "P3" and self._resolution > 0.0
        made = self._provenance(init)
        return make_plan(pipeline, work, *made, known, executes=not leads)

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
        mission = self.task.with_initial_state(initial_state)
        if last.mission.with_initial_state(initial_state).scenario != mission.scenario:
            raise ValueError("the plan is of another mission")
        pipeline = Pipeline(mission, self)

        def work() -> Stage:
            if facets is None:
                return pipeline.exact(pipeline.start(lin.iterate))
            # The last plan's iterate knows its factor; the facets are screened there.
            spec = self.p2_stage(facets, lin, again=True)
            return pipeline.choose_again(pipeline.solve(spec, pipeline.start(lin.iterate)))

        return make_plan(pipeline, work, *self._provenance("plan"))

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


def make_plan(
    pipeline: Pipeline[Mission],
    work: Callable[[], Stage],
    provenance: Provenance,
    target: float | None = None,
    known: WithoutUncertainty | None = None,
    *,
    executes: bool = True,
) -> Plan:
    """Make the plan of a mission from the stage that `work` finds, without burns too small to execute.

    An interrupted run ends with the best stage so far, if any, of P2 before any other. The cheapest P3
    is that of the stages, or the one `known` before. Burns too small stay in a plan that only leads to
    another, which nobody `executes`.
    """
    started, mission = perf_counter(), pipeline.task
    kept = tuple(word for word in mission.warnings if not word.expected.endswith(NEITHER))
    try:
        stage = work()
        final, words = executable(pipeline, stage) if executes else (stage, ())
    except KeyboardInterrupt:
        if not pipeline.stages:
            raise
        whole = [stage for stage in pipeline.stages if stage.spec.role != "open"]
        p2 = [stage for stage in whole if stage.problem == "P2"]
        best = max(p2 or whole or pipeline.stages, key=rank)
        final, words = replace(best, result=replace(best.result, status=Status.INTERRUPTED)), ()
    return Plan(
        replace(mission, warnings=(*kept, *words)),
        provenance,
        perf_counter() - started,
        stages=tuple(pipeline.stages),
        final=final,
        timing=pipeline.timing,
        target=target,
        without_uncertainty=cheapest_p3(mission, pipeline.stages) or known,
    )


def cheapest_p3(mission: Mission, stages: Iterable[Stage]) -> WithoutUncertainty | None:
    """The cheapest of the optima of P3 among stages, and their number; None if there is none."""
    optima: list[Stage] = []
    for stage in stages:
        is_p3 = stage.problem == "P3" and stage.spec.role == "final"
        found = is_p3 and stage.result.status is Status.CONVERGED
        if found and not any(same_optimum(stage, other) for other in optima):
            optima.append(stage)
    if not optima:
        return None
    least = min(stage.result.lin.iterate.total_dv for stage in optima)
    return WithoutUncertainty(float(least * mission.units.speed_m_s), len(optima))


def other_starts(mission: Mission) -> Iterator[tuple[str, Iterate]]:
    """The ballistic arc if there is one, and a turn about the body either way, by their letters.

    A straight line may pass through the body's centre, where nothing can be linearised.
    """
    try:
        arc = ballistic(mission)
    except InputError:
        pass
    else:
        yield "b", arc
    yield "c", circular(mission, 1.0)
    yield "d", circular(mission, -1.0)


def flown(mission: Mission, last: Plan) -> Iterate:
    """Burns and gains of a plan on a mission's nodes."""
    gains, drifts = last.final.result.lin.iterate.gains, last.final.drifts
    return replace(from_burns(mission, last.burns_m_s), gains=gains, drifts=drifts)


def continued(pipeline: Pipeline[Mission], begun: Iterate, *, once: bool) -> Stage | None:
    """Solve P2 with exact risk from a plan's burns and gains, without the preliminary stages.

    If the last stage alone does not converge from gains, all stages with gains are run; not if `once`
    and the case is infeasible from there.

    Returns:
        The stage; None if it did not converge, or if risk is not exact. If `once`, also a stage that
            found the case infeasible.
    """
    mission = pipeline.task
    if mission.risk.allocation != "exact":
        return None
    *before, spec = pipeline.solver.exact_stages()
    feedback = spec.rows.problem.feedback
    start = mission.dynamics.linearise(spec.rows.problem, begun)
    stage = pipeline.solve(spec, start)
    answers = (Status.CONVERGED, Status.INFEASIBLE) if once else (Status.CONVERGED,)
    leads = any(other.rows.problem.feedback is feedback for other in before)
    if stage.result.status not in answers and start.iterate.gains.any() and leads:
        stage = pipeline.exact(start)
    return stage if stage.result.status in answers else None


def executable(
    pipeline: Pipeline[Mission], stage: Stage
) -> tuple[Stage, tuple[ScenarioWarning, ...]]:
    """Solve a stage again without burns too small to execute, or with some of them raised.

    Burns between zero and `burns.dv_min_m_s` are held at zero while the others are planned again. No
    choice can cost less than the stage itself. If holding costs more, each burn in turn, the largest
    first, is kept at that size or above, if this is better. If that gives no plan, all such burns
    are. If no choice gives a plan, the burns stay, with a warning.

    Returns:
        The stage, and the warning if there is one.
    """
    mission, rows = pipeline.task, stage.merit.rows
    least_m_s, speed_m_s = mission.scenario.burns.dv_min_m_s, mission.units.speed_m_s
    least = least_m_s / speed_m_s
    kinked = rows.problem.feedback is not None or rows.problem.drifts
    accuracy = max(RESOLVED, rows.resolution) if kinked else RESOLVED
    while stage.result.status is Status.CONVERGED:
        sizes = _sizes(stage)
        small = (sizes > 0.0) & (sizes < least)
        small[list(stage.result.lin.problem.raised)] = False
        if not small.any():
            break
        raised = np.zeros_like(small)
        best = _with_burns(pipeline, stage, small, raised, least)
        for burn in sorted(np.flatnonzero(small), key=lambda i: -sizes[i]):
            if not _clearly_better(stage, best, accuracy):
                break
            raised[burn] = True
            other = _with_burns(pipeline, stage, small, raised, least)
            raised[burn] = _clearly_better(other, best)
            best = other if raised[burn] else best
        if best.result.status is not Status.CONVERGED and not raised[small].all():
            best = _with_burns(pipeline, stage, small, small, least)
        if best.result.status is not Status.CONVERGED:
            first, mm_s = 1 + mission.scenario.burns_flown, 1e3 * speed_m_s * sizes
            given = ", ".join(
                f"burn {first + i} of {mm_s[i]:.3g} mm/s" for i in np.flatnonzero(small)
            )
            expected = f"expected none or {1e3 * least_m_s:g} mm/s, {NEITHER}"
            return stage, (ScenarioWarning.of("burns.dv_min_m_s", given, expected),)
        stage = best
    return stage, ()


def _sizes(stage: Stage) -> Array:
    """Root mean square of the burns' commanded sizes, shape (m,)."""
    problem, iterate = stage.result.lin.problem, stage.result.lin.iterate
    sizes = np.linalg.norm(iterate.burns, axis=1)
    if problem.feedback is not None:
        for j, burn in enumerate(problem.feedback.burns):
            sizes[burn] = np.hypot(sizes[burn], np.linalg.norm(problem.gains_of(iterate, j)))
    return np.asarray(sizes)


def _with_burns(
    pipeline: Pipeline[Mission], stage: Stage, small: Booleans, raised: Booleans, least: float
) -> Stage:
    """Solve a stage again, its small burns held at zero, except those that are raised to `least`."""
    dynamics, at = pipeline.task.dynamics, stage.result.lin.problem
    iterate = stage.result.lin.iterate
    sizes = np.linalg.norm(iterate.burns, axis=1, keepdims=True)
    scale = np.where(raised[:, None], least / np.maximum(sizes, TINY), ~small[:, None])
    burns = scale * iterate.burns
    gains = at.without_corrections(iterate.gains, np.flatnonzero(small & ~raised))
    problem = replace(
        at,
        held=tuple(np.flatnonzero(~burns.any(axis=1)).tolist()),
        raised=(*at.raised, *np.flatnonzero(raised).tolist()),
        dv_min=least,
    )
    mean = dynamics.rollout(at.initial_state, burns)
    moved = Iterate(burns, mean, gains, drifts=stage.drifts)
    spec = replace(stage.spec, rows=stage.merit.rows, role="held")
    return pipeline.solve(spec, dynamics.linearise(problem, moved))


def _clearly_better(one: Stage, other: Stage, accuracy: float = RESOLVED) -> bool:
    """Whether a run ranks above another by more than the accuracy of stages."""
    ended, merit = rank(one)
    return (ended, merit * (1.0 + accuracy)) > rank(other)
