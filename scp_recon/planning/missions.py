"""Make a mission's plan of its stages: other starts, interrupts, burns too small to execute."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from time import perf_counter

import numpy as np

from formulations.arrays import Array, Booleans
from formulations.problem.flyby import Iterate
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning.initial_guess import ballistic, circular, from_burns
from scp_recon.planning.plan import Plan, Provenance, Stage, rank
from scp_recon.planning.records import WithoutUncertainty
from scp_recon.planning.stages import Pipeline, same_optimum
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scp.status import Status

RESOLVED = 1e-6
"""Relative difference of two merits that stages leave open."""

NEITHER = "and neither is a plan"
"""End of the warning of burns that stay too small."""

TINY = 1e-300
"""Stands for zero in a quotient."""


def make_plan(
    mission: Mission,
    pipeline: Pipeline,
    work: Callable[[], Stage],
    provenance: Provenance,
    target: float | None = None,
    known: WithoutUncertainty | None = None,
    *,
    executes: bool = True,
) -> Plan:
    """Make the plan of a mission from the stage that `work` finds, without burns too small to execute.

    An interrupted run ends with the best stage so far, if any. The cheapest P3 is that of the stages,
    or the one `known` before. Burns too small stay in a plan that only leads to another, which nobody
    `executes`.
    """
    started = perf_counter()
    kept = tuple(word for word in mission.warnings if not word.expected.endswith(NEITHER))
    try:
        stage = work()
        final, words = executable(mission, pipeline, stage) if executes else (stage, ())
    except KeyboardInterrupt:
        if not pipeline.stages:
            raise
        final, words = _interrupted(pipeline.stages), ()
    seconds, mission = perf_counter() - started, replace(mission, warnings=(*kept, *words))
    stages = tuple(pipeline.stages)
    least = cheapest_p3(mission, stages) or known
    return Plan(
        mission,
        provenance,
        seconds,
        stages=stages,
        final=final,
        timing=pipeline.timing,
        target=target,
        without_uncertainty=least,
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


def continued(mission: Mission, pipeline: Pipeline, begun: Iterate, *, once: bool) -> Stage | None:
    """Solve P2 with exact risk from a plan's burns and gains, without the preliminary stages.

    If the last stage alone does not converge from gains, all stages with gains are run; not if `once`
    and the case is infeasible from there.

    Returns:
        The stage; None if it did not converge, or if risk is not exact. If `once`, also a stage that
            found the case infeasible.
    """
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
    mission: Mission, pipeline: Pipeline, stage: Stage
) -> tuple[Stage, tuple[ScenarioWarning, ...]]:
    """Solve a stage again without burns too small to execute, or with some of them raised.

    Burns between zero and `burns.dv_min_m_s` are held at zero while the others are planned again. No
    choice can cost less than the stage itself. If holding costs more, each burn in turn, the largest
    first, is kept at that size or above, if this is better. If that gives no plan, all such burns
    are. If no choice gives a plan, the burns stay, with a warning.

    Returns:
        The stage, and the warning if there is one.
    """
    least = mission.scenario.burns.dv_min_m_s / mission.units.speed_m_s
    while stage.result.status is Status.CONVERGED:
        sizes = _sizes(stage)
        small = (sizes > 0.0) & (sizes < least)
        small[list(stage.result.lin.problem.raised)] = False
        if not small.any():
            break
        raised = np.zeros_like(small)
        best = _with_burns(pipeline, stage, small, raised, least)
        for burn in sorted(np.flatnonzero(small), key=lambda i: -sizes[i]):
            if not _clearly_better(stage, best, _accuracy(stage)):
                break
            raised[burn] = True
            other = _with_burns(pipeline, stage, small, raised, least)
            raised[burn] = _clearly_better(other, best)
            best = other if raised[burn] else best
        if best.result.status is not Status.CONVERGED and not raised[small].all():
            best = _with_burns(pipeline, stage, small, small, least)
        if best.result.status is not Status.CONVERGED:
            return stage, (_warning(mission, small, sizes),)
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


def _accuracy(stage: Stage) -> float:
    """Relative accuracy of a stage's merit: with gains or drifts the resolution of its rows."""
    rows = stage.merit.rows
    kinked = rows.problem.feedback is not None or rows.problem.drifts
    return max(RESOLVED, rows.resolution) if kinked else RESOLVED


def _with_burns(
    pipeline: Pipeline, stage: Stage, small: Booleans, raised: Booleans, least: float
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


def _warning(mission: Mission, small: Booleans, sizes: Array) -> ScenarioWarning:
    """The warning of burns that stay smaller than the smallest executable burn."""
    first, speed = 1 + mission.scenario.burns_flown, mission.units.speed_m_s
    said = (f"burn {first + i} of {1e3 * speed * sizes[i]:.3g} mm/s" for i in np.flatnonzero(small))
    least = mission.scenario.burns.dv_min_m_s
    expected = f"expected none or {1e3 * least:g} mm/s, {NEITHER}"
    return ScenarioWarning.of("burns.dv_min_m_s", ", ".join(said), expected)


def _interrupted(stages: list[Stage]) -> Stage:
    """The best stage so far, marked as interrupted: one that converged on P2 before any other."""
    whole = [stage for stage in stages if stage.spec.role != "open"]
    p2 = [stage for stage in whole if stage.problem == "P2"]
    best = max(p2 or whole or stages, key=rank)
    return replace(best, result=replace(best.result, status=Status.INTERRUPTED))


def _clearly_better(one: Stage, other: Stage, accuracy: float = RESOLVED) -> bool:
    """Whether a run ranks above another by more than the accuracy of stages."""
    ended, merit = rank(one)
    return (ended, merit * (1.0 + accuracy)) > rank(other)
