"""SCvx*: trust region with ratio test on an augmented Lagrangian."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from formulations.linearisation.linearisation import Linearisation
from formulations.program.penalty import Penalty, PenaltyParameters
from formulations.program.subproblem import Subproblem
from scp_recon.physics.dynamics import Dynamics
from scp_recon.scp.loop import Record, State, Timing
from scp_recon.scp.scvx import SCvx


@dataclass(frozen=True)
class SCvxStar(SCvx):
    """SCvx with multipliers: no weight has to be guessed that makes a penalty exact.

    Oguri, "Successive convexification with feasibility guarantee via augmented Lagrangian for
    non-convex optimal control problems", CDC 2023, alg. 1: once the merit of an accepted step changes
    by less than a falling bound, l <- l + w m and l <- max(l + w h, 0), and the weight grows.

    Departures: convex rows are charged like the others, because P2 may have no point that meets them;
    multipliers are also updated where a step was refused and the iterate is stationary, and not while
    nothing is violated. The paper has no test for infeasibility; here a case counts as infeasible when
    it is stationary at the largest weight, violated by more than ten times what counts as none, and a
    further update of the multipliers does not take a tenth off the violation.

    Attributes are those of `ExactPenalty`, weights being those of the squares.
    """

    penalty: ClassVar[Penalty] = "augmented"
    weight: float = 100.0
    weight_max: float = 1e5
    max_iterations: int = 100
    HEAVIER, TIGHTER, HOPELESS, BEYOND_ROUNDING = 2.0, 0.9, 0.9, 10.0
    RADIUS_MIN = 1e-4

    def init(self, subproblem: Subproblem, lin: Linearisation) -> State:
        """Start from the guess, without multipliers."""
        charge = PenaltyParameters(
            self.weight, multipliers=np.zeros_like(subproblem.merit.excess(lin))
        )
        return State(lin, subproblem.merit(lin, charge), self.initial_radius, charge)

    def step(
        self, subproblem: Subproblem, dynamics: Dynamics, state: State, k: int, timing: Timing
    ) -> tuple[State, Record]:
        """A step of SCvx, and the multipliers where it is time."""
        before = state
        state, record = super().step(subproblem, dynamics, state, k, timing)
        radius = max(state.radius, self.RADIUS_MIN)  # the merit moves with the multipliers
        state = replace(state, radius=radius, change=before.change, violated=before.violated)
        settled = (
            record.accepted
            and before.lin.is_dynamically_feasible
            and abs(record.actual) < state.change
        )
        violated = record.violated > self.feasible
        if not violated or not (settled or state.stationary):
            return state, record
        hopeless = record.violated > max(
            self.HOPELESS * state.violated, self.BEYOND_ROUNDING * self.feasible
        )
        if hopeless and state.stationary and state.charge.weight >= self.weight_max:
            return state, record
        return self._update(subproblem, state, record), record

    def _weighed(self, subproblem: Subproblem, state: State) -> State:  # noqa: ARG002 -- as inherited
        """Multipliers do what a heavier weight is for."""
        return state

    def _worth(self, charge: PenaltyParameters, record: Record) -> float:  # noqa: ARG002 -- as inherited
        """The same at every weight: the multipliers tell whether violations can be removed."""
        return self._negligible(record)

    def _heavier(self, subproblem: Subproblem, state: State) -> float | None:  # noqa: ARG002 -- as inherited
        """Weights grow with the multipliers; the largest is the last."""
        return self.weight_max if state.charge.weight < self.weight_max else None

    def _update(self, subproblem: Subproblem, state: State, record: Record) -> State:
        weight, multipliers = state.charge.weight, state.charge.multipliers
        assert multipliers is not None
        multipliers = multipliers + weight * subproblem.merit.excess(state.lin)
        multipliers[6:] = np.maximum(multipliers[6:], 0.0)
        charge = PenaltyParameters(
            min(self.HEAVIER * weight, self.weight_max), multipliers=multipliers
        )
        change = min(state.change, abs(record.actual)) if state.change == np.inf else state.change
        return replace(
            state,
            merit=subproblem.merit(state.lin, charge),
            charge=charge,
            stationary=False,
            worthless=False,
            change=self.TIGHTER * change,
            violated=record.violated,
        )
