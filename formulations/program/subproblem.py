"""One convex subproblem: burns, dynamics, state constraints, trust region and penalty.

    min  sum ||dv_i|| + w (sum of buffers + ||virtual control||_1)

or with another charge for violations and steps, see `penalty`. What an iterate costs and violates is
said here, from the nonlinear dynamics. The program around it is written in `model`; what a formulation
adds to it is in `condensed` and `lifted`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from formulations.lifting import Linearisation
from formulations.penalty import Charge, augmented_value, exact_value
from formulations.problem import FlybyProblem
from formulations.regions import Array
from formulations.rows import Margins, Rows


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


class Evaluation:
    """What an iterate of P3 or P2 costs and violates, nonlinearly.

    Args:
        problem: the flyby problem.
        rows: its state constraints, those of P3 or of P2.
    """

    def __init__(self, problem: FlybyProblem, rows: Rows) -> None:
        self.problem, self.rows = problem, rows
        self._seen: tuple[Linearisation, dict[str, Array]] | None = None

    def merit(self, lin: Linearisation, charge: float | Charge) -> float:
        """Total delta-v plus the charge for every violation, from the nonlinear dynamics.

        A number is the exact penalty's weight.
        """
        if isinstance(charge, Charge) and charge.multipliers is not None:
            excess = self.excess(lin)
            charged = np.r_[excess[:6], np.maximum(excess[6:], 0.0)]
            return lin.iterate.total_dv + augmented_value(charged, charge)
        weight = charge.weight if isinstance(charge, Charge) else charge
        violations = self.violations(lin)
        defects = violations.pop("dynamics")
        rows = np.concatenate(list(violations.values()))
        return lin.iterate.total_dv + exact_value(defects, rows, weight)

    def excess(self, lin: Linearisation) -> Array:
        """Miss of the final state and every row's signed violation, shape (6 + rows,).

        In the order of `violations`; a row is satisfied where it is not positive.
        """
        signed = dict(self._signed(lin))
        del signed["dynamics"]
        return np.concatenate([lin.defects[-1], *signed.values()])

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margins of the burn limits and of the state constraints by name."""
        burns = lin.problem.burn_margins(lin.iterate.burns)
        by_burn = {name: Margins(lin.problem.burn_nodes, m) for name, m in burns.items()}
        return by_burn | self.rows.margins(lin)

    def violations(self, lin: Linearisation) -> dict[str, Array]:
        """What the buffers would have to hold, by constraint name; the defects are `dynamics`."""
        return {name: np.maximum(amount, 0.0) for name, amount in self._signed(lin).items()}

    def _signed(self, lin: Linearisation) -> dict[str, Array]:
        """Violations, negative where there is room; defects by their size."""
        if self._seen is None or self._seen[0] is not lin:
            burns = lin.iterate.burns
            toward, away = (cone.inside(burns) for cone in lin.problem.burn_cones)
            amounts = {
                "dynamics": np.abs(lin.defects).ravel(),
                "dv_max": -lin.problem.burn_margins(burns)["dv_max"],
                "dv_battery": np.concatenate([toward, away]),
            }
            rows = self.rows.margins(lin).items()
            self._seen = lin, amounts | {name: -row.margin for name, row in rows}
        return self._seen[1]


class Subproblem(Evaluation, ABC):
    """A formulation of P3 or P2 around an iterate."""

    @abstractmethod
    def update(self, lin: Linearisation) -> None:
        """Convexify at an iterate.

        Raises:
            SubproblemError: if the dynamics cannot be linearised there.
        """

    @abstractmethod
    def solve(self, radius: float, charge: float | Charge) -> Step:
        """Solve within a trust region: no component of a burn moves by more than `radius`.

        Args:
            radius: of the trust region.
            charge: of the penalty; a number is the exact penalty's weight.

        Returns:
            The step, whose merit leaves out what a proximal penalty charges for it.

        Raises:
            SubproblemError: if the conic solver fails or gives no finite answer.
        """
