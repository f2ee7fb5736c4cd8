"""Sequential convex programming: linearise, solve, fly, compare, and globalise.

Each iterate is flown: what a subproblem answers is made to obey the nonlinear dynamics, so that the
only defect that can remain is at the final state. The guess alone may have defects everywhere; there
is nothing in it to go back to, so the step from it is always taken. What comes after a step, the
algorithm decides: `scvx`, `ptr` or `scvx_star`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, Self

from formulations.linearisation.linearisation import Linearisation
from formulations.program.penalty import Penalty, PenaltyParameters
from formulations.program.subproblem import Subproblem
from scp_recon.physics.dynamics import Dynamics
from scp_recon.scp.status import Status


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

    @property
    def violated(self) -> float:
        """Largest violation of anything."""
        return max(self.max_violation, self.max_defect)


@dataclass
class Timing:
    """Seconds by what they were spent on.

    Attributes:
        setup: building subproblems, once each.
        linearise: flying steps, differentiating every arc, and the constraints from that.
        canonicalise: from the constraints to the conic solver's numbers, and back.
        conic_solver: inside the solver's library: taking in the numbers, and solving.
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
    """What the algorithm carries from one iteration to the next.

    Attributes:
        lin: the iterate.
        merit: its merit under `charge`.
        radius: of the trust region.
        charge: weights and multipliers.
        failures: of the conic solver, in a row.
        stationary: whether no step promises a reduction that is worth one.
        worthless: whether the last step was refused, and promised no more than what is not worth one.
        change: SCvx*'s bound on the merit's change at which the multipliers are next updated.
        violated: largest violation when they were updated last.
    """

    lin: Linearisation
    merit: float
    radius: float
    charge: PenaltyParameters
    failures: int = 0
    stationary: bool = False
    worthless: bool = False
    change: float = float("inf")
    violated: float = float("inf")


class Algorithm(Protocol):
    """A way to globalise: the loop in `run` is the same for all."""

    @property
    def penalty(self) -> Penalty:
        """How its subproblems charge violations and steps."""
        ...

    @property
    def feasible(self) -> float:
        """Largest violation that counts as none."""
        ...

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

    def resolving(self, resolution: float) -> Self:
        """The same, for rows that tell no more than a relative reduction of the merit."""
        ...

    def terminate(self, subproblem: Subproblem, state: State, record: Record) -> Status | None:
        """How to stop, or None to go on."""
        ...


@dataclass(frozen=True, eq=False)
class Result:
    """How a run ended and where."""

    status: Status
    lin: Linearisation
    records: tuple[Record, ...]
    timing: Timing


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
            stop = algorithm.terminate(subproblem, state, record)
            if stop is not None:
                status = stop
                break
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    return Result(status, state.lin, tuple(records), timing)
