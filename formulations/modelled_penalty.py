"""The charges for violations and steps in CVXPY. Only parameters change between iterations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import cvxpy as cp

from formulations.penalty import DYNAMICS_WEIGHT, Charge, Penalty


class ModelledPenalty(Protocol):
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


PenaltyFactory = Callable[[cp.Expression, cp.Expression, cp.Expression], ModelledPenalty]


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


PENALTIES: dict[Penalty, PenaltyFactory] = {
    "exact": Exact,
    "proximal": Proximal,
    "augmented": Augmented,
}
