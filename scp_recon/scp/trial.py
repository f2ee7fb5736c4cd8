"""One try of an iteration: linearise, solve, fly, compare; and what the record says of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from time import perf_counter
from typing import NamedTuple

from formulations.linearisation.linearisation import Linearisation
from formulations.program.penalty import PenaltyParameters
from formulations.program.subproblem import Step, Subproblem, SubproblemError
from scp_recon.physics.dynamics import Dynamics
from scp_recon.scp.loop import Record, State, Timing


class Trial(NamedTuple):
    """Where a subproblem's answer leads.

    Attributes:
        answer: the subproblem's.
        lin: the flown iterate.
        merit: its merit.
        predicted: reduction of the merit that the model promised.
        actual: reduction that the flight gave.
        step: largest change of a burn's component.
    """

    answer: Step
    lin: Linearisation
    merit: float
    predicted: float
    actual: float
    step: float


def trial_step(
    subproblem: Subproblem,
    dynamics: Dynamics,
    state: State,
    radius: float,
    timing: Timing,
    slack: float,
) -> Trial:
    """Linearise, solve within a radius, and fly the answer.

    Standing still is always possible: an answer that is worse by its own model is none. Where a burn
    has vanished whose errors begin with a jump, the program is solved with that burn executed too
    (`ExecutionErrors.otherwise`), and the best answer counts.

    Args:
        subproblem: to solve.
        dynamics: to fly.
        state: where from, and the charge.
        radius: of the trust region.
        timing: to add to.
        slack: by how much of the merit an answer may be worse than no step.

    Raises:
        SubproblemError: if there is no answer.
    """
    answer = _answer(subproblem, state.lin, radius, state.charge, timing)
    for lin in _otherwise(subproblem, state.lin):
        with suppress(SubproblemError):
            other = _answer(subproblem, lin, radius, state.charge, timing)
            answer = min(answer, other, key=lambda step: step.merit)
    worst = state.merit + slack * max(1.0, abs(state.merit))
    if state.lin.is_dynamically_feasible and answer.merit > worst:
        raise SubproblemError(f"the answer is worse than no step: {answer.merit:g}")
    start = perf_counter()
    lin = dynamics.close_defects(state.lin, answer.burns)
    timing.linearise += perf_counter() - start
    merit = subproblem.merit(lin, state.charge)
    step = float(abs(answer.burns - state.lin.iterate.burns).max())
    return Trial(answer, lin, merit, state.merit - answer.merit, state.merit - merit, step)


def _answer(
    subproblem: Subproblem,
    lin: Linearisation,
    radius: float,
    charge: PenaltyParameters,
    timing: Timing,
) -> Step:
    start = perf_counter()
    subproblem.update(lin)
    timing.linearise += perf_counter() - start
    answer = subproblem.solve(radius, charge)
    timing.canonicalise += answer.canonicalise_s
    timing.conic_solver += answer.solver_s
    return answer


def _otherwise(subproblem: Subproblem, lin: Linearisation) -> Iterator[Linearisation]:
    """The iterate under other models of its burns' errors, if the rows feel them."""
    if subproblem.merit.rows.with_factor:
        for errors in lin.problem.execution_errors.otherwise(lin.iterate.burns):
            yield Linearisation(
                replace(lin.problem, execution_errors=errors), lin.iterate, lin.arcs
            )


def record_of(subproblem: Subproblem, state: State, k: int, failure: str = "") -> Record:
    """The record of an iteration that went nowhere: what it ends with is what it began with."""
    violations = dict(subproblem.merit.violations(state.lin))
    defect = float(violations.pop("dynamics").max())
    return Record(
        k=k,
        merit=state.merit,
        predicted=0.0,
        actual=0.0,
        accepted=False,
        trust_radius=state.radius,
        total_dv=state.lin.iterate.total_dv,
        max_violation=max(float(v.max(initial=0.0)) for v in violations.values()),
        max_defect=defect,
        step=0.0,
        solver_s=0.0,
        failure=failure,
    )


def record_of_trial(
    subproblem: Subproblem, before: State, after: State, k: int, trial: Trial
) -> Record:
    """The record of an iteration that led from a state to another, accepted if it moved."""
    return replace(
        record_of(subproblem, after, k),
        predicted=trial.predicted,
        actual=trial.actual,
        accepted=after.lin is trial.lin,
        trust_radius=before.radius,
        step=trial.step,
        solver_s=trial.answer.solver_s,
    )
