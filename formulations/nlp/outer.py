"""Rows of a nonlinear program that are evaluated outside CasADi, with their derivatives.

IPOPT is given exact values and slopes of such rows at the burns, and no curvature: where they bind, it
converges as quasi-Newton methods do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from formulations.arrays import Array


class Outer(NamedTuple):
    """Names of k rows, and the function from burns (m, 3) to values (k,) and derivatives (k, 3 m)."""

    names: tuple[str, ...]
    rows: Callable[[Array], tuple[Array, Array]]


class OuterRows(ca.Callback):
    """Values (k,) of rows at burns (3, m), as CasADi calls them.

    CasADi holds no reference: whoever builds a solver with these rows keeps them as long as it.
    """

    def __init__(self, outer: Outer, burns: int) -> None:
        ca.Callback.__init__(self)
        self._rows, self._shape, self.count = outer.rows, (3, burns), len(outer.names)
        self._slopes = _Slopes(self, 3 * burns, self.count)
        self._last: tuple[bytes, tuple[Array, Array]] | None = None
        self.construct("outer", {})

    def get_sparsity_in(self, _: int) -> ca.Sparsity:
        """Of the burns."""
        return ca.Sparsity.dense(*self._shape)

    def get_sparsity_out(self, _: int) -> ca.Sparsity:
        """Of the values."""
        return ca.Sparsity.dense(self.count, 1)

    def at(self, burns: ca.DM) -> tuple[Array, Array]:
        """Values and derivatives; those of the last burns are kept."""
        given = np.array(burns)
        if self._last is None or self._last[0] != given.tobytes():
            self._last = given.tobytes(), self._rows(given.T)
        return self._last[1]

    def eval(self, arguments: Sequence[ca.DM]) -> list[Any]:
        """The values."""
        return [self.at(arguments[0])[0]]

    def has_jacobian(self) -> bool:
        """Yes."""
        return True

    def get_jacobian(self, *_: Any) -> ca.Function:
        """The function that gives the derivatives."""
        return self._slopes


class _Slopes(ca.Callback):
    """Derivatives (k, 3 m) of outer rows, whose own derivatives count as none."""

    def __init__(self, rows: OuterRows, unknowns: int, count: int) -> None:
        ca.Callback.__init__(self)
        self._rows, self._size = rows, (count, unknowns)
        self.construct("slopes", {})

    def get_n_in(self) -> int:
        """Burns and values."""
        return 2

    def get_sparsity_in(self, number: int) -> ca.Sparsity:
        """Of the burns, and of the values."""
        count, unknowns = self._size
        return ca.Sparsity.dense(count, 1) if number else ca.Sparsity.dense(3, unknowns // 3)

    def get_sparsity_out(self, _: int) -> ca.Sparsity:
        """Of the derivatives."""
        return ca.Sparsity.dense(*self._size)

    def eval(self, arguments: Sequence[ca.DM]) -> list[Any]:
        """The derivatives."""
        return [self._rows.at(arguments[0])[1]]

    def has_jacobian(self) -> bool:
        """Yes: none at all."""
        return True

    def get_jacobian(self, name: str, inames: Any, onames: Any, options: Any) -> ca.Function:
        """Structural zeros."""
        count, unknowns = self._size
        burns, values = ca.MX.sym("b", 3, unknowns // 3), ca.MX.sym("v", count)
        out = ca.MX.sym("o", ca.Sparsity(count, unknowns))
        zeros = [ca.MX(count * unknowns, size) for size in (unknowns, count)]
        return ca.Function(name, [burns, values, out], zeros, inames, onames, options)
