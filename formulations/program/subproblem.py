"""One convex subproblem: burns, dynamics, state constraints, trust region and penalty.

    min  sum ||dv_i|| + w (sum of buffers + ||virtual control||_1)

or with another charge for violations and steps, see `penalty`. What an iterate costs and violates,
from the nonlinear dynamics, is said in `merit`; the program around it is written in `model`, and what a
formulation adds to it in `condensed` and `lifted`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.regions import Array
from formulations.program.merit import MeritFunction
from formulations.program.penalty import PenaltyParameters


class SubproblemError(RuntimeError):
    """There is no usable answer; the message says why, in the conic solver's words if it has any."""


@dataclass(frozen=True)
class Step:
    """Answer of a subproblem: new burns (m, 3), the merit its model predicts, solver's seconds.

    Whether it is `accurate` is the solver's own word; a verdict needs an accurate answer.
    """

    burns: Array
    merit: float
    solver_s: float
    canonicalise_s: float
    accurate: bool = True


class Subproblem(ABC):
    """A formulation of P3 or P2 around an iterate.

    Attributes:
        merit: what it approximates; it says what counts of the problem of the linearisation that it
            is updated with, and what of its own.
    """

    merit: MeritFunction

    @abstractmethod
    def update(self, lin: Linearisation) -> None:
        """Convexify at an iterate.

        Raises:
            SubproblemError: if the dynamics cannot be linearised there.
        """

    @abstractmethod
    def solve(self, radius: float, charge: float | PenaltyParameters) -> Step:
        """Solve within a trust region: no component of a burn moves by more than `radius`.

        Args:
            radius: of the trust region.
            charge: of the penalty; a number is the exact penalty's weight.

        Returns:
            The step, whose merit leaves out what a proximal penalty charges for it.

        Raises:
            SubproblemError: if the conic solver fails or gives no finite answer.
        """
