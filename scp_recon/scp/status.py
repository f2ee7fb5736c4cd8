"""List the statuses of a plan: every way in which planning can end, with its message."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple


class Outcome(NamedTuple):
    """A status: its name in a file, what happened, the command's exit code; 4 without a verdict."""

    name: str
    message: str
    exit_code: int = 4


class Status(Enum):
    """Ways in which a stage or a plan ends; each member is its own message."""

    CONVERGED = Outcome(
        "converged",
        "Converged: stationary, every constraint of the problem holds, no buffer is in use.",
        0,
    )
    INFEASIBLE = Outcome(
        "infeasible",
        "Infeasible: stationary at the least violation that was found from here.",
        3,
    )
    MAX_ITERATIONS = Outcome("max_iterations", "Not converged: the iteration limit came first.")
    STALLED = Outcome(
        "stalled",
        "Not converged: the trust region collapsed before the iterate became stationary.",
    )
    SOLVER_FAILED = Outcome(
        "solver_failed",
        "Not converged: the conic solver gave no usable answer in any trust region tried.",
    )
    LOST = Outcome(
        "lost",
        "Lost: the final state is missed by more than three sigma of what the flown plan predicts. "
        "State, frame or flown burns are wrong, or too few burns are left.",
        5,
    )
    INTERRUPTED = Outcome(
        "interrupted",
        "Interrupted: this is the best iterate so far; it need not be a solution. As init, it is "
        "continued.",
        130,
    )

    @classmethod
    def named(cls, name: str) -> Status:
        """The status of that name.

        Raises:
            ValueError: if there is none.
        """
        for status in cls:
            if status.value.name == name:
                return status
        raise ValueError(f"no status is named {name!r}")
