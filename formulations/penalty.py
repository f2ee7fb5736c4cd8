"""What a convex subproblem charges for violations and steps; a class for each kind of algorithm.

Violations v >= 0 are the buffers in the order of `Subproblem.violations`, the miss m of the final
state is signed, the step s is that of the burns. Only parameters change between iterations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import cvxpy as cp
import numpy as np

from formulations.regions import Array

DYNAMICS_WEIGHT = 10.0
"""Of the dynamics against a constraint, so that infeasible cases violate constraints, not physics."""


@dataclass(frozen=True)
class Charge:
    """How much an iteration charges, nondimensional.

    Attributes:
        weight: w of violations.
        prox: p of the step, for `Proximal`.
        multipliers: of (m, v), for `Augmented`; shape (6 + rows,).
    """

    weight: float
    prox: float = 0.0
    multipliers: Array | None = None


class Penalty(Protocol):
    """A charge as part of a program's objective."""

    @property
    def expression(self) -> cp.Expression:
        """Convex in the program's variables."""
        ...

    @property
    def constraints(self) -> list[cp.Constraint]:
        """What the expression needs."""
        ...

    def set(self, charge: Charge) -> None:
        """Set the parameters for an iteration."""
        ...


PenaltyFactory = Callable[[cp.Expression, cp.Expression, cp.Expression], Penalty]


class Exact:
    """Exact one-norm: w (10 ||m||_1 + sum v).

    Args:
        step: shape (m, 3).
        miss: shape (6,).
        violations: shape (rows,).
    """

    def __init__(self, step: cp.Expression, miss: cp.Expression, violations: cp.Expression) -> None:
        del step
        self._weight = cp.Parameter(nonneg=True)
        self.constraints: list[cp.Constraint] = []
        self.expression = self._weight * (DYNAMICS_WEIGHT * cp.norm1(miss) + cp.sum(violations))

    def set(self, charge: Charge) -> None:
        """Set w."""
        self._weight.value = charge.weight


class Proximal(Exact):
    """Exact one-norm and a soft trust region: + p/2 ||s||^2. Arguments as for `Exact`."""

    def __init__(self, step: cp.Expression, miss: cp.Expression, violations: cp.Expression) -> None:
        super().__init__(step, miss, violations)
        self._prox = cp.Parameter(nonneg=True)
        moved = cp.Variable(step.shape)  # by a parameter, which another one must not multiply
        self.constraints = [moved == step]
        self.expression += 0.5 * self._prox * cp.sum_squares(moved)

    def set(self, charge: Charge) -> None:
        """Set w and p."""
        super().set(charge)
        self._prox.value = charge.prox


class Augmented:
    """Augmented Lagrangian: l'(m, v) + w/2 ||(m, v)||^2. Arguments as for `Exact`."""

    def __init__(self, step: cp.Expression, miss: cp.Expression, violations: cp.Expression) -> None:
        del step
        charged = cp.hstack([miss, violations])
        self._weight = cp.Parameter(nonneg=True)
        self._multipliers = cp.Parameter(charged.size)
        self.constraints: list[cp.Constraint] = []
        quadratic = 0.5 * self._weight * cp.sum_squares(charged)
        self.expression = self._multipliers @ charged + quadratic

    def set(self, charge: Charge) -> None:
        """Set w and the multipliers."""
        self._weight.value, self._multipliers.value = charge.weight, charge.multipliers


PENALTIES: dict[str, PenaltyFactory] = {
    "exact": Exact,
    "proximal": Proximal,
    "augmented": Augmented,
}


def exact_value(defects: Array, violations: Array, weight: float) -> float:
    """The exact penalty of given defects and violations."""
    return weight * float(DYNAMICS_WEIGHT * np.abs(defects).sum() + violations.sum())


def augmented_value(charged: Array, charge: Charge) -> float:
    """The augmented Lagrangian's charge for given (m, v), shape (6 + rows,)."""
    assert charge.multipliers is not None
    return float(charge.multipliers @ charged + 0.5 * charge.weight * (charged @ charged))
