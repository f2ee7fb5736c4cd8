"""SCvx, SCvx* and PTR: accept or reject trial steps, and adapt trust region and penalty.

`ExactPenalty` is their base: the penalty weight, the test of stationarity and the verdicts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import Linearisation
from formulations.program.subproblem import Penalty, PenaltyParameters, Subproblem, SubproblemError
from scp_recon.scp.loop import (
    Algorithm,
    Record,
    State,
    Timing,
    Trial,
    controls_of,
    record_of,
    trial_step,
)
from scp_recon.scp.status import Status


@dataclass(frozen=True)
class ExactPenalty:
    """Base of the algorithms: all but the step. All quantities are nondimensional.

    Attributes:
        initial_radius: of the first trust region, hard or soft.
        weight: first penalty weight; exact when above every multiplier.
        weight_max: the next weight where a stationary point violates something.
        weight_limit: largest weight, for cases whose cost does not prove that nothing is feasible.
        stationary: largest predicted reduction, against the merit and a unit radius, to stop at.
        feasible: largest violation that counts as none: 1e-6 of the unit of length is a millimetre.
        max_iterations: largest number of iterations.
    """

    initial_radius: float = 3.0
    weight: float = 10.0
    weight_max: float = 1_000.0
    weight_limit: float = 1e5
    stationary: float = 1e-6
    feasible: float = 1e-6
    max_iterations: int = 50

    SHRINK: ClassVar[float] = 0.25
    COLLAPSED: ClassVar[float] = 1e-9
    FAILURES_MAX: ClassVar[int] = 5
    LITTLE: ClassVar[float] = 1e-2
    RAISE: ClassVar[float] = 10.0

    def init(self, subproblem: Subproblem, lin: Linearisation) -> State:
        """Start from the guess."""
        merit = subproblem.merit(lin, self.weight)
        return State(lin, merit, self.initial_radius, PenaltyParameters(self.weight))

    def resolving(self, resolution: float) -> Self:
        """The same algorithm for rows that resolve the merit to a relative `resolution` only."""
        return replace(
            self,
            stationary=max(self.stationary, resolution),
            feasible=max(self.feasible, resolution),
        )

    def terminate(self, subproblem: Subproblem, state: State, record: Record) -> Status | None:
        """Stop when stationary: small steps alone do not prove it."""
        if state.failures > self.FAILURES_MAX:
            return Status.SOLVER_FAILED
        violated = record.violated > self.feasible
        if state.stationary and not violated:
            return Status.CONVERGED
        if state.stationary:
            return Status.INFEASIBLE if self._next_weight(subproblem, state) is None else None
        return Status.STALLED if state.radius < self.COLLAPSED else None

    def _negligible(self, record: Record) -> float:
        """Largest reduction of the merit that is not worth a step."""
        return self.stationary * max(1.0, abs(record.merit))

    def _negligible_reduction(self, charge: PenaltyParameters, record: Record) -> float:
        """Largest reduction of the merit within a unit radius at which an iterate counts as stationary.

        At the largest weight the question is whether violations can be removed at all. The answer
        is no if the model predicts a reduction of their cost by less than `LITTLE`. The last digits
        of the least violation do not matter, and first-order steps would find them slowly.
        """
        negligible = self._negligible(record)
        if charge.weight < self.weight_max or record.violated <= self.feasible:
            return negligible
        return max(negligible, self.LITTLE * (record.merit - record.total_dv))

    def _weighed(self, subproblem: Subproblem, state: State) -> State:
        """Raise the weight at a stationary, violated iterate: the penalty may not have been exact."""
        weight = self._next_weight(subproblem, state) if state.stationary else None
        if weight is None:
            return state
        merit = subproblem.merit(state.lin, weight)
        return State(state.lin, merit, self.initial_radius, PenaltyParameters(weight))

    def _next_weight(self, subproblem: Subproblem, state: State) -> float | None:
        """The next weight; None if a heavier one cannot change the verdict.

        No feasible plan costs more than all burns at their largest. A merit above that is above any
        feasible plan's; below it the weight may still be less than a multiplier.
        """
        weight, problem = state.charge.weight, subproblem.merit.problem
        if weight < self.weight_max:
            return self.weight_max
        if state.merit > problem.n_burns * problem.dv_max or weight >= self.weight_limit:
            return None
        return self.RAISE * weight

    def _settled(
        self, state: State, new: State, trial: Trial, record: Record, *, stationary: bool
    ) -> State:
        """The next state; also stationary after two successive steps without a worthwhile reduction.

        The steps were refused, and a shorter step kept its prediction. The derivatives are then
        right, and curvature cancels the predicted reduction of longer steps. The remaining
        reduction is less than that predicted.
        """
        worthless = trial.predicted <= self._negligible(record)
        kept = trial.actual > self.SHRINK * trial.predicted
        settled = stationary or (worthless and state.worthless and kept)
        return replace(new, stationary=settled, worthless=worthless and not record.accepted)

    def _judged(
        self,
        subproblem: Subproblem,
        state: State,
        k: int,
        trial: Trial,
        *,
        accepted: bool,
        radius: float,
    ) -> tuple[State, Record]:
        """State and record after a trial step was accepted or refused, for a given next radius."""
        if accepted:
            new = State(trial.lin, trial.merit, radius, state.charge)
        else:
            new = replace(state, radius=radius, failures=0)
        return new, record_of(subproblem, state, new, k, trial)

    def _failed(
        self, subproblem: Subproblem, state: State, k: int, words: str
    ) -> tuple[State, Record]:
        """Shrink the trust region after a failed solve: a smaller one is better conditioned."""
        record = record_of(subproblem, state, state, k, failure=words)
        smaller = state.radius * self.SHRINK
        failures = state.failures + 1
        return replace(state, radius=smaller, failures=failures, worthless=False), record


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
        stationary = self._is_stationary(state, record)
        if guess or not trial.answer.accurate:
            return replace(new, stationary=False, unsure=stationary and not guess), record
        new = replace(new, unsure=False)
        if stationary and state.radius < self.VERDICT_RADIUS and not state.unsure:
            # Within a tiny radius the solver's rounding hides what there is to gain: look again.
            return replace(new, radius=self.VERDICT_RADIUS), record
        return self._settled(state, new, trial, record, stationary=stationary), record

    def _is_stationary(self, state: State, record: Record) -> bool:
        """No step within a unit radius promises a reduction that is worth one.

        The model is convex. If the trust region does not bind, a larger one promises nothing more;
        if it does, the reduction per radius falls with the radius, so that this step's bounds the
        one within a unit radius.
        """
        binds = record.step > 0.99 * record.trust_radius
        scale = min(1.0, record.trust_radius) if binds else 1.0
        return record.predicted <= self._negligible_reduction(state.charge, record) * scale


@dataclass(frozen=True)
class SCvxStar(SCvx):
    """SCvx with multipliers, so that no weight has to make a penalty exact (SCvx*).

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
        """Take a step of SCvx, and update the multipliers when due."""
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
            again = not record.accepted and not record.failure and before.radius <= self.RADIUS_MIN
            return replace(state, radius=0.0 if again else state.radius), record
        hopeless = record.violated > max(
            self.HOPELESS * state.violated, self.BEYOND_ROUNDING * self.feasible
        )
        if hopeless and state.stationary and state.charge.weight >= self.weight_max:
            return state, record
        return self._update(subproblem, state, record), record

    def _weighed(self, subproblem: Subproblem, state: State) -> State:  # noqa: ARG002 -- as inherited
        """Update the multipliers in place of raising the weight."""
        return state

    def _negligible_reduction(self, charge: PenaltyParameters, record: Record) -> float:  # noqa: ARG002 -- as inherited
        """The same threshold at every weight: multipliers show whether violations can be removed."""
        return self._negligible(record)

    def _next_weight(self, subproblem: Subproblem, state: State) -> float | None:  # noqa: ARG002 -- as inherited
        """The next weight: weights grow with the multipliers up to the largest."""
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


@dataclass(frozen=True)
class PTR(ExactPenalty):
    """Penalised trust region: each step is charged ||s||^2 / (2 r) instead of being bounded.

    Penalised: Reynolds, Szmuk, Malyuta, Mesbahi, Acikmese & Carson, "Dual quaternion-based powered
    descent guidance with state-triggered constraints", J. Guid. Control Dyn. 43 (2020), and Malyuta
    et al., "Convex optimization for trajectory generation", IEEE Control Systems 42 (2022). With a
    fixed r the merit may rise; here r adapts as in ProxDescent of Lewis & Wright, "A proximal
    method for composite minimization", Math. Program. 158 (2016). A step whose predicted and actual
    reductions are both lost in the merit's rounding is accepted: refusing it would shrink r again and
    again until nothing moves (Conn, Gould & Toint, Trust Region Methods, 2000, section 17.4.2).
    Attributes are those of `ExactPenalty`, a radius standing for r.
    """

    penalty: ClassVar[Penalty] = "proximal"
    ACCEPT = 0.1
    GROW = 4.0
    FREE = 1e3
    ROUNDING = 1e-7

    def step(
        self, subproblem: Subproblem, dynamics: Dynamics, state: State, k: int, timing: Timing
    ) -> tuple[State, Record]:
        """Linearise, solve, fly; accept a step that gives a tenth of the predicted reduction."""
        state = self._weighed(subproblem, state)
        prox = 1.0 / state.radius
        state = replace(state, charge=replace(state.charge, prox=prox))
        guess = not state.lin.is_dynamically_feasible
        try:
            trial = trial_step(subproblem, dynamics, state, self.FREE, timing, self.stationary)
        except SubproblemError as error:
            return self._failed(subproblem, state, k, str(error))
        rounding = self.ROUNDING * max(1.0, abs(state.merit))
        tangible = max(abs(trial.predicted), abs(trial.actual)) > rounding
        accepted = guess or not tangible or trial.actual > self.ACCEPT * max(trial.predicted, 0.0)
        radius = min(state.radius * (self.GROW if accepted else self.SHRINK), self.FREE)
        new, record = self._judged(subproblem, state, k, trial, accepted=accepted, radius=radius)
        # At the answer -p s is a subgradient of the convex model, which bounds what any step of no
        # component above one can gain: predicted + p (||s||_1 - ||s||^2).
        moved = controls_of(trial.answer, state.lin) - state.lin.controls
        bound = trial.predicted + prox * float(np.abs(moved).sum() - (moved**2).sum())
        worth = self._negligible_reduction(state.charge, record)
        stationary = trial.answer.accurate and not guess and bound <= worth
        if prox > 1.0 or not trial.answer.accurate:  # steps are short because they are charged
            return replace(new, stationary=stationary), record
        return self._settled(state, new, trial, record, stationary=stationary), record


ALGORITHMS: dict[str, Callable[..., Algorithm]] = {
    "scvx": SCvx,
    "ptr": PTR,
    "scvx-star": SCvxStar,
}
"""Algorithms by the name that a solution file records."""
