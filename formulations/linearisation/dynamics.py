"""Fly a grid of arcs with impulsive burns: rollout, derivatives, and steps with closed defects."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from formulations.arrays import Array, Indices
from formulations.linearisation.linearisation import Linearisation, final_state_map, step_mean
from formulations.problem.controls import UNIT
from formulations.problem.flow import Flow, MovableFlow
from formulations.problem.flyby import NO_GAINS, NO_TIMES, FlybyProblem, Iterate


@dataclass(frozen=True, eq=False)
class Dynamics:
    """Flow map of a grid with its burns, in the units of the flow."""

    flow: Flow
    """The motion between burns."""
    burn_nodes: Indices
    """Node of each burn, shape (m,)."""

    def rollout(self, initial_state: Array, burns: Array) -> Array:
        """Node states after the burns: initial (..., 6), burns (..., m, 3) to (n + 1, ..., 6)."""
        burn_at = dict(zip(self.burn_nodes.tolist(), range(len(self.burn_nodes)), strict=True))
        states = np.empty((self.flow.arcs + 1, *initial_state.shape))
        states[0] = initial_state
        for k in range(len(states)):
            if k > 0:
                states[k] = self.flow.propagate(states[k - 1], k - 1)
            if k in burn_at:
                states[k, ..., 3:] += burns[..., burn_at[k], :]
        return states

    def linearise(self, problem: FlybyProblem, iterate: Iterate) -> Linearisation:
        """An iterate with the derivatives of all its arcs, and with the boundary of its phases."""
        flow = self.at(problem, iterate.times).flow
        arcs = flow.differentiate(iterate.mean[:-1])
        return Linearisation(problem.at(iterate.times), iterate, arcs)

    def at(self, problem: FlybyProblem, times: Array) -> Dynamics:
        """The flow map on the grid that belongs to firing times; the same if there are none.

        Raises:
            ValueError: if the times of the flow's nodes cannot move.
        """
        if problem.firing is None or not times.size:
            return self
        if not isinstance(self.flow, MovableFlow):
            raise ValueError("firing times are controls of flows alone that know their rate")
        return replace(self, flow=self.flow.at(problem.firing.at(times)))

    def close_defects(
        self,
        lin: Linearisation,
        burns: Array,
        gains: Array = NO_GAINS,
        times: Array = NO_TIMES,
        *,
        misses: bool = False,
    ) -> Linearisation:
        """Make a step of the linear model dynamically exact.

        Newton's method of multiple shooting starts from the node means that the model at `lin`
        predicts. Every iteration closes the defects of all arcs at once. It also corrects the
        burns, as far as `_may_change` allows, by the least change that keeps the final state where
        the model predicts it. Without this correction, the curvature of the final state, weighed by
        the penalty, rejects good steps (the Maratos effect; Nocedal & Wright, Numerical
        Optimization, section 15.5). If Newton's method does not converge, the burns, shape (m, 3),
        are rolled out unchanged. Gains do not move the mean; firing times and phases stay as the
        model has them.

        Set `misses` if the model intends even its smallest miss, as with an augmented Lagrangian. A
        correction of that miss would move burns that the model left at zero, where their sizes have
        a kink.
        """
        problem, mean = lin.problem.at(times), step_mean(lin, burns, times)
        free, goal = _may_change(problem, burns), mean[-1]
        if problem is not lin.problem:  # phases moved the boundary, and the model promises a miss
            mean[0] = problem.initial_state
            mean[0, 3:] += burns[0]
            step = times - problem.firing_times(lin.iterate.times)
            goal = goal + problem.final_state - lin.problem.final_state
            goal -= lin.shifts.final @ step / UNIT
        iterate = Iterate(burns, mean, gains, times)
        # What the conic solver leaves of a miss is its tolerance, not the model's promise.
        if not misses and np.abs(goal - problem.final_state).max() < SOLVER_MISS:
            goal = problem.final_state
        for _ in range(NEWTON_MAX):
            trial = self.linearise(problem, iterate)
            defect = np.abs(trial.defects[:-1]).max()
            missed = np.abs(goal - trial.iterate.mean[-1]).max()
            if max(defect, missed) < NEWTON_TOLERANCE:
                return trial
            if not defect < NEWTON_DIVERGED:
                break
            constant, jacobian = final_state_map(trial)
            miss = goal - constant - jacobian @ iterate.burns.ravel()
            correction = (free @ np.linalg.lstsq(jacobian @ free, miss)[0]).reshape(-1, 3)
            corrected = iterate.burns + correction
            before = iterate
            iterate = Iterate(corrected, step_mean(trial, corrected), gains, times)
            if defect < NEWTON_LAST:
                moved = trial.arcs.moved(iterate.mean[:-1] - before.mean[:-1])
                return Linearisation(problem, iterate, moved)
        flown = self.at(problem, times).rollout(problem.initial_state, burns)
        return self.linearise(problem, Iterate(burns, flown, gains, times))


def _may_change(problem: FlybyProblem, burns: Array) -> Array:
    """Projection (3 m, 3 m) on changes that leave held burns, and make no raised burn smaller."""
    free = np.eye(burns.size)
    for burn in (*problem.held, *problem.raised):
        at = slice(3 * burn, 3 * burn + 3)
        along = burns[burn] / max(float(np.linalg.norm(burns[burn])), TINY)
        free[at, at] = np.eye(3) - np.outer(along, along) if burn in problem.raised else 0.0
    return free


TINY = 1e-300
SOLVER_MISS = 1e-6
NEWTON_MAX, NEWTON_TOLERANCE, NEWTON_DIVERGED = 12, 1e-12, 1e3
NEWTON_LAST = 1e-8
"""Defect whose correction is the last: its square is rounding, and the derivatives stay as they are."""
