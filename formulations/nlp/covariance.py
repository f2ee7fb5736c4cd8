"""The covariance as unknowns of an NLP: all its entries, the unique ones, or a factor.

    Sigma_{k+1} = A_k Sigma_k A_k' + beta^2 B diag(dv_i)^2 B'
    S_{k+1} = [A_k S_k, beta B diag(dv_i)]

Every form is a vector of entries per node, after the burn where one falls on it. An arc carries the
entries; a burn appends zeros where the form grows by it, and adds its `kick`.
"""

from __future__ import annotations

from typing import Protocol

import casadi as ca
import numpy as np

from formulations.problem.flyby import FlybyProblem
from formulations.problem.regions import Array

GUARD = 1e-16
"""Added under every root, so that its derivative exists at zero. It moves a norm x by 5e-17 / x, in
units of the problem, and never by more than 1e-8."""


def root(square: ca.MX) -> ca.MX:
    """Guarded square root."""
    return ca.sqrt(square + GUARD)


class Spread(Protocol):
    """One form of the covariance at a node."""

    def size(self, burns: int) -> int:
        """Number of entries at a node, that many burns at or before it."""
        ...

    def carry(self, stm: ca.SX, entries: ca.SX) -> ca.SX:
        """Entries at the end of an arc with that STM (6, 6)."""
        ...

    def kick(self, burn: ca.MX, burns: int) -> ca.MX:
        """What a burn (3,) adds to the entries of its node, which has that many burns before it."""
        ...

    def pack(self, factor: Array, burns: int) -> Array:
        """Entries from a factor (6, c) whose columns of later burns are zero."""
        ...

    def deviation(self, normal: Array, entries: ca.MX) -> ca.MX:
        """Standard deviations of the position along the rows of `normal` (m, 3), shape (m,)."""
        ...


class Covariance:
    """Sigma by entries, the 36 that the paper writes or the 21 that are different.

    Nothing but feasibility keeps an iterate of it positive semidefinite.

    Args:
        problem: gives the execution error.
        unique: whether the entries above the diagonal stand for those below.
        unit: of a standard deviation.
    """

    def __init__(self, problem: FlybyProblem, *, unique: bool, unit: float = 1.0) -> None:
        self._error, self._unit = problem.execution_error, unit
        # Entry of each element, and the element that each entry is read from.
        self._entry = np.arange(36).reshape(6, 6)
        self._element = np.divmod(np.arange(36), 6)
        if unique:
            self._element = np.triu_indices(6)
            self._entry[self._element] = np.arange(21)
            self._entry.T[self._element] = np.arange(21)

    def size(self, burns: int) -> int:  # noqa: ARG002 -- of the protocol
        """All the same."""
        return len(self._element[0])

    def carry(self, stm: ca.SX, entries: ca.SX) -> ca.SX:
        """A Sigma A'."""
        before = ca.reshape(entries[self._entry.ravel().tolist()], 6, 6).T
        after = stm @ before @ stm.T
        return ca.vertcat(*(after[int(i), int(j)] for i, j in zip(*self._element, strict=True)))

    def kick(self, burn: ca.MX, burns: int) -> ca.MX:  # noqa: ARG002 -- of the protocol
        """Beta^2 dv^2 on the diagonal of the velocity."""
        diagonal = np.diag(self._entry)[3:]
        place = np.zeros((self.size(0), 3))
        place[diagonal, range(3)] = (self._error / self._unit) ** 2
        return ca.sparsify(ca.DM(place)) @ burn**2

    def pack(self, factor: Array, burns: int) -> Array:  # noqa: ARG002 -- of the protocol
        """S S'."""
        return (factor @ factor.T)[self._element] / self._unit**2

    def deviation(self, normal: Array, entries: ca.MX) -> ca.MX:
        """Root of a'Sigma a, in which the entries are linear."""
        weights = np.zeros((len(normal), self.size(0)))
        for i, j in np.ndindex(3, 3):
            weights[:, self._entry[i, j]] += normal[:, i] * normal[:, j]
        return root(self._unit**2 * (ca.sparsify(ca.DM(weights)) @ entries))


class Factor:
    """S by columns: the initial ones, and three per burn at or before the node.

    Args:
        problem: gives the execution error and the initial columns.
        unit: of the entries.
    """

    def __init__(self, problem: FlybyProblem, *, unit: float = 1.0) -> None:
        self._error, self._unit = problem.execution_error, unit
        self._initial_columns = problem.initial_factor.shape[1]

    def size(self, burns: int) -> int:
        """Six per column."""
        return 6 * (self._initial_columns + 3 * burns)

    def carry(self, stm: ca.SX, entries: ca.SX) -> ca.SX:
        """A S."""
        return ca.vec(stm @ ca.reshape(entries, 6, entries.numel() // 6))

    def kick(self, burn: ca.MX, burns: int) -> ca.MX:
        """Columns beta B diag(dv) after those that were there."""
        columns = ca.vertcat(ca.MX(3, 3), self._error / self._unit * ca.diag(burn))
        return ca.vertcat(ca.MX(self.size(burns), 1), ca.vec(columns))

    def pack(self, factor: Array, burns: int) -> Array:
        """Column by column."""
        return factor.T.ravel()[: self.size(burns)] / self._unit

    def deviation(self, normal: Array, entries: ca.MX) -> ca.MX:
        """||S'a||, in which the entries are convex."""
        position = ca.reshape(entries, 6, entries.numel() // 6)[:3, :]
        return root(self._unit**2 * ca.sum2((ca.DM(normal) @ position) ** 2))


CERTAIN = 1e-6
"""Largest standard deviation of a start without spread to speak of."""


def initial_deviation(problem: FlybyProblem) -> float:
    """Largest standard deviation before the first burn: the natural unit of a factor's entries.

    Where the start is certain, that of the largest burn.
    """
    deviation = float(np.linalg.norm(problem.initial_factor, 2))
    if deviation > CERTAIN:
        return deviation
    return max(problem.execution_error * problem.dv_max, CERTAIN)
