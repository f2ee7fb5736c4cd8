"""What the algorithms with an exact penalty share: the weight, stationarity and the verdicts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

from formulations.linearisation.linearisation import Linearisation
from formulations.program.penalty import PenaltyParameters
from formulations.program.subproblem import Subproblem
from scp_recon.scp.loop import Record, State
from scp_recon.scp.status import Status
from scp_recon.scp.trial import Trial, record_of, record_of_trial


@dataclass(frozen=True)
class ExactPenalty:
    """An algorithm but for its step. All quantities are nondimensional.

    Attributes:
        initial_radius: of the first trust region, hard or soft.
        weight: first penalty weight; exact when above every multiplier.
        weight_max: the next weight where a stationary point violates something.
        weight_limit: up to which it is raised where the cost does not tell that nothing is feasible.
        stationary: largest predicted reduction, against the merit and a unit radius, to stop at.
        feasible: largest violation that counts as none: 1e-6 of the unit of length is a millimetre.
        max_iterations: limit.
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
        """The same, but that stops where it cannot tell more."""
        return replace(
            self,
            stationary=max(self.stationary, resolution),
            feasible=max(self.feasible, resolution),
        )

    def terminate(self, subproblem: Subproblem, state: State, record: Record) -> Status | None:
        """Stop when stationary; small steps alone prove nothing."""
        if state.failures > self.FAILURES_MAX:
            return Status.SOLVER_FAILED
        violated = record.violated > self.feasible
        if state.stationary and not violated:
            return Status.CONVERGED
        if state.stationary:
            return Status.INFEASIBLE if self._heavier(subproblem, state) is None else None
        return Status.STALLED if state.radius < self.COLLAPSED else None

    def _negligible(self, record: Record) -> float:
        """Reduction of the merit that is not worth a step."""
        return self.stationary * max(1.0, abs(record.merit))

    def _worth(self, charge: PenaltyParameters, record: Record) -> float:
        """Reduction of the merit within a unit radius up to which an iterate counts as stationary.

        What the heaviest weight has to tell is whether violations can be removed at all. There an
        iterate from which the model promises to take less than `LITTLE` off what they cost is one
        where they cannot. The last digits of the least violation do not matter, and first-order steps
        would find them slowly.
        """
        negligible = self._negligible(record)
        if charge.weight < self.weight_max or record.violated <= self.feasible:
            return negligible
        return max(negligible, self.LITTLE * (record.merit - record.total_dv))

    def _weighed(self, subproblem: Subproblem, state: State) -> State:
        """Stationary but violated: the penalty may not have been exact, so weigh it more."""
        weight = self._heavier(subproblem, state) if state.stationary else None
        if weight is None:
            return state
        merit = subproblem.merit(state.lin, weight)
        return State(state.lin, merit, self.initial_radius, PenaltyParameters(weight))

    def _heavier(self, subproblem: Subproblem, state: State) -> float | None:
        """The next weight, if a heavier one may tell more.

        No plan that keeps the limits costs more than all burns at their largest. A merit above that is
        above any such plan's; below it the weight may still be less than a multiplier.
        """
        weight, problem = state.charge.weight, subproblem.merit.problem
        if weight < self.weight_max:
            return self.weight_max
        if state.merit > problem.n_burns * problem.dv_max or weight >= self.weight_limit:
            return None
        return self.RAISE * weight

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
        """Where a trial's acceptance leaves the algorithm, its next radius given."""
        if accepted:
            new = State(trial.lin, trial.merit, radius, state.charge)
        else:
            new = replace(state, radius=radius, failures=0)
        return new, record_of_trial(subproblem, state, new, k, trial)

    def _failed(
        self, subproblem: Subproblem, state: State, k: int, words: str
    ) -> tuple[State, Record]:
        """A smaller trust region is a better conditioned problem."""
        record = record_of(subproblem, state, k, failure=words)
        smaller = state.radius * self.SHRINK
        failures = state.failures + 1
        return replace(state, radius=smaller, failures=failures, worthless=False), record
