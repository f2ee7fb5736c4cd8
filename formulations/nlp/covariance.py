"""Represent the covariance as unknowns of an NLP: all entries, or the unique ones.

    Sigma_{k+1} = A_k Sigma_k A_k' + B C(dv_i) C(dv_i)' B'

with the columns C of a burn's errors (`execution_errors`, here over CasADi's symbols). Either form
has a vector of entries at each node, after the burn if one falls on the node, and keeps the columns
that all burns share as columns. An arc carries the entries, and a burn adds its `kick`.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from formulations.arrays import Array
from formulations.problem.execution_errors import ComponentwiseErrors, ExecutionErrors, GatesErrors
from formulations.problem.flyby import FlybyProblem

GUARD = 1e-16
"""Added under every root, so that its derivative exists at zero. It moves a norm x by 5e-17 / x, in
units of the problem, and never by more than 1e-8."""
CERTAIN = 1e-6
"""Largest standard deviation that counts as a certain initial state."""


def root(square: ca.MX) -> ca.MX:
    """Square root whose derivative at zero is finite."""
    return ca.sqrt(square + GUARD)


class Covariance:
    """Sigma by entries: all 36 in the problem's units, as printed; or the 21 unique ones, scaled.

    The unique entries are divided by the square of `initial_deviation`. Only feasibility keeps an
    iterate positive semidefinite.
    """

    def __init__(self, problem: FlybyProblem, *, printed: bool) -> None:
        self._errors = problem.execution_errors
        self._unit = 1.0 if printed else initial_deviation(problem)
        self._shared, self._initial_columns = self._errors.shared, problem.initial_factor.shape[1]
        # Entry of each element, and the element that each entry is read from.
        self._entry = np.arange(36).reshape(6, 6)
        self._element = np.divmod(np.arange(36), 6)
        if not printed:
            self._element = np.triu_indices(6)
            self._entry[self._element] = np.arange(21)
            self._entry.T[self._element] = np.arange(21)

    @property
    def size(self) -> int:
        """Number of entries, the same at all nodes; six more per shared column."""
        return len(self._element[0]) + 6 * self._shared

    def carry(self, stm: ca.SX, entries: ca.SX) -> ca.SX:
        """Entries at the end of an arc with an STM A: of A Sigma A', and A times shared columns."""
        before = ca.reshape(entries[self._entry.ravel().tolist()], 6, 6).T
        after = stm @ before @ stm.T
        carried = (after[int(i), int(j)] for i, j in zip(*self._element, strict=True))
        shared = ca.reshape(entries[len(self._element[0]) :], 6, self._shared)
        return ca.vertcat(*carried, ca.vec(stm @ shared))

    def kick(self, burn: ca.MX) -> ca.MX:
        """What a burn (3,) adds: C C' in the velocity's part, and the shared columns."""
        added = own_covariance(self._errors, burn) / self._unit**2
        zero = ca.MX(1, 1)
        entries = [
            added[int(i) - 3, int(j) - 3] if min(i, j) >= 3 else zero
            for i, j in zip(*self._element, strict=True)
        ]
        shared = ca.vertcat(ca.MX(3, self._shared), shared_columns(self._errors, burn) / self._unit)
        return ca.vertcat(*entries, ca.vec(shared))

    def pack(self, factor: Array) -> Array:
        """Entries of a factor (6, c): of S S' of columns that burns do not share, then the shared."""
        first = self._initial_columns
        shared = factor[:, first : first + self._shared]
        covariance = factor @ factor.T - shared @ shared.T
        return np.r_[covariance[self._element] / self._unit**2, shared.T.ravel() / self._unit]

    def deviation(self, normal: Array, entries: ca.MX) -> ca.MX:
        """Standard deviations of the position along rows of `normal` (m, 3), shape (m,).

        Roots of a'Sigma a, in which the entries of the covariance are linear.
        """
        count = len(self._element[0])
        weights = np.zeros((len(normal), count))
        for i, j in np.ndindex(3, 3):
            weights[:, self._entry[i, j]] += normal[:, i] * normal[:, j]
        square = ca.sparsify(ca.DM(weights)) @ entries[:count]
        if self._shared:
            shared = ca.reshape(entries[count:], 6, self._shared)[:3, :]
            square += ca.sum2((ca.DM(normal) @ shared) ** 2)
        return root(self._unit**2 * square)


def initial_deviation(problem: FlybyProblem) -> float:
    """Largest standard deviation before the first burn: the natural unit of the entries' roots.

    If the initial state is certain, the deviation after the largest burn counts.
    """
    deviation = float(np.linalg.norm(problem.initial_factor, 2))
    if deviation > CERTAIN:
        return deviation
    largest = np.array([[problem.dv_max, 0.0, 0.0]])
    return max(float(np.linalg.norm(problem.execution_errors.columns(largest))), CERTAIN)


def shared_columns(errors: ExecutionErrors, burn: ca.MX) -> ca.MX:
    """Columns that burns share, of a burn (3,), shape (3, shared)."""
    if isinstance(errors, GatesErrors) and errors.shared:
        return errors.magnitude_bias * burn
    return ca.MX(3, 0)


def own_covariance(errors: ExecutionErrors, burn: ca.MX) -> ca.MX:
    """Covariance C C' of a burn's own columns, shape (3, 3), smooth where the burn (3,) vanishes.

    Raises:
        TypeError: if the errors are of a model without a nonlinear program.
    """
    if isinstance(errors, ComponentwiseErrors):
        return ca.diag((errors.fraction * burn) ** 2)
    if not isinstance(errors, GatesErrors):
        raise TypeError(f"no nonlinear program for {type(errors).__name__}")
    square, outer, eye = ca.dot(burn, burn), burn @ burn.T, ca.MX(np.eye(3))
    s, p = errors.magnitude_proportional, errors.pointing_proportional
    covariance = s**2 * outer + p**2 * (square * eye - outer)
    if not errors.affine:
        executed, points = errors.transitions(square)
        m, s, p = errors.fixed_bound, errors.magnitude_fixed, errors.pointing_fixed
        root = (m - points * square * (m - p)) * eye + points * (s - p) * outer
        covariance += executed * root @ root
    return covariance
