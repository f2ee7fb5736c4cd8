"""Condensed: mean and factor eliminated, the burns and the buffers remain.

As a model in CVXPY; `direct` has the same program without it.
"""

from __future__ import annotations

from typing import ClassVar

import cvxpy as cp
import numpy as np

from formulations.condensations import Condensation
from formulations.lifting import Linearisation, final_state_map
from formulations.problem import FlybyProblem, Nodes, factor_columns_used
from formulations.regions import Array


class Condensed:
    """Outputs and final state as affine functions of the burns; one dense parameter each.

    Args:
        problem: dimensions.
        burns: the burn variable, shape (m, 3).
        nodes: nodes whose outputs are wanted.
        with_factor: whether the outputs carry the covariance factor.
        condensation: how mean and factor are eliminated.
    """

    clarabel: ClassVar[dict[str, float]] = {}

    def __init__(
        self,
        problem: FlybyProblem,
        burns: cp.Variable,
        nodes: Nodes,
        with_factor: bool,
        condensation: Condensation,
    ) -> None:
        self._condense = condensation
        self._nodes, self._final = nodes, problem.final_state
        self._columns = factor_columns_used(problem, nodes) if with_factor else 0
        size = 3 * len(nodes) * (1 + self._columns)
        stacked = cp.reshape(burns, (burns.size,), order="C")
        self._jacobian = cp.Parameter((size, burns.size))
        self._constant = cp.Parameter(size)
        self.outputs = cp.Variable((3 * len(nodes), 1 + self._columns))
        self._final_jacobian = cp.Parameter((6, burns.size))
        self._final_constant = cp.Parameter(6)
        miss = cp.Variable(6)
        self.constraints: list[cp.Constraint] = [
            cp.reshape(self.outputs, (size,), order="C")
            == self._jacobian @ stacked + self._constant,
            miss == self._final_jacobian @ stacked + self._final_constant,
        ]
        self.virtual_control = miss

    def update(self, lin: Linearisation) -> None:
        """Set the parameters for an iterate."""
        s = self._condense(lin, self._nodes, factor=self._columns > 0)
        constant = self._stack(s.mean_constant[..., None], s.factor_constant)
        jacobian = self._stack(s.mean_jacobian[:, :, None], s.factor_jacobian)
        self._constant.value = constant.reshape(-1)
        self._jacobian.value = jacobian.reshape(-1, s.mean_jacobian.shape[-1])
        constant, self._final_jacobian.value = final_state_map(lin)
        self._final_constant.value = constant - self._final

    def _stack(self, mean: Array, factor: Array) -> Array:
        """Position rows of the used nodes with columns (mean, factor)."""
        return np.concatenate([mean[:, :3], factor[:, :3, : self._columns]], axis=2)
