"""What a subproblem charges for violations and steps.

Violations v >= 0 are the buffers in the order of `MeritFunction.violations`, the miss m of the final
state is signed, the step s is that of the burns. The charges are

    exact      w (10 ||m||_1 + sum v)
    proximal   w (10 ||m||_1 + sum v) + p/2 ||s||^2
    augmented  l'(m, v) + w/2 ||(m, v)||^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from formulations.problem.regions import Array

Penalty = Literal["exact", "proximal", "augmented"]

DYNAMICS_WEIGHT = 10.0
"""Of the dynamics against a constraint, so that infeasible cases violate constraints, not physics."""


@dataclass(frozen=True)
class PenaltyParameters:
    """How much an iteration charges, nondimensional.

    Attributes:
        weight: w of violations.
        prox: p of the step, where it is proximal.
        multipliers: of (m, v), where it is augmented; shape (6 + rows,).
    """

    weight: float
    prox: float = 0.0
    multipliers: Array | None = None


def exact_value(defects: Array, violations: Array, weight: float) -> float:
    """The exact penalty of given defects and violations."""
    return weight * float(DYNAMICS_WEIGHT * np.abs(defects).sum() + violations.sum())


def augmented_value(charged: Array, charge: PenaltyParameters) -> float:
    """The augmented Lagrangian's charge for given (m, v), shape (6 + rows,)."""
    assert charge.multipliers is not None
    return float(charge.multipliers @ charged + 0.5 * charge.weight * (charged @ charged))
