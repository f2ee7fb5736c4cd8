"""PTR: a soft trust region, the prox-linear method."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from formulations.program.penalty import Penalty
from formulations.program.subproblem import Subproblem, SubproblemError
from scp_recon.physics.dynamics import Dynamics
from scp_recon.scp.exact_penalty import ExactPenalty
from scp_recon.scp.loop import Record, State, Timing
from scp_recon.scp.trial import trial_step


@dataclass(frozen=True)
class PTR(ExactPenalty):
    """Penalised trust region: each step is charged ||s||^2 / (2 r) instead of being bounded.

    Penalised: Reynolds, Szmuk, Malyuta, Mesbahi, Acikmese & Carson, "Dual quaternion-based powered
    descent guidance with state-triggered constraints", J. Guid. Control Dyn. 43 (2020), and Malyuta
    et al., "Convex optimization for trajectory generation", IEEE Control Systems 42 (2022). With a
    charge that is fixed nothing keeps the merit from rising; here it is chosen as in ProxDescent of
    Lewis & Wright, "A proximal method for composite minimization", Math. Program. 158 (2016).
    A step whose promise and gain are both lost in the merit's rounding is taken: to refuse it would
    charge the next one more, and so on until nothing moves (Conn, Gould & Toint, Trust Region Methods,
    2000, section 17.4.2). Attributes are those of `ExactPenalty`, a radius standing for r.
    """

    penalty: ClassVar[Penalty] = "proximal"
    ACCEPT = 0.1
    GROW = 4.0
    FREE = 1e3
    ROUNDING = 1e-8

    def step(
        self, subproblem: Subproblem, dynamics: Dynamics, state: State, k: int, timing: Timing
    ) -> tuple[State, Record]:
        """Linearise, solve, fly; a step that keeps a tenth of its promise is taken."""
        state = self._weighed(subproblem, state)
        prox = 1.0 / state.radius
        state = replace(state, charge=replace(state.charge, prox=prox))
        guess = not state.lin.is_dynamically_feasible
        try:
            trial = trial_step(subproblem, dynamics, state, self.FREE, timing, self.stationary)
        except SubproblemError as error:
            return self._failed(subproblem, state, k, str(error))
        rounding = self.ROUNDING * max(1.0, abs(state.merit))
        told = max(abs(trial.predicted), abs(trial.actual)) > rounding
        accepted = guess or not told or trial.actual > self.ACCEPT * max(trial.predicted, 0.0)
        radius = min(state.radius * (self.GROW if accepted else self.SHRINK), self.FREE)
        new, record = self._judged(subproblem, state, k, trial, accepted=accepted, radius=radius)
        # At the answer -p s is a subgradient of the convex model, which bounds what any step of no
        # component above one can gain: predicted + p (||s||_1 - ||s||^2).
        moved = trial.answer.burns - state.lin.iterate.burns
        bound = trial.predicted + prox * float(np.abs(moved).sum() - (moved**2).sum())
        worth = self._worth(state.charge, record)
        stationary = trial.answer.accurate and not guess and bound <= worth
        return replace(new, stationary=stationary), record
