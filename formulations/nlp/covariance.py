"""Represent the covariance as unknowns of an NLP: all entries, the unique ones, or a factor.

    Sigma_{k+1} = A_k Sigma_k A_k' + B C(dv_i) C(dv_i)' B'
    S_{k+1} = [A_k S_k, B C(dv_i)]

with the columns C of a burn's errors (`execution_errors`, here over CasADi's symbols). Every form
has a vector of entries at each node, after the burn if one falls on the node. Every form keeps the
columns that all burns share as columns. An arc carries the entries. A burn appends zeros if the
form grows, and adds its `kick`.
"""

from __future__ import annotations

from typing import Protocol

import casadi as ca
import numpy as np

from formulations.arrays import Array
from formulations.problem.execution_errors import ComponentwiseErrors, ExecutionErrors, GatesErrors
from formulations.problem.flyby import FlybyProblem

GUARD = 1e-16
"""Added under every root, so that its derivative exists at zero. It moves a norm x by 5e-17 / x, in
units of the problem, and never by more than 1e-8."""
TINY = 1e-16
"""Added under the root of e^2 (see `GatesErrors`), which has a kink where a burn vanishes."""
CERTAIN = 1e-6
"""Largest standard deviation that counts as a certain initial state."""


def root(square: ca.MX) -> ca.MX:
    """Square root whose derivative at zero is finite."""
    return ca.sqrt(square + GUARD)


class CovarianceForm(Protocol):
    """A form of the covariance at a node."""

    def size(self, burns: int) -> int:
        """Number of entries at a node with that many burns at or before it."""

    def carry(self, stm: ca.SX, entries: ca.SX) -> ca.SX:
        """Entries at the end of an arc with that STM (6, 6)."""

    def kick(self, burn: ca.MX, burns: int) -> ca.MX:
        """Entries that a burn (3,) adds at its node, which has that many burns before it."""

    def pack(self, factor: Array, burns: int) -> Array:
        """Entries from a factor (6, c) whose columns of later burns are zero."""

    def deviation(self, normal: Array, entries: ca.MX) -> ca.MX:
        """Standard deviations of the position along the rows of `normal` (m, 3), shape (m,)."""


class Covariance:
    """Sigma by entries: all 36, as in the paper, or the 21 unique ones.

    Entries are in units of a standard deviation `unit`, squared. Only feasibility keeps an iterate
    positive semidefinite.
    """

    def __init__(self, problem: FlybyProblem, *, unique: bool, unit: float = 1.0) -> None:
        self._errors, self._unit = problem.execution_errors, unit
        self._shared, self._initial_columns = self._errors.shared, problem.initial_factor.shape[1]
        # Entry of each element, and the element that each entry is read from.
        self._entry = np.arange(36).reshape(6, 6)
        self._element = np.divmod(np.arange(36), 6)
        if unique:
            self._element = np.triu_indices(6)
            self._entry[self._element] = np.arange(21)
            self._entry.T[self._element] = np.arange(21)

    def size(self, burns: int) -> int:  # noqa: ARG002 -- of the protocol
        """Number of entries, the same at all nodes; six more per shared column."""
        return len(self._element[0]) + 6 * self._shared

    def carry(self, stm: ca.SX, entries: ca.SX) -> ca.SX:
        """Entries of A Sigma A', and A times shared columns."""
        before = ca.reshape(entries[self._entry.ravel().tolist()], 6, 6).T
        after = stm @ before @ stm.T
        carried = (after[int(i), int(j)] for i, j in zip(*self._element, strict=True))
        shared = ca.reshape(entries[len(self._element[0]) :], 6, self._shared)
        return ca.vertcat(*carried, ca.vec(stm @ shared))

    def kick(self, burn: ca.MX, burns: int) -> ca.MX:  # noqa: ARG002 -- of the protocol
        """C C' in the velocity's part, and the shared columns."""
        added = own_covariance(self._errors, burn) / self._unit**2
        zero = ca.MX(1, 1)
        entries = [
            added[int(i) - 3, int(j) - 3] if min(i, j) >= 3 else zero
            for i, j in zip(*self._element, strict=True)
        ]
        shared = ca.vertcat(ca.MX(3, self._shared), shared_columns(self._errors, burn) / self._unit)
        return ca.vertcat(*entries, ca.vec(shared))

    def pack(self, factor: Array, burns: int) -> Array:  # noqa: ARG002 -- of the protocol
        """Entries of S S' of the columns that burns do not share, then the shared columns."""
        first = self._initial_columns
        shared = factor[:, first : first + self._shared]
        covariance = factor @ factor.T - shared @ shared.T
        return np.r_[covariance[self._element] / self._unit**2, shared.T.ravel() / self._unit]

    def deviation(self, normal: Array, entries: ca.MX) -> ca.MX:
        """Root of a'Sigma a, in which the entries of the covariance are linear."""
        count = len(self._element[0])
        weights = np.zeros((len(normal), count))
        for i, j in np.ndindex(3, 3):
            weights[:, self._entry[i, j]] += normal[:, i] * normal[:, j]
        square = ca.sparsify(ca.DM(weights)) @ entries[:count]
        if self._shared:
            shared = ca.reshape(entries[count:], 6, self._shared)[:3, :]
            square += ca.sum2((ca.DM(normal) @ shared) ** 2)
        return root(self._unit**2 * square)


class Factor:
    """Factor S by columns: initial ones, those that burns share, each burn's at or before the node."""

    def __init__(self, problem: FlybyProblem, *, unit: float = 1.0) -> None:
        self._errors, self._unit = problem.execution_errors, unit
        self._columns = problem.columns_before
        self._before = problem.shared_columns.start

    def size(self, burns: int) -> int:
        """Number of entries: six per column."""
        return 6 * self._columns(burns)

    def carry(self, stm: ca.SX, entries: ca.SX) -> ca.SX:
        """Columns of A S."""
        return ca.vec(stm @ ca.reshape(entries, 6, entries.numel() // 6))

    def kick(self, burn: ca.MX, burns: int) -> ca.MX:
        """Own columns B C(dv) after the earlier ones; shared columns are added up."""
        shared, own = shared_columns(self._errors, burn), own_columns(self._errors, burn)
        between = self._columns(burns) - self._before - self._errors.shared
        columns = ca.horzcat(ca.MX(3, self._before), shared, ca.MX(3, between), own)
        return ca.vec(ca.vertcat(ca.MX(3, columns.shape[1]), columns)) / self._unit

    def pack(self, factor: Array, burns: int) -> Array:
        """Entries of the columns, one after the other."""
        return factor.T.ravel()[: self.size(burns)] / self._unit

    def deviation(self, normal: Array, entries: ca.MX) -> ca.MX:
        """Standard deviation ||S'a||, convex in the entries."""
        position = ca.reshape(entries, 6, entries.numel() // 6)[:3, :]
        return root(self._unit**2 * ca.sum2((ca.DM(normal) @ position) ** 2))


def initial_deviation(problem: FlybyProblem) -> float:
    """Largest standard deviation before the first burn: the natural unit of a factor's entries.

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


def own_columns(errors: ExecutionErrors, burn: ca.MX) -> ca.MX:
    """Columns of a burn (3,) alone, shape (3, own)."""
    if isinstance(errors, GatesErrors):
        parts = [errors.magnitude_proportional * burn, errors.pointing_proportional * ca.skew(burn)]
        if not errors.affine:
            executed, root = _fixed_part(errors, burn)
            parts += [ca.sqrt(executed + TINY) * root, ca.MX(3, 1)]
        return ca.horzcat(*parts)
    return _componentwise(errors).fraction * ca.diag(burn)


def own_covariance(errors: ExecutionErrors, burn: ca.MX) -> ca.MX:
    """Covariance C C' of a burn's own columns, shape (3, 3), smooth where the burn (3,) vanishes."""
    if isinstance(errors, GatesErrors):
        s, p, outer = errors.magnitude_proportional, errors.pointing_proportional, burn @ burn.T
        covariance = s**2 * outer + p**2 * (ca.dot(burn, burn) * ca.MX(np.eye(3)) - outer)
        if not errors.affine:
            executed, root = _fixed_part(errors, burn)
            covariance += executed * root @ root
        return covariance
    return ca.diag((_componentwise(errors).fraction * burn) ** 2)


def _fixed_part(errors: GatesErrors, burn: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Degree e^2 to which a burn counts as executed, and the root of its fixed part, (3, 3)."""
    square = ca.dot(burn, burn)
    executed, points = errors.transitions(square)
    m, s, p = errors.fixed_bound, errors.magnitude_fixed, errors.pointing_fixed
    isotropic = m - points * square * (m - p)
    return executed, isotropic * ca.MX(np.eye(3)) + points * (s - p) * (burn @ burn.T)


def _componentwise(errors: ExecutionErrors) -> ComponentwiseErrors:
    """The errors as the componentwise model.

    Raises:
        TypeError: if they are of a model without a nonlinear program.
    """
    if not isinstance(errors, ComponentwiseErrors):
        raise TypeError(f"no nonlinear program for {type(errors).__name__}")
    return errors
