"""Run sequential convex programming: `run` iterates, `trial_step` linearises, solves and flies a step.

Each iterate is flown: the answer of a subproblem is corrected to obey the nonlinear dynamics, so
only the final state can have a defect. The initial guess may have defects everywhere. It is no
iterate to return to, so the first step is always accepted. The algorithm decides on every other
trial step: see `algorithms`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from time import perf_counter
from typing import NamedTuple, Protocol, Self

from formulations.arrays import Array
from formulations.linearisation.dynamics import Dynamics
from formulations.linearisation.linearisation import Linearisation
from formulations.program.subproblem import (
    Penalty,
    PenaltyParameters,
    Step,
    Subproblem,
    SubproblemError,
)
from scp_recon.scp.status import Status


@dataclass(frozen=True)
class Record:
    """One iteration, nondimensional.

    Attributes:
        k: number, from 1.
        merit: of the iterate after the iteration; see `verdict` for those after a run without one.
        predicted: reduction of the merit by the convex model.
        actual: reduction of the merit by the nonlinear dynamics.
        accepted: whether the step was accepted.
        trust_radius: bound on each burn component's change, in this iteration.
        total_dv: its cost, the total delta-v or what stands for it beside corrections.
        max_violation: its largest violation of a constraint.
        max_defect: its largest defect of the dynamics and the final state.
        step: largest change of a burn component proposed.
        solver_s: time in the conic solver.
        failure: the conic solver's message where it gave no answer, else empty.
    """

    k: int
    merit: float
    predicted: float
    actual: float
    accepted: bool
    trust_radius: float
    total_dv: float
    max_violation: float
    max_defect: float
    step: float
    solver_s: float
    failure: str = ""

    @property
    def violated(self) -> float:
        """Largest violation or defect."""
        return max(self.max_violation, self.max_defect)


@dataclass
class Timing:
    """Seconds spent on each part of a run.

    Attributes:
        setup: building subproblems, once each.
        linearise: flying steps, differentiating every arc, and the constraints from that.
        canonicalise: turning the constraints into the conic solver's data, and its answer back.
        conic_solver: inside the solver's library, its set-up included.
    """

    setup: float = 0.0
    linearise: float = 0.0
    canonicalise: float = 0.0
    conic_solver: float = 0.0

    def add(self, other: Timing) -> None:
        """Add another run's seconds."""
        for name, seconds in vars(other).items():
            setattr(self, name, getattr(self, name) + seconds)


@dataclass(frozen=True, eq=False)
class State:
    """The state of an algorithm between iterations.

    Attributes:
        lin: the iterate.
        merit: its merit under `charge`.
        radius: of the trust region.
        charge: weights and multipliers.
        failures: consecutive failures of the conic solver.
        stationary: whether no step predicts a worthwhile reduction.
        worthless: whether the last step was refused with a predicted reduction too small for a
            step.
        unsure: whether the last answer was inaccurate by the solver and predicted no reduction
            either.
        change: SCvx*'s bound on the merit's change at which the multipliers are next updated.
        violated: largest violation at the last update of the multipliers.
    """

    lin: Linearisation
    merit: float
    radius: float
    charge: PenaltyParameters
    failures: int = 0
    stationary: bool = False
    worthless: bool = False
    unsure: bool = False
    change: float = float("inf")
    violated: float = float("inf")


class Algorithm(Protocol):
    """A globalisation of the loop in `run`."""

    @property
    def penalty(self) -> Penalty:
        """Penalty of violations and steps in its subproblems."""

    @property
    def feasible(self) -> float:
        """Largest violation that counts as none."""

    @property
    def max_iterations(self) -> int:
        """Limit of the number of iterations."""

    def init(self, subproblem: Subproblem, lin: Linearisation) -> State:
        """The state before the first iteration."""

    def step(
        self, subproblem: Subproblem, dynamics: Dynamics, state: State, k: int, timing: Timing
    ) -> tuple[State, Record]:
        """Do one iteration."""

    def resolving(self, resolution: float) -> Self:
        """The same algorithm for rows that resolve the merit to a relative `resolution` only."""

    def terminate(self, subproblem: Subproblem, state: State, record: Record) -> Status | None:
        """Status to stop with, or None to go on."""


@dataclass(frozen=True, eq=False)
class Result:
    """Status and last iterate of a run.

    Attributes:
        status: how it ended.
        lin: the last iterate, with its dynamics linearised about it; nondimensional.
        records: one for each iteration.
        timing: seconds by part of the work.
        is_weighed: whether the first penalty weight did not suffice: the way from there may have led
            to a poor optimum.
    """

    status: Status
    lin: Linearisation
    records: tuple[Record, ...]
    timing: Timing
    is_weighed: bool = False


def run(
    subproblem: Subproblem,
    dynamics: Dynamics,
    start: Linearisation,
    algorithm: Algorithm,
    observe: Callable[[Record], None],
    before: Result | None = None,
    *,
    rough: bool = False,
) -> Result:
    """Iterate until the algorithm stops, `before` being the records and seconds so far.

    Ctrl-C ends with the best iterate so far. A `rough` end keeps the derivatives before the last
    correction of its flight, which is below 1e-8.
    """
    records = list(before.records) if before else []
    timing = Timing()
    if before:
        timing.add(before.timing)
    state = first = algorithm.init(subproblem, start)
    status = Status.MAX_ITERATIONS
    try:
        for k in range(len(records) + 1, len(records) + algorithm.max_iterations + 1):
            state, record = algorithm.step(subproblem, dynamics, state, k, timing)
            records.append(record)
            observe(record)
            stop = algorithm.terminate(subproblem, state, record)
            if stop is not None:
                status = stop
                break
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    kept = rough or state.lin is start
    lin = state.lin if kept else _linearised(dynamics, state.lin, timing)
    is_weighed = state.charge.weight > first.charge.weight or (
        before is not None and before.is_weighed
    )
    return Result(status, lin, tuple(records), timing, is_weighed)


def _linearised(dynamics: Dynamics, lin: Linearisation, timing: Timing) -> Linearisation:
    """An iterate with its own derivatives: the last correction of a flight keeps those before it."""
    start = perf_counter()
    lin = dynamics.linearise(lin.problem, lin.iterate)
    timing.linearise += perf_counter() - start
    return lin


class Trial(NamedTuple):
    """A subproblem's answer, flown: the iterate and its merit.

    `predicted` is the model's reduction of the merit, `actual` that of the flown iterate; `step` is
    the largest change of a burn's component.
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
    """Linearise, solve within a radius, and fly the answer; the seconds are added to the timing.

    A zero step is always feasible, so an answer worse by its own model, by more than `slack` of the
    merit, is refused. Where a burn has vanished whose errors begin with a jump, the program is also
    solved with that burn executed (`ExecutionErrors.alternatives`), and the best answer counts.

    Raises:
        SubproblemError: if there is no answer.
    """
    answer = _answer(subproblem, state.lin, radius, state.charge, timing)
    for lin in _with_other_errors(subproblem, state.lin):
        with suppress(SubproblemError):
            other = _answer(subproblem, lin, radius, state.charge, timing)
            answer = min(answer, other, key=lambda step: step.merit)
    worst = state.merit + slack * max(1.0, abs(state.merit))
    if state.lin.is_dynamically_feasible and answer.merit > worst:
        raise SubproblemError(f"the answer is worse than no step: {answer.merit:g}")
    start = perf_counter()
    misses = state.charge.multipliers is not None
    moved = answer.burns, answer.gains, answer.times
    lin = dynamics.close_defects(state.lin, *moved, misses=misses)
    timing.linearise += perf_counter() - start
    merit = subproblem.merit(lin, state.charge)
    step = float(abs(controls_of(answer, state.lin) - state.lin.controls).max())
    return Trial(answer, lin, merit, state.merit - answer.merit, state.merit - merit, step)


def controls_of(answer: Step, lin: Linearisation) -> Array:
    """Burns, firing times and gains of an answer in one vector."""
    return lin.problem.controls(answer.burns, answer.gains, answer.times)


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


def _with_other_errors(subproblem: Subproblem, lin: Linearisation) -> Iterator[Linearisation]:
    """The iterate under other models of its burns' errors, if the rows depend on them."""
    if subproblem.merit.rows.with_factor:
        for errors in lin.problem.execution_errors.alternatives(lin.iterate.burns):
            yield Linearisation(
                replace(lin.problem, execution_errors=errors), lin.iterate, lin.arcs
            )


def record_of(
    subproblem: Subproblem,
    before: State,
    after: State,
    k: int,
    trial: Trial | None = None,
    failure: str = "",
) -> Record:
    """Record of an iteration from one state to the next, by a trial step if there was one."""
    violations = dict(subproblem.merit.violations(after.lin))
    defect = float(violations.pop("dynamics").max())
    return Record(
        k=k,
        merit=after.merit,
        predicted=trial.predicted if trial else 0.0,
        actual=trial.actual if trial else 0.0,
        accepted=trial is not None and after.lin is trial.lin,
        trust_radius=before.radius,
        total_dv=subproblem.merit.cost(after.lin),
        max_violation=max(float(v.max(initial=0.0)) for v in violations.values()),
        max_defect=defect,
        step=trial.step if trial else 0.0,
        solver_s=trial.answer.solver_s if trial else 0.0,
        failure=failure,
    )
