"""The state constraints of P3 and of P2 where positions and factors are variables of the program.

Both speak about the matrix `outputs` with one row per component of the position at each used node
and columns (mean, factor columns): shape (3 n, 1) for P3 and (3 n, 1 + c) for P2.
"""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import StateConstraint
from formulations.program.model import Values
from formulations.rows.chance import ChanceRows
from formulations.rows.cones import Rows
from formulations.rows.deterministic import DeterministicRows


def write_rows(
    rows: Rows, outputs: cp.Expression
) -> tuple[list[cp.Expression], dict[str, cp.Parameter]]:
    """The y of `model`, one block a kind of row; and the parameters of keep-out planes."""
    if isinstance(rows, ChanceRows):
        return _chance_rows(rows, outputs), {}
    assert isinstance(rows, DeterministicRows)
    return _deterministic_rows(rows, outputs)


def keep_out_values(rows: Rows, lin: Linearisation) -> Values:
    """The supporting planes of keep-out sets at an iterate, where the rows are deterministic."""
    values: Values = {}
    if isinstance(rows, DeterministicRows):
        for c in rows.problem.constraints:
            if c.keep == "out":
                planes = c.region.supporting(lin.iterate.mean[c.nodes, :3])
                values |= {f"{c.name} normal": planes.normal, f"{c.name} offset": planes.offset}
    return values


def _chance_rows(rows: ChanceRows, outputs: cp.Expression) -> list[cp.Expression]:
    """All facets at once; normals, offsets and quantiles are constants."""
    if rows.count == 0:
        return []
    room = rows.carried.offset - rows.pick @ outputs[:, 0]
    weighted = sp.diags_array(rows.carried.quantile) @ rows.pick
    return [cp.hstack([cp.reshape(room, (rows.count, 1), order="C"), weighted @ outputs[:, 1:]])]


def _deterministic_rows(
    rows: DeterministicRows, outputs: cp.Expression
) -> tuple[list[cp.Expression], dict[str, cp.Parameter]]:
    """One second-order cone per keep-in node, one linear row per keep-out node."""
    written: list[cp.Expression] = []
    parameters: dict[str, cp.Parameter] = {}
    for c in rows.problem.constraints:
        first = 3 * np.searchsorted(rows.nodes, c.nodes)
        picked = (first[:, None] + np.arange(3)).ravel()
        indices, shape = (np.arange(len(picked)), picked), (len(picked), outputs.shape[0])
        pick = sp.csr_array((np.ones(len(picked)), indices), shape=shape)
        position = cp.reshape(pick @ outputs[:, 0], (len(c.nodes), 3), order="C")
        if c.keep == "in":
            written.append(_keep_in(c, position))
            continue
        normal, offset = cp.Parameter(position.shape), cp.Parameter(len(c.nodes))
        parameters |= {f"{c.name} normal": normal, f"{c.name} offset": offset}
        room = cp.sum(cp.multiply(normal, position), axis=1) - offset
        written.append(cp.reshape(room, (len(c.nodes), 1), order="C"))
    return written, parameters


def _keep_in(constraint: StateConstraint, position: cp.Expression) -> cp.Expression:
    cone = constraint.region.second_order_cone
    n = len(constraint.nodes)
    offset = position - cone.origin
    blocks = sp.block_diag(list(cone.matrix), format="csr")
    across = cp.reshape(blocks @ cp.reshape(offset, (3 * n,), order="C"), (n, 3), order="C")
    along = cp.sum(cp.multiply(cone.linear, offset), axis=1) + cone.constant
    return cp.hstack([cp.reshape(along, (n, 1), order="C"), across])
