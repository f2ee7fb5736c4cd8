"""A condensed subproblem handed to a conic solver as it is, without a modelling layer.

The same program as `modelled` writes in CVXPY, in the variables

    z   burns, 3 m              t   their sizes, m
    a   |miss|, or the miss, 6  v   violations: of dv_max, m; of the battery's cones, 2 m; of the rows
    s   the sum of squares that a penalty charges, if it does: as a cone, because as a quadratic
        objective it keeps the solvers short of their tolerances

Every constraint says that an affine function of them lies in a cone. As long as the same rows are in
the program its sparsity does not change, so that an iteration fills in numbers and the solver keeps its
symbolic factorisation. Rows far from binding are left out: the answer is checked against all of them,
and solved again with those that it misses, so that it is the whole program's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from time import perf_counter
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from formulations.condensations import CONDENSATIONS
from formulations.interior_point import ConeProgram, Recovering
from formulations.lifting import Linearisation, LinearisationError, final_state_map
from formulations.penalty import DYNAMICS_WEIGHT, Charge, Penalty
from formulations.problem import FlybyProblem
from formulations.regions import Array
from formulations.rows import Cones, Rows
from formulations.subproblem import Step, Subproblem, SubproblemError

Indices = npt.NDArray[np.intp]

NEAR = 0.002
"""Room, in units of length, up to which a row takes part from the start; see `DirectSubproblem`."""

SHRINK, FEW = 1.5, 20
"""Rows that take part are dropped when there are so many more than near ones: it costs a new solver."""

MISSED = 1e-9
"""Violation of a row that takes no part at which it has to: the conic solver's own tolerance."""


class Block(NamedTuple):
    """Rows sum_k values[r, k] x[columns[r, k]] + constants[r], in cones of a dimension.

    Attributes:
        columns: shape (r, k) or (k,) for all rows alike; -1 where there is no entry.
        values: shape (r, k) or (k,) for all rows alike.
        constants: shape (r,).
        dimension: of the second-order cones; 1 for the non-negative and 0 for the zero cone.
        sparse: whether some columns are -1.
    """

    columns: Indices
    values: Array
    constants: Array
    dimension: int
    sparse: bool = False


class DirectSubproblem(Subproblem):
    """A condensed formulation of P3 or P2 around an iterate.

    Args:
        problem: the flyby problem.
        rows: its state constraints, those of P3 or of P2.
        formulation: a key of `CONDENSATIONS`.
        solver: a key of `interior_point.SOLVERS`.
        penalty: how violations and steps are charged.
    """

    def __init__(
        self,
        problem: FlybyProblem,
        rows: Rows,
        formulation: str = "condensed",
        solver: str = "CLARABEL",
        penalty: Penalty = "exact",
    ) -> None:
        super().__init__(problem, rows)
        self._condense, self._penalty, self._name = CONDENSATIONS[formulation], penalty, solver
        self._choose(np.zeros(rows.count, dtype=np.bool_))

    def _choose(self, active: npt.NDArray[np.bool_]) -> None:
        """Lay out the program with some of the rows; the solver starts anew."""
        m = self.problem.n_burns
        self._pattern: _Pattern | None = None
        self._active, self._place = active, np.cumsum(active) - 1
        squares = 0 if self._penalty == "exact" else 1
        ends = np.cumsum([3 * m, m, 6, 3 * m + int(active.sum()), squares])
        self._z, self._t, self._a, self._v, self._s = (
            np.arange(first, last) for first, last in zip([0, *ends], ends, strict=False)
        )
        self._solver = Recovering(self._name)

    def update(self, lin: Linearisation) -> None:
        """Convexify at an iterate. Raises as `Subproblem.update` does."""
        try:
            s = self._condense(lin, self.rows.nodes, factor=self.rows.with_factor)
        except LinearisationError as error:
            raise SubproblemError(str(error)) from error
        self._burns, self._cones = lin.iterate.burns, self.rows.cones(lin, s)
        constant, jacobian = final_state_map(lin)
        self._miss = constant - self.problem.final_state, jacobian
        near = self._slack(lin.iterate.burns) < NEAR
        if np.any(near & ~self._active):
            self._choose(near | self._active)
        elif self._active.sum() > SHRINK * near.sum() + FEW:
            self._choose(near)

    def solve(self, radius: float, charge: float | Charge) -> Step:
        """See `Subproblem.solve`."""
        start, solver_s = perf_counter(), 0.0
        charge = charge if isinstance(charge, Charge) else Charge(charge)
        while True:
            step = self._attempt(radius, charge)
            solver_s += step.solver_s
            slack = self._slack(step.burns)
            if not np.any(~self._active & (slack < -MISSED)):
                break
            self._choose(self._active | (slack < max(NEAR, -MISSED)))
        return replace(step, solver_s=solver_s, canonicalise_s=perf_counter() - start - solver_s)

    def _attempt(self, radius: float, charge: Charge) -> Step:
        """Solve with the rows that are in the program."""
        blocks = sorted(self._blocks(radius), key=lambda block: block.dimension)
        if self._pattern is None:
            self._pattern = _Pattern(blocks, self._variables)
        cost = self._cost(charge)
        program = self._pattern.program(blocks, cost)
        try:
            answer = self._solver.solve(program)
        except ValueError as error:
            raise SubproblemError(str(error)) from error
        x = answer.x
        if self._penalty == "proximal":  # whose charge for the step is no part of the merit
            cost[self._s] = 0.0
        burns = x[self._z].reshape(-1, 3)
        return Step(burns, float(cost @ x), answer.solver_s, 0.0, answer.accurate)

    def _slack(self, burns: Array) -> Array:
        """Room that the model leaves in every row, >= 0 where it is satisfied, shape (rows,)."""
        slack = np.empty(self.rows.count)
        for cones in self._cones:
            y = cones.values @ burns.ravel()[: cones.values.shape[2]] + cones.constants
            slack[cones.rows] = y[:, 0] - np.linalg.norm(y[:, 1:], axis=1)
        return slack

    @property
    def _variables(self) -> int:
        return int(self._v[-1]) + 1 + len(self._s)

    def _cost(self, charge: Charge) -> Array:
        """The objective's coefficients."""
        cost = np.zeros(self._variables)
        cost[self._t] = 1.0
        if self._penalty == "augmented":
            limits = 6 + 3 * self.problem.n_burns
            assert charge.multipliers is not None
            rows = charge.multipliers[limits:][self._active]
            cost[self._a[0] : self._v[-1] + 1] = np.r_[charge.multipliers[:limits], rows]
            cost[self._s] = 0.5 * charge.weight
            return cost
        cost[self._a], cost[self._v] = DYNAMICS_WEIGHT * charge.weight, charge.weight
        cost[self._s] = 0.5 * charge.prox
        return cost

    def _blocks(self, radius: float) -> Iterator[Block]:
        """The constraints, convexified at the iterate."""
        problem, z, v = self.problem, self._z, self._v
        m = problem.n_burns
        at, one = self._burns.ravel(), np.ones(1)
        yield Block(z[:, None], -one, radius + at, 1)
        yield Block(z[:, None], one, radius - at, 1)
        size = np.stack([self._t, v[:m]], axis=1)
        yield Block(size, np.array([-1.0, 1.0]), np.full(m, problem.dv_max), 1)
        normals = self.burn_planes(self._burns, radius).reshape(-1, 3)
        column = np.concatenate([np.tile(z.reshape(m, 3), (2, 1)), v[m : 3 * m, None]], axis=1)
        values = np.concatenate([normals, np.ones((2 * m, 1))], axis=1)
        yield Block(column, values, np.zeros(2 * m), 1)
        yield Block(v[:, None], one, np.zeros(len(v)), 1)
        yield from self._miss_blocks()
        # (t, z) of each burn; then the rows.
        columns = np.concatenate([self._t[:, None], z.reshape(m, 3)], axis=1)
        yield Block(columns.reshape(-1, 1), one, np.zeros(4 * m), 4)
        for cones in self._cones:
            yield self._row_block(cones)
        if self._penalty == "proximal":
            yield self._square_block(z, at)
        if self._penalty == "augmented":
            charged = np.concatenate([self._a, v])
            yield self._square_block(charged, np.zeros(len(charged)))

    def _miss_blocks(self) -> Iterator[Block]:
        constant, jacobian = self._miss
        columns = np.concatenate([np.tile(self._z, (6, 1)), self._a[:, None]], axis=1)
        if self._penalty == "augmented":
            yield Block(columns, np.hstack([jacobian, -np.ones((6, 1))]), constant, 0)
            return
        for sign in (1.0, -1.0):
            values = np.hstack([sign * jacobian, np.ones((6, 1))])
            yield Block(columns, values, sign * constant, 1)

    def _square_block(self, columns: Indices, centre: Array) -> Block:
        """||x - centre||^2 <= s  as  (1 + s, 1 - s, 2 (x - centre)) in a second-order cone."""
        column = np.concatenate([self._s, self._s, columns])[:, None]
        values = np.concatenate([[1.0, -1.0], np.full(len(columns), 2.0)])[:, None]
        constants = np.concatenate([[1.0, 1.0], -2.0 * centre])
        return Block(column, values, constants, len(constants))

    def _row_block(self, cones: Cones) -> Block:
        chosen = self._active[cones.rows]
        values, constants = cones.values[chosen], cones.constants[chosen]
        n, d, p = values.shape
        columns = np.full((n, d, p + 1), -1)
        columns[:, :, :p] = self._z[:p]
        columns[:, 0, p] = self._v[3 * self.problem.n_burns + self._place[cones.rows[chosen]]]
        if cones.triangular:
            row, column = np.tril_indices(d - 1, -1, p)
            columns[:, 1 + row, column] = -1
        values = np.concatenate([values, np.ones((n, d, 1))], axis=2)
        columns, values = columns.reshape(n * d, p + 1), values.reshape(n * d, p + 1)
        return Block(columns, values, constants.ravel(), d, sparse=True)


class _Pattern:
    """The constant sparsity of a program whose blocks come in order of their dimension."""

    def __init__(self, blocks: list[Block], variables: int) -> None:
        rows, columns, self._present = [], [], []
        first = 0
        for block in blocks:
            shape = len(block.constants), block.columns.shape[-1]
            column = np.broadcast_to(block.columns, shape)
            present = column >= 0
            rows.append(first + np.nonzero(present)[0])
            columns.append(column[present])
            self._present.append(present)
            first += len(block.constants)
        row, column = np.concatenate(rows), np.concatenate(columns)
        self._order = np.lexsort((row, column))
        starts = np.searchsorted(column[self._order], np.arange(variables + 1))
        indices = row[self._order].astype(np.int32), starts.astype(np.int32)
        self._matrix = sp.csc_array((np.zeros(len(row)), *indices), shape=(first, variables))
        count = {dim: sum(len(b.constants) for b in blocks if b.dimension == dim) for dim in (0, 1)}
        self._zero, self._nonnegative = count[0], count[1]
        self._second_order = tuple(
            dim
            for dim, size in ((b.dimension, len(b.constants)) for b in blocks)
            if dim > 1
            for _ in range(size // dim)
        )

    def program(self, blocks: list[Block], cost: Array) -> ConeProgram:
        """Fill in the numbers: a program's matrix is its own until the next one is made."""
        values = []
        for block, present in zip(blocks, self._present, strict=True):
            every = np.broadcast_to(block.values, present.shape)
            values.append(every[present] if block.sparse else every.ravel())
        self._matrix.data = -np.concatenate(values)[self._order]
        return ConeProgram(
            cost,
            self._matrix,
            np.concatenate([block.constants for block in blocks]),
            self._zero,
            self._nonnegative,
            self._second_order,
        )
