"""Rows of a convex subproblem: the state constraints of P3 and of P2, over positions and factors.

Both speak about the matrix `outputs` with one row per component of the position at each used node
and columns (mean, factor columns): shape (3 n, 1) for P3 and (3 n, 1 + c) for P2.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import cvxpy as cp
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from formulations.facets import Facets
from formulations.lifting import Linearisation
from formulations.problem import FlybyProblem, Nodes, StateConstraint
from formulations.regions import Array


class Margins(NamedTuple):
    """Margins of one constraint's rows (>= 0 where satisfied) and the nodes they belong to."""

    nodes: Nodes
    margin: Array


class Rows(Protocol):
    """What a subproblem asks of its state constraints."""

    @property
    def nodes(self) -> Nodes:
        """Nodes whose outputs the rows use, ascending."""
        ...

    @property
    def with_factor(self) -> bool:
        """Whether the outputs carry the covariance factor."""
        ...

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margins by constraint name from the nonlinear mean and factor, never from the model."""
        ...

    def build(self, outputs: cp.Expression) -> tuple[list[cp.Constraint], cp.Expression]:
        """Constraints with buffers, and the buffers in the order of `margins`, shape (rows,)."""
        ...

    def update(self, lin: Linearisation) -> None:
        """Set the parameters for an iterate."""
        ...


class P3Rows:
    """Deterministic constraints: keep-in sets as cones, keep-out sets by their supporting plane.

    The plane that touches the region nearest to the iterate is its linearisation and an inner
    approximation of the complement at once.
    """

    with_factor = False

    def __init__(self, problem: FlybyProblem) -> None:
        self._constraints = problem.constraints
        used = [c.nodes for c in problem.constraints]
        self.nodes = np.unique(np.concatenate(used)) if used else np.zeros(0, dtype=np.intp)
        self._planes: dict[str, tuple[cp.Parameter, cp.Parameter]] = {}

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Signed distances of the mean to the regions."""
        return {c.name: Margins(c.nodes, c.margin(lin.iterate.mean)) for c in self._constraints}

    def build(self, outputs: cp.Expression) -> tuple[list[cp.Constraint], cp.Expression]:
        """One second-order cone per keep-in node, one linear row per keep-out node."""
        constraints: list[cp.Constraint] = []
        buffers: list[cp.Expression] = []
        for c in self._constraints:
            first = 3 * np.searchsorted(self.nodes, c.nodes)
            picked = (first[:, None] + np.arange(3)).ravel()
            indices, shape = (np.arange(len(picked)), picked), (len(picked), outputs.shape[0])
            pick = sp.csr_array((np.ones(len(picked)), indices), shape=shape)
            position = cp.reshape(pick @ outputs[:, 0], (len(c.nodes), 3), order="C")
            buffer = cp.Variable(len(c.nodes), nonneg=True)
            buffers.append(buffer)
            rows = self._keep_in if c.keep == "in" else self._keep_out
            constraints.append(rows(c, position, buffer))
        return constraints, cp.hstack(buffers) if buffers else cp.Constant(np.zeros(0))

    def _keep_in(
        self, constraint: StateConstraint, position: cp.Expression, buffer: cp.Variable
    ) -> cp.Constraint:
        cone = constraint.region.second_order_cone()
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
        for c in self._constraints:
            if c.keep == "out":
                planes = c.region.supporting(lin.iterate.mean[c.nodes, :3])
                normal, offset = self._planes[c.name]
                normal.value, offset.value = planes.normal, planes.offset


class P2Rows:
    """Chance constraints on fixed facets: a'mu + q ||S'a|| <= b + buffer, a second-order cone each.

    Normals, offsets and quantiles are constants, so that nothing here changes between iterations.

    Args:
        problem: names the constraints.
        facets: every facet; all of them count in `margins`.
        included: mask of the facets that the convex program carries, shape (m,).
    """

    with_factor = True

    def __init__(
        self, problem: FlybyProblem, facets: Facets, included: npt.NDArray[np.bool_]
    ) -> None:
        self._names = [c.name for c in problem.constraints]
        self.facets = facets
        self.included = included
        self.nodes = np.unique(facets.node[included])

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """B - a'mu - q ||S'a|| of the included facets."""
        margin = self.facets.margin(lin.iterate.mean, lin.factor)
        rows = [(self.facets.constraint == i) & self.included for i in range(len(self._names))]
        return {
            name: Margins(self.facets.node[row], margin[row])
            for name, row in zip(self._names, rows, strict=True)
        }

    def missed(self, lin: Linearisation, tolerance: float) -> npt.NDArray[np.bool_]:
        """Facets left out of the program that the iterate violates by more than `tolerance`."""
        margin = self.facets.margin(lin.iterate.mean, lin.factor)
        return ~self.included & (margin < -tolerance)

    def build(self, outputs: cp.Expression) -> tuple[list[cp.Constraint], cp.Expression]:
        """All facets at once: a constant sparse matrix picks a'mu and a'S from the outputs."""
        m = int(self.included.sum())
        if m == 0:
            return [], cp.Constant(np.zeros(0))
        normal, node = self.facets.normal[self.included], self.facets.node[self.included]
        columns = 3 * np.searchsorted(self.nodes, node)[:, None] + np.arange(3)
        indices = np.repeat(np.arange(m), 3), columns.ravel()
        pick = sp.csr_array((normal.ravel(), indices), shape=(m, outputs.shape[0]))
        weighted = sp.diags_array(self.facets.quantile[self.included]) @ pick
        buffer = cp.Variable(m, nonneg=True)
        bound = self.facets.offset[self.included] - pick @ outputs[:, 0] + buffer
        return [cp.SOC(bound, weighted @ outputs[:, 1:], axis=1)], buffer

    def update(self, lin: Linearisation) -> None:
        """Nothing depends on the iterate."""
