"""Successive convex programming without a safeguard, the scheme that a frozen covariance is known from.

Every answer is taken. Rizza, Topputo et al. propagate the covariance with the solution before, so
that the convex program may have no feasible point where the problem has one: Echigo et al. call that
artificially infeasible. The ratio tests of `scp_recon` keep their runs from getting there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import FlybyProblem
from formulations.program.penalty import Penalty, PenaltyParameters
from formulations.program.subproblem import Subproblem
from scp_recon.physics.dynamics import Dynamics
from scp_recon.scp.loop import Record, State, Timing
from scp_recon.scp.status import Status
from scp_recon.scp.trial import record_of_trial, trial_step


@dataclass(frozen=True)
class Unguarded:
    """An `Algorithm` that linearises, solves and flies, and asks no more.

    Attributes:
        problem: the flyby problem, for the burns that it allows.
    """

    problem: FlybyProblem

    penalty: ClassVar[Penalty] = "exact"
    feasible: ClassVar[float] = 1e-6
    max_iterations: ClassVar[int] = 20
    WEIGHT, STEP = 1e4, 1e-5

    def init(self, subproblem: Subproblem, lin: Linearisation) -> State:
        """Start from the guess, with a trust region that no burn reaches."""
        merit = subproblem.merit(lin, self.WEIGHT)
        return State(lin, merit, 2.0 * self.problem.dv_max, PenaltyParameters(self.WEIGHT))

    def resolving(self, resolution: float) -> Self:  # noqa: ARG002 -- of the protocol
        """It knows no stationarity."""
        return self

    def step(
        self, subproblem: Subproblem, dynamics: Dynamics, state: State, k: int, timing: Timing
    ) -> tuple[State, Record]:
        """Linearise, solve, fly."""
        trial = trial_step(subproblem, dynamics, state, state.radius, timing, float("inf"))
        new = State(trial.lin, trial.merit, state.radius, state.charge)
        return new, record_of_trial(subproblem, state, new, k, trial)

    def terminate(self, subproblem: Subproblem, state: State, record: Record) -> Status | None:  # noqa: ARG002 -- of the protocol
        """Stop where the convex program has no feasible point, or the burns stand still.

        A feasible point costs its delta-v and no more, and no burn is larger than dv_max: where the
        best that the elastic program finds costs more than that there is none.
        """
        promised = record.merit + record.actual - record.predicted
        if promised > self.problem.n_burns * self.problem.dv_max:
            return Status.INFEASIBLE
        if record.step > self.STEP:
            return None
        return Status.CONVERGED if record.violated <= self.feasible else Status.STALLED
