"""The burns' errors in the lifted form: what they add to the factors among the stacked states.

Where their columns are linear in the burns the derivative is a constant of the program, otherwise
parameters.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from formulations.problem.flyby import FlybyProblem, Iterate, Nodes
from formulations.problem.regions import Array


class LiftedErrors:
    """Columns C(dv) of the burns' errors in their rows of the stacked states.

    Args:
        problem: the burns and their errors.
        nodes: which of the program's nodes each burn falls on, shape (m,).
        first: state that the first node's factor begins at; each is stored row by row.
        columns: of the factors.
        last: node of the last factor.
        size: number of states.
    """

    def __init__(
        self, problem: FlybyProblem, nodes: Nodes, first: int, columns: int, last: int, size: int
    ) -> None:
        shared, every = problem.shared_columns, range(problem.n_burns)
        own = [problem.columns_of_burn(i) for i in every]
        filled = np.array([np.r_[shared, own[i]] for i in every], dtype=np.intp)[:, None]
        row = (6 * nodes[:, None] + 3 + np.arange(3))[..., None]
        self._kept = np.broadcast_to(
            (filled < columns) & (nodes <= last)[:, None, None], (len(nodes), 3, filled.shape[-1])
        )
        self._rows = (first + row * columns + filled)[self._kept]
        self._size, self._burns = size, problem.n_burns
        # Where no factor is carried, nothing is to be said of its derivative.
        self.affine = problem.execution_errors.affine or not self._kept.any()

    @property
    def places(self) -> tuple[Nodes, Nodes]:
        """Rows of the states, and burn components, that derivatives connect, in their order."""
        by = 3 * np.arange(self._burns)[:, None, None, None] + np.arange(3)
        by = np.broadcast_to(by, (*self._kept.shape, 3))[self._kept]
        return np.repeat(self._rows, 3), by.ravel()

    def derivative(self, problem: FlybyProblem, burns: Array) -> Array:
        """By the burns (m, 3), at `places`."""
        return problem.execution_errors.jacobian(burns)[self._kept].ravel()

    def constant(self, problem: FlybyProblem) -> sp.csr_array:
        """The derivative where it is the same everywhere, shape (states, 3 m)."""
        values, (rows, columns) = self.derivative(problem, np.zeros((self._burns, 3))), self.places
        filled = values != 0.0
        entries = values[filled], (rows[filled], columns[filled])
        return sp.csr_array(entries, shape=(self._size, 3 * self._burns))

    def remainder(self, problem: FlybyProblem, iterate: Iterate) -> Array:
        """Columns C less their derivative times the burns, shape (states,)."""
        errors, burns = problem.execution_errors, iterate.burns
        left = errors.columns(burns) - np.einsum("mikl,ml->mik", errors.jacobian(burns), burns)
        found = np.zeros(self._size)
        found[self._rows] = left[self._kept]
        return found
