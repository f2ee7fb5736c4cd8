"""What an iterate of P3 or P2 costs and violates, from the nonlinear dynamics, never from the model."""

from __future__ import annotations

import numpy as np

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import FlybyProblem
from formulations.problem.regions import Array
from formulations.program.penalty import PenaltyParameters, augmented_value, exact_value
from formulations.rows.cones import Margins, Rows


class MeritFunction:
    """What an iterate of P3 or P2 costs and violates, nonlinearly.

    Boundary states and initial covariance are those of the linearisation's own problem, so that one
    function judges flights from any initial state. Limits on the burns and constraints are this one's.
    Grid, burn nodes and execution error have to be the same in both.

    Args:
        problem: the flyby problem.
        rows: its state constraints, those of P3 or of P2.
    """

    def __init__(self, problem: FlybyProblem, rows: Rows) -> None:
        self.problem, self.rows = problem, rows
        self._seen: tuple[Linearisation, dict[str, Array]] | None = None

    def __call__(self, lin: Linearisation, charge: float | PenaltyParameters) -> float:
        """Total delta-v plus the charge for every violation, from the nonlinear dynamics.

        Where the final state need not be met its weighed miss is a part of the cost, and no violation.
        A number is the exact penalty's weight.
        """
        if isinstance(charge, PenaltyParameters) and charge.multipliers is not None:
            excess = self.excess(lin)
            charged = np.r_[excess[:6], np.maximum(excess[6:], 0.0)]
            return lin.iterate.total_dv + augmented_value(charged, charge)
        weight = charge.weight if isinstance(charge, PenaltyParameters) else charge
        violations = self.violations(lin)
        defects = violations.pop("dynamics")
        rows = np.concatenate(list(violations.values()))
        cost = lin.iterate.total_dv + self.problem.missed(lin.defects)
        return cost + exact_value(defects, rows, weight)

    def excess(self, lin: Linearisation) -> Array:
        """Miss of the final state and every row's signed violation, shape (6 + rows,).

        In the order of `violations`; a row is satisfied where it is not positive.
        """
        signed = dict(self._signed(lin))
        del signed["dynamics"]
        return np.concatenate([lin.defects[-1], *signed.values()])

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margins of the burn limits and of the state constraints by name."""
        burns = self.problem.burn_margins(lin.iterate.burns)
        by_burn = {name: Margins(self.problem.burn_nodes, m) for name, m in burns.items()}
        return by_burn | self.rows.margins(lin)

    def violations(self, lin: Linearisation) -> dict[str, Array]:
        """What the buffers would have to hold, by constraint name; the defects are `dynamics`."""
        return {name: np.maximum(amount, 0.0) for name, amount in self._signed(lin).items()}

    def worst_violation(self, lin: Linearisation) -> float:
        """The largest of all violations and defects."""
        return max(float(amount.max(initial=0.0)) for amount in self.violations(lin).values())

    def _signed(self, lin: Linearisation) -> dict[str, Array]:
        """Violations, negative where there is room; defects by their size."""
        if self._seen is None or self._seen[0] is not lin:
            burns = lin.iterate.burns
            toward, away = (cone.inside(burns) for cone in self.problem.burn_cones)
            defects = lin.defects if self.problem.miss_weight is None else lin.defects[:-1]
            amounts = {
                "dynamics": np.abs(defects).ravel(),
                "dv_max": -self.problem.burn_margins(burns)["dv_max"],
                "dv_battery": np.concatenate([toward, away]),
            }
            rows = self.rows.margins(lin).items()
            self._seen = lin, amounts | {name: -row.margin for name, row in rows}
        return self._seen[1]
