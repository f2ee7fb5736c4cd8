"""SCvx: trust region with ratio test and exact penalty."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from formulations.program.penalty import Penalty
from formulations.program.subproblem import Subproblem, SubproblemError
from scp_recon.physics.dynamics import Dynamics
from scp_recon.scp.exact_penalty import ExactPenalty
from scp_recon.scp.loop import Record, State, Timing
from scp_recon.scp.trial import trial_step


@dataclass(frozen=True)
class SCvx(ExactPenalty):
    """Trust region with ratio test and exact penalty (SCvx).

    Mao, Szmuk & Acikmese, "Successive convexification of non-convex optimal control problems and
    its convergence properties", CDC 2016, alg. 2; the ratios are those of Conn, Gould & Toint,
    Trust Region Methods, 2000, alg. 6.1.1 (eta_1 = 0.01, eta_2 = 0.9) with 0.25 and 0.7 for the
    radius. Attributes are those of `ExactPenalty`.
    """

    penalty: ClassVar[Penalty] = "exact"
    ACCEPT, SHRINK_BELOW, GROW_ABOVE = 0.01, 0.25, 0.7
    GROW = 3.0
    VERDICT_RADIUS = 1e-2
    GUESS_RADIUS = 3.0

    def step(
        self, subproblem: Subproblem, dynamics: Dynamics, state: State, k: int, timing: Timing
    ) -> tuple[State, Record]:
        """Linearise, solve, fly, judge by the ratio of actual to predicted reduction."""
        state = self._weighed(subproblem, state)
        guess = not state.lin.is_dynamically_feasible
        radius = max(state.radius, self.GUESS_RADIUS) if guess else state.radius
        try:
            trial = trial_step(subproblem, dynamics, state, radius, timing, self.stationary)
        except SubproblemError as error:
            return self._failed(subproblem, state, k, str(error))
        ratio = trial.actual / trial.predicted if trial.predicted > 0.0 else 0.0
        radius = state.radius
        if ratio < self.SHRINK_BELOW and not guess:
            radius = self.SHRINK * min(radius, trial.step)
        elif ratio > self.GROW_ABOVE and trial.step > 0.99 * radius:
            radius = self.GROW * radius
        accepted = guess or ratio > self.ACCEPT
        new, record = self._judged(subproblem, state, k, trial, accepted=accepted, radius=radius)
        if guess or not trial.answer.accurate:
            return replace(new, stationary=False), record
        stationary = self._is_stationary(state, record)
        if stationary and state.radius < self.VERDICT_RADIUS:
            # Within a tiny radius the solver's rounding hides what there is to gain: look again.
            return replace(new, radius=self.VERDICT_RADIUS), record
        worthless = trial.predicted <= self._negligible(record)
        if worthless and state.worthless and ratio > self.SHRINK_BELOW:
            # Refused, and kept at a shorter step: the derivatives are right, and curvature eats what
            # longer steps promise. What it leaves is less than was promised then.
            stationary = True
        return replace(new, stationary=stationary, worthless=worthless and not accepted), record

    def _is_stationary(self, state: State, record: Record) -> bool:
        """No step within a unit radius promises a reduction that is worth one.

        The model is convex. If the trust region does not bind, a larger one promises nothing more;
        if it does, the reduction per radius falls with the radius, so that the one found here
        bounds the one within a unit radius.
        """
        binds = record.step > 0.99 * record.trust_radius
        scale = min(1.0, record.trust_radius) if binds else 1.0
        return record.predicted <= self._worth(state.charge, record) * scale
