"""Decide a case in which an algorithm ended without a verdict: infeasible or not, then the least cost.

Near the border of feasibility the multipliers grow without bound. A penalty weight below them is not
exact. One above them, 1e4 and more, multiplies the conic solver's errors, until predicted reductions
are rounding and the trust region collapses. Two problems without a weight take the place of the merit:
the least violation, and the least cost among iterates whose violations count as none. Whole flights
have kinks; their rows are then bundles of tangents (`FlightRows.bundled`), and a verdict needs a
certificate from the hull of slopes near the iterate (`Deciding`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import Linearisation
from formulations.program.subproblem import Penalty, PenaltyParameters, Subproblem, SubproblemError
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.loop import Record, Result, State, Timing, run, trial_step
from scp_recon.scp.status import Status

UNDECIDED = (Status.STALLED, Status.SOLVER_FAILED, Status.MAX_ITERATIONS)
"""Statuses that say nothing about the case."""

SHARE = 0.25
"""Violation to aim at, over the largest one that counts as none: curvature adds some to each step."""

NEAR = 1e-2
"""First trust radius: what is left to decide lies near the end of the run before."""

LEAST = 1e-3
"""Least trust radius where rows have kinks."""

REACH = 1.5 * LEAST
"""Distance, in each control, within which slopes count as those of a kink: flown steps turn."""

PROVED = 1e-2
"""Accuracy of the least violation, over the largest one that counts as none."""

WEIGHT = 10.0
"""Weight of a flown step's further violations, times the root of what counts as none: at a distance d
from the border multipliers grow with 1 / sqrt(d)."""

FLOWN = 3e-2
"""Accuracy of the sum of violations of a flown step, over the same."""


@dataclass(frozen=True)
class Deciding(SCvx):
    """Base of both phases.

    Attributes:
        slopes: the subproblem of the slopes near an iterate, if rows have kinks, as estimates from
            fixed directions do (`FlightRows.sloped`). A minimum at a kink has no vanishing slope, and
            steps by few tangents may be refused anywhere. The trust region then shrinks to `LEAST`
            only. There steps go by all slopes within `REACH`. One that is refused adds its slope,
            until the phase goes on, or what is promised within `NEAR` proves a minimum.
    """

    initial_radius: float = NEAR
    max_iterations: int = 100
    slopes: Subproblem | None = None

    def step(
        self, subproblem: Subproblem, dynamics: Dynamics, state: State, k: int, timing: Timing
    ) -> tuple[State, Record]:
        """Take a step of SCvx, or one by slopes in a collapsed trust region or before a verdict."""
        if self.slopes is None:
            return super().step(subproblem, dynamics, state, k, timing)
        within = self.SHRINK * LEAST
        if state.radius >= LEAST:
            new, record = super().step(subproblem, dynamics, state, k, timing)
            small = new.stationary or new.unsure
            radius = within if small else new.radius
            return replace(new, stationary=False, unsure=False, radius=radius), record
        state = replace(state, radius=LEAST)
        try:
            trial = trial_step(self.slopes, dynamics, state, LEAST, timing, self.stationary)
        except SubproblemError as error:
            return self._failed(subproblem, state, k, str(error))
        accepted = trial.actual > self.SHRINK_BELOW * max(trial.predicted, 0.0)
        radius = LEAST if accepted else within
        new, record = self._judged(subproblem, state, k, trial, accepted=accepted, radius=radius)
        # The gains are many for so few slopes: with these the proof is of a step's own length.
        longer = NEAR / LEAST if subproblem.merit.problem.feedback is None else 1.0
        small = trial.predicted * longer <= self._negligible_reduction(state.charge, record)
        return replace(new, stationary=small and trial.answer.accurate), record


@dataclass(frozen=True)
class LeastViolation(Deciding):
    """SCvx on the sum of violations, until they are a share of what counts as none, or least."""

    penalty: ClassVar[Penalty] = "least"
    weight: float = 1.0
    weight_max: float = 1.0
    weight_limit: float = 1.0

    def init(self, subproblem: Subproblem, lin: Linearisation) -> State:
        """Start from an iterate."""
        charge = PenaltyParameters(self.weight, least=True)
        return State(lin, subproblem.merit(lin, charge), self.initial_radius, charge)

    def terminate(self, subproblem: Subproblem, state: State, record: Record) -> Status | None:
        """Stop also where the violations are small enough."""
        small = record.violated <= SHARE * self.feasible
        return Status.CONVERGED if small else super().terminate(subproblem, state, record)

    def _negligible_reduction(self, charge: PenaltyParameters, record: Record) -> float:  # noqa: ARG002 -- as inherited
        """The last digits of the least violation do not matter."""
        return max(self._negligible(record), self.LITTLE * record.merit)


@dataclass(frozen=True)
class LeastCost(Deciding):
    """SCvx on the cost, among iterates of which no violation is above `feasible`.

    The model's violations stay within a share of `feasible`, or between those of the start and it. What
    a flown step has more is charged; the accuracy of that is not worth a step.
    """

    penalty: ClassVar[Penalty] = "bounded"

    def init(self, subproblem: Subproblem, lin: Linearisation) -> State:
        """Start from an iterate whose violations count as none."""
        # A set with an interior, as conic solvers want it.
        least, most = subproblem.merit.violated(lin), self.feasible
        budget = max(SHARE * most, least + min(SHARE * most, 0.5 * max(most - least, 0.0)))
        charge = PenaltyParameters(self.weight, budget=budget, allowed=self.feasible)
        return State(lin, subproblem.merit(lin, charge), self.initial_radius, charge)

    def step(
        self, subproblem: Subproblem, dynamics: Dynamics, state: State, k: int, timing: Timing
    ) -> tuple[State, Record]:
        """Take a step; an inaccurate answer that promises nothing ends the run, too.

        Such an answer's optimum is known to about what violations' accuracy is worth.
        """
        new, record = super().step(subproblem, dynamics, state, k, timing)
        return replace(new, stationary=new.stationary or new.unsure), record

    def _negligible_reduction(self, charge: PenaltyParameters, record: Record) -> float:
        """Largest negligible reduction, by the accuracy of violations too."""
        return max(self._negligible(record), charge.weight * FLOWN * self.feasible)


def decide(
    make: Callable[[Penalty], Subproblem],
    slopes: Callable[[Penalty], Subproblem] | None,
    dynamics: Dynamics,
    result: Result,
    resolution: float,
    observe: Callable[[Record], None],
) -> Result:
    """Continue a run that ended without a verdict; `make` makes its subproblem with another penalty.

    The least violation decides whether the case is infeasible. If it counts as none, the cost is
    minimised without adding to it. If neither run ends, the status is that of the result given.
    """
    if result.status not in UNDECIDED or not result.lin.is_dynamically_feasible:
        return result
    cost = LeastCost().resolving(resolution)
    most = cost.feasible
    phases = (
        LeastViolation(feasible=most, stationary=PROVED * most),
        replace(cost, weight=WEIGHT / np.sqrt(most)),
    )
    last = result
    for phase in phases:
        subproblem = make(phase.penalty)
        if phase is not phases[-1] and subproblem.merit.worst_violation(last.lin) <= SHARE * most:
            continue
        phase = replace(phase, slopes=slopes and slopes(phase.penalty))
        last = run(subproblem, dynamics, last.lin, phase, observe, last)
        if last.status is not Status.CONVERGED:
            break
    return replace(last, status=result.status) if last.status in UNDECIDED else last
