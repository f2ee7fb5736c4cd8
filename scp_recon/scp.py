"""Sequential convex programming: linearise, solve, fly, compare, and move the trust region.

Each iterate is flown: what a subproblem answers is made to obey the nonlinear dynamics, so that the
only defect that can remain is at the final state. The guess alone may have defects everywhere; there
is nothing in it to go back to, so the step from it is always taken.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Protocol

from formulations.lifting import Linearisation
from formulations.subproblem import Step, Subproblem, SubproblemError
from scp_recon.dynamics import Dynamics
from scp_recon.status import Status


@dataclass(frozen=True)
class Record:
    """One iteration, nondimensional.

    Attributes:
        k: number, from 1.
        merit: of the iterate that the iteration ends with.
        predicted: reduction of the merit by the convex model.
        actual: reduction of the merit by the nonlinear dynamics.
        accepted: whether the step was taken.
        trust_radius: bound on each burn component's change, in this iteration.
        total_dv: of the iterate that the iteration ends with.
        max_violation: largest violation of a constraint there.
        max_defect: largest defect of the dynamics and the final state there.
        step: largest change of a burn component proposed.
        solver_s: time in the conic solver.
        failure: the conic solver's words where it gave no answer, else empty.
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


@dataclass
class Timing:
    """Seconds by what they were spent on."""

    setup: float = 0.0
    linearise: float = 0.0
    canonicalise: float = 0.0
    conic_solver: float = 0.0

    def add(self, other: Timing) -> None:
        """Add another run's seconds."""
        for name, seconds in vars(other).items():
            setattr(self, name, getattr(self, name) + seconds)


@dataclass(frozen=True)
class State:
    """What the algorithm carries from one iteration to the next."""

    lin: Linearisation
    merit: float
    radius: float
    weight: float
    failures: int = 0
    stationary: bool = False


class Algorithm(Protocol):
    """A way to globalise: the loop in `run` is the same for all."""

    @property
    def max_iterations(self) -> int:
        """Limit of the loop."""
        ...

    def init(self, subproblem: Subproblem, lin: Linearisation) -> State:
        """The state before the first iteration."""
        ...

    def step(
        self, subproblem: Subproblem, dynamics: Dynamics, state: State, k: int, timing: Timing
    ) -> tuple[State, Record]:
        """One iteration."""
        ...

    def terminate(self, state: State, record: Record) -> Status | None:
        """How to stop, or None to go on."""
        ...


@dataclass(frozen=True)
class TrustRegion:
    """Trust region with ratio test and exact penalty (SCvx).

    Mao, Szmuk & Acikmese, "Successive convexification of non-convex optimal control problems and
    its convergence properties", CDC 2016, alg. 2; the ratios are those of Conn, Gould & Toint,
    Trust Region Methods, 2000, alg. 6.1.1 (eta_1 = 0.01, eta_2 = 0.9) with 0.25 and 0.7 for the
    radius. All quantities are nondimensional.

    Attributes:
        initial_radius: first bound on the change of a burn component, in units of speed.
        weight: first penalty weight; exact when above every multiplier.
        weight_max: tried once more with before calling a case infeasible.
        stationary: largest predicted reduction, against the merit and a unit radius, to stop at.
        feasible: largest violation that counts as none: 1e-6 of the unit of length is a millimetre.
        max_iterations: limit.
    """

    initial_radius: float = 3.0
    weight: float = 10.0
    weight_max: float = 1_000.0
    stationary: float = 1e-6
    feasible: float = 1e-6
    max_iterations: int = 50

    ACCEPT, SHRINK_BELOW, GROW_ABOVE = 0.01, 0.25, 0.7
    SHRINK, GROW = 0.25, 3.0
    COLLAPSED, VERDICT_RADIUS = 1e-9, 1e-2
    FAILURES_MAX = 5
    GUESS_RADIUS = 3.0

    def init(self, subproblem: Subproblem, lin: Linearisation) -> State:
        """Start from the guess."""
        return State(lin, subproblem.merit(lin, self.weight), self.initial_radius, self.weight)

    def step(
        self, subproblem: Subproblem, dynamics: Dynamics, state: State, k: int, timing: Timing
    ) -> tuple[State, Record]:
        """Linearise, solve, fly, judge by the ratio of actual to predicted reduction."""
        if state.stationary:
            state = self._raise_weight(subproblem, state)
        try:
            start = perf_counter()
            subproblem.update(state.lin)
            timing.linearise += perf_counter() - start
            guess = not state.lin.is_flown
            radius = max(state.radius, self.GUESS_RADIUS) if guess else state.radius
            answer = subproblem.solve(radius, state.weight)
            if not guess:
                self._check(answer, state)
        except SubproblemError as error:
            # A smaller trust region is a better conditioned problem.
            record = _record(subproblem, state, k, failure=str(error))
            smaller = state.radius * self.SHRINK
            return replace(state, radius=smaller, failures=state.failures + 1), record
        timing.canonicalise += answer.canonicalise_s
        timing.conic_solver += answer.solver_s

        start = perf_counter()
        trial = dynamics.fly(state.lin, answer.burns)
        trial_merit = subproblem.merit(trial, state.weight)
        timing.linearise += perf_counter() - start
        predicted, actual = state.merit - answer.merit, state.merit - trial_merit
        step = float(abs(answer.burns - state.lin.iterate.burns).max())
        ratio = actual / predicted if predicted > 0.0 else 0.0
        accepted = guess or ratio > self.ACCEPT
        radius = state.radius
        if ratio < self.SHRINK_BELOW and not guess:
            radius = self.SHRINK * min(radius, step)
        elif ratio > self.GROW_ABOVE and step > 0.99 * radius:
            radius = self.GROW * radius
        if accepted:
            new = State(trial, trial_merit, radius, state.weight)
        else:
            new = replace(state, radius=radius, failures=0)
        record = replace(
            _record(subproblem, new, k),
            predicted=predicted,
            actual=actual,
            accepted=accepted,
            trust_radius=state.radius,
            step=step,
            solver_s=answer.solver_s,
        )
        stationary = self._is_stationary(record) and not guess
        if stationary and state.radius < self.VERDICT_RADIUS:
            # Within a tiny radius the solver's rounding hides what there is to gain: look again.
            return replace(new, radius=self.VERDICT_RADIUS), record
        return replace(new, stationary=stationary), record

    def terminate(self, state: State, record: Record) -> Status | None:
        """Stop when stationary; small steps alone prove nothing."""
        if state.failures > self.FAILURES_MAX:
            return Status.SOLVER_FAILED
        violated = max(record.max_violation, record.max_defect) > self.feasible
        if state.stationary and not violated:
            return Status.CONVERGED
        if state.stationary:
            return Status.INFEASIBLE if state.weight >= self.weight_max else None
        if state.radius >= self.COLLAPSED:
            return None
        # The heavier weight is tried where the first one's iterate was stationary and violated:
        # where it finds nothing better that verdict stands.
        stands = violated and state.weight >= self.weight_max
        return Status.INFEASIBLE if stands else Status.STALLED

    def _check(self, answer: Step, state: State) -> None:
        """Standing still is always possible: an answer that is worse by its own model is none.

        Raises:
            SubproblemError: if it is.
        """
        if answer.merit > state.merit + self.stationary * max(1.0, abs(state.merit)):
            raise SubproblemError(f"the answer is worse than no step: {answer.merit:g}")

    def _is_stationary(self, record: Record) -> bool:
        """No step within a unit radius promises a reduction that is worth one.

        The model is convex. If the trust region does not bind, a larger one promises nothing more;
        if it does, the reduction per radius falls with the radius, so that the one found here
        bounds the one within a unit radius.
        """
        binds = record.step > 0.99 * record.trust_radius
        scale = max(1.0, abs(record.merit)) * (min(1.0, record.trust_radius) if binds else 1.0)
        return record.predicted <= self.stationary * scale

    def _raise_weight(self, subproblem: Subproblem, state: State) -> State:
        """Stationary but violated: the penalty may not have been exact, so weigh it once more."""
        merit = subproblem.merit(state.lin, self.weight_max)
        radius = self.initial_radius
        return State(state.lin, merit, radius, self.weight_max)


def _record(subproblem: Subproblem, state: State, k: int, failure: str = "") -> Record:
    violations = dict(subproblem.violations(state.lin))
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


@dataclass(frozen=True)
class Result:
    """How a run ended and where."""

    status: Status
    lin: Linearisation
    records: tuple[Record, ...]
    timing: Timing = field(compare=False)


def run(
    subproblem: Subproblem,
    dynamics: Dynamics,
    start: Linearisation,
    algorithm: Algorithm,
    observe: Callable[[Record], None],
) -> Result:
    """Iterate until the algorithm says how to stop. Ctrl-C ends with the best iterate so far."""
    records: list[Record] = []
    timing = Timing()
    state = algorithm.init(subproblem, start)
    status = Status.MAX_ITERATIONS
    try:
        for k in range(1, algorithm.max_iterations + 1):
            state, record = algorithm.step(subproblem, dynamics, state, k, timing)
            records.append(record)
            observe(record)
            stop = algorithm.terminate(state, record)
            if stop is not None:
                status = stop
                break
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    return Result(status, state.lin, tuple(records), timing)
