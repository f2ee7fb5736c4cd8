"""Run the stages of a mission to a plan, from other starts if needed, without too small burns."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from formulations.arrays import Array, Booleans
from formulations.problem.flyby import Iterate
from formulations.rows.uniform import ChanceRows
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning.initial_guess import ballistic, circular, from_burns
from scp_recon.planning.plan import Plan, Provenance, Stage
from scp_recon.planning.stages import FIRST_STAGE, HELD_STAGE, StageRunner, standing
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scp.status import Status

RESOLVED = 1e-6
"""Relative difference of two merits that stages leave open."""

NEITHER = "and neither is a plan"
"""End of the warning of burns that stay too small."""

TINY = 1e-300
"""Stands for zero in a quotient."""


@dataclass
class MissionRunner(StageRunner):
    """Runs the stages of a mission and makes the plan."""

    task: Mission

    def run(self, work: Callable[[], Stage], provenance: Provenance) -> Plan:
        """Run the stages of a plan; an interrupted one ends with the best stage so far, if any."""
        started = perf_counter()
        try:
            final = work()
        except KeyboardInterrupt:
            if not self.stages:
                raise
            final = _interrupted(self.stages)
        seconds = perf_counter() - started
        return Plan(self.task, provenance, tuple(self.stages), final, self.timing, seconds)

    def starts(self, guess: Iterate) -> Iterator[tuple[str, Iterate]]:
        """The guess, the ballistic arc if there is one, and a turn about the body either way.

        A straight line may pass through the body's centre, where nothing can be linearised.
        """
        yield "", guess
        try:
            arc = ballistic(self.task)
        except InputError:
            pass
        else:
            yield "b", arc
        yield "c", circular(self.task, 1.0)
        yield "d", circular(self.task, -1.0)

    def flown(self, last: Plan) -> Iterate:
        """Burns and gains of a plan on this mission's nodes."""
        mission, gains = self.task, last.final.result.lin.iterate.gains
        return replace(from_burns(mission, last.burns_m_s), gains=gains)

    def go_on(self, last: Plan) -> Stage | None:
        """Solve P2 with exact risk from a plan, without the preliminary stages.

        If the last stage alone does not converge from a plan with gains, all stages with gains are
        run.

        Returns:
            The stage; None if it did not converge, or if risk is not exact.
        """
        if self.task.scenario.risk.allocation != "exact":
            return None
        *before, (_, rows) = self.solver.exact_rows()
        start = self.task.dynamics.linearise(rows.problem, self.flown(last))
        stage = self.solve("P2", rows, start)
        leads = any(other.problem.feedback is rows.problem.feedback for _, other in before)
        if stage.result.status is not Status.CONVERGED and start.iterate.gains.any() and leads:
            stage = self.solve_exact("P2", start)
        return stage if stage.result.status is Status.CONVERGED else None

    def executable(self, stage: Stage) -> Stage:
        """The stage solved again without burns too small to execute, or with some of them raised.

        Burns between zero and `burns.dv_min_m_s` are held at zero while the others are planned
        again. No choice can cost less than the stage itself. If holding costs more, each burn in
        turn, the largest first, is kept at that size or above, if this is better. If that gives no
        plan, all such burns are. If no choice gives a plan, the burns stay, with a warning.
        """
        self.task = _without_words_on_burns(self.task)
        while stage.result.status is Status.CONVERGED:
            sizes = self._sizes(stage)
            small = (sizes > 0.0) & (sizes < self._dv_min)
            small[list(stage.result.lin.problem.raised)] = False
            if not small.any():
                break
            raised = np.zeros_like(small)
            best = self._with_burns(stage, small, raised)
            for burn in sorted(np.flatnonzero(small), key=lambda i: -sizes[i]):
                if not _clearly_better(stage, best, self._left_open(stage)):
                    break
                raised[burn] = True
                other = self._with_burns(stage, small, raised)
                raised[burn] = _clearly_better(other, best)
                best = other if raised[burn] else best
            if best.result.status is not Status.CONVERGED and not raised[small].all():
                best = self._with_burns(stage, small, small)
            if best.result.status is not Status.CONVERGED:
                self._warn_of(small, sizes)
                break
            stage = best
        return stage

    @staticmethod
    def _sizes(stage: Stage) -> Array:
        """Root mean square of the burns' commanded sizes, shape (m,)."""
        problem, iterate = stage.result.lin.problem, stage.result.lin.iterate
        sizes = np.linalg.norm(iterate.burns, axis=1)
        if problem.feedback is not None:
            for j, burn in enumerate(problem.feedback.burns):
                sizes[burn] = np.hypot(sizes[burn], np.linalg.norm(problem.gains_of(iterate, j)))
        return np.asarray(sizes)

    @staticmethod
    def _left_open(stage: Stage) -> float:
        """Relative accuracy of a stage's merit: with gains the resolution of its rows."""
        rows = stage.merit.rows
        return RESOLVED if rows.problem.feedback is None else max(RESOLVED, rows.resolution)

    @property
    def _dv_min(self) -> float:
        """The smallest burn that is executed, in the mission's units."""
        return self.task.scenario.burns.dv_min_m_s / self.task.units.speed_m_s

    def _with_burns(self, stage: Stage, small: Booleans, raised: Booleans) -> Stage:
        """A stage again, its small burns held at zero, but for those that are raised."""
        dynamics, at = self.task.dynamics, stage.result.lin.problem
        iterate, least = stage.result.lin.iterate, self._dv_min
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
        flown = Iterate(burns, dynamics.rollout(at.initial_state, burns), gains)
        start = dynamics.linearise(problem, flown)
        name, rows = f"{stage.name.removesuffix(HELD_STAGE)}{HELD_STAGE}", stage.merit.rows
        if isinstance(rows, ChanceRows):
            return self.restore(name, rows, start)
        return self.solve(name, rows, start)

    def _warn_of(self, small: Booleans, sizes: Array) -> None:
        """Warn of the burns that stay smaller than the smallest executable burn."""
        mission = self.task
        first, speed = 1 + mission.scenario.burns_flown, mission.units.speed_m_s
        said = (f"burn {first + i} of {speed * sizes[i]:.1e} m/s" for i in np.flatnonzero(small))
        word = ScenarioWarning.of(
            "burns.dv_min_m_s",
            ", ".join(said),
            f"expected none or {mission.scenario.burns.dv_min_m_s:g} m/s, {NEITHER}",
        )
        self.task = replace(mission, warnings=(*mission.warnings, word))


def _without_words_on_burns(mission: Mission) -> Mission:
    """The mission without warnings that an earlier plan's burns stayed too small."""
    kept = tuple(word for word in mission.warnings if not word.expected.endswith(NEITHER))
    return replace(mission, warnings=kept)


def _interrupted(stages: list[Stage]) -> Stage:
    """The best stage so far, marked as interrupted: one that converged on P2 before any other."""
    whole = [stage for stage in stages if not stage.name.endswith(FIRST_STAGE)]
    p2 = [stage for stage in whole if stage.problem == "P2"]
    best = max(p2 or whole or stages, key=standing)
    return replace(best, result=replace(best.result, status=Status.INTERRUPTED))


def _clearly_better(one: Stage, other: Stage, left_open: float = RESOLVED) -> bool:
    """Whether a run ranks above another by more than the accuracy of stages."""
    rank, merit = standing(one)
    return (rank, merit * (1.0 + left_open)) > standing(other)
