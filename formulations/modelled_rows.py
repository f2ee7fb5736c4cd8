"""The state constraints of P3 and of P2 written in CVXPY.

Both speak about the matrix `outputs` with one row per component of the position at each used node
and columns (mean, factor columns): shape (3 n, 1) for P3 and (3 n, 1 + c) for P2.
"""

from __future__ import annotations

from typing import Protocol

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from formulations.lifting import Linearisation
from formulations.problem import StateConstraint
from formulations.rows import P2Rows, P3Rows, Rows


class ModelledRows(Protocol):
    """Constraints of a program."""

    @property
    def constraints(self) -> list[cp.Constraint]:
        """With a buffer in every row."""
        ...

    @property
    def buffers(self) -> cp.Expression:
        """The buffers, shape (count,)."""
        ...

    def update(self, lin: Linearisation) -> None:
        """Set the parameters for an iterate."""
        ...


def model_rows(rows: Rows, outputs: cp.Expression) -> ModelledRows:
    """The rows of either problem in CVXPY."""
    if isinstance(rows, P3Rows):
        return ModelledP3Rows(rows, outputs)
    assert isinstance(rows, P2Rows)
    return ModelledP2Rows(rows, outputs)


class ModelledP3Rows:
    """One second-order cone per keep-in node, one linear row per keep-out node."""

    def __init__(self, rows: P3Rows, outputs: cp.Expression) -> None:
        self._rows = rows
        self._planes: dict[str, tuple[cp.Parameter, cp.Parameter]] = {}
        self.constraints: list[cp.Constraint] = []
        buffers: list[cp.Expression] = [cp.Constant(np.zeros(0))]
        for c in rows.problem.constraints:
            first = 3 * np.searchsorted(rows.nodes, c.nodes)
            picked = (first[:, None] + np.arange(3)).ravel()
            indices, shape = (np.arange(len(picked)), picked), (len(picked), outputs.shape[0])
            pick = sp.csr_array((np.ones(len(picked)), indices), shape=shape)
            position = cp.reshape(pick @ outputs[:, 0], (len(c.nodes), 3), order="C")
            buffer = cp.Variable(len(c.nodes), nonneg=True)
            buffers.append(buffer)
            write = self._keep_in if c.keep == "in" else self._keep_out
            self.constraints.append(write(c, position, buffer))
        self.buffers = cp.hstack(buffers)

    def _keep_in(
        self, constraint: StateConstraint, position: cp.Expression, buffer: cp.Variable
    ) -> cp.Constraint:
        cone = constraint.region.second_order_cone
        offset = position - cone.origin
        blocks = sp.block_diag(list(cone.matrix), format="csr")
        stacked = blocks @ cp.reshape(offset, (offset.size,), order="C")
        bound = cp.sum(cp.multiply(cone.linear, offset), axis=1) + cone.constant
        return cp.SOC(bound + buffer, cp.reshape(stacked, offset.shape, order="C"), axis=1)

    def _keep_out(
        self, constraint: StateConstraint, position: cp.Expression, buffer: cp.Variable
    ) -> cp.Constraint:
        normal, offset = cp.Parameter(position.shape), cp.Parameter(position.shape[0])
        self._planes[constraint.name] = normal, offset
        return cp.sum(cp.multiply(normal, position), axis=1) >= offset - buffer

    def update(self, lin: Linearisation) -> None:
        """Move the supporting planes of keep-out sets to the iterate."""
        for c in self._rows.problem.constraints:
            if c.keep == "out":
                planes = c.region.supporting(lin.iterate.mean[c.nodes, :3])
                normal, offset = self._planes[c.name]
                normal.value, offset.value = planes.normal, planes.offset


class ModelledP2Rows:
    """All facets at once; normals, offsets and quantiles are constants."""

    def __init__(self, rows: P2Rows, outputs: cp.Expression) -> None:
        self.constraints: list[cp.Constraint] = []
        self.buffers: cp.Expression = cp.Constant(np.zeros(0))
        if rows.count:
            self.buffers = cp.Variable(rows.count, nonneg=True)
            bound = rows.carried.offset - rows.pick @ outputs[:, 0] + self.buffers
            weighted = sp.diags_array(rows.carried.quantile) @ rows.pick
            self.constraints = [cp.SOC(bound, weighted @ outputs[:, 1:], axis=1)]

    def update(self, lin: Linearisation) -> None:
        """Nothing depends on the iterate."""
