"""A nonlinear program as CasADi expressions: unknowns, rows by constraint name, what each weighs.

Every row is a margin (>= 0 where satisfied) or a defect (== 0) in the units in which `Subproblem`
counts violations, so that one L1 penalty serves both sides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.sparse as sp

from formulations.problem.facets import Facets
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.problem.regions import Array


@dataclass(frozen=True)
class Arcs:
    """Flow map of the grid's arcs.

    Attributes:
        flow: CasADi function F(x, h) -> x_next that takes SX symbols; states (6,).
        durations: h of each arc, shape (n_nodes - 1,).
    """

    flow: ca.Function
    durations: Array


@dataclass(frozen=True)
class Start:
    """Initial guess: an iterate and, for P2, its covariance factor (n_nodes, 6, c)."""

    iterate: Iterate
    factor: Array | None = None


@dataclass(frozen=True)
class NlpRows:
    """Rows of one constraint: value >= 0, or value == 0 if `equality`.

    Attributes:
        name: as in `MeritFunction.violations`, or of the transcription's own.
        value: shape (m,).
        weight: of a unit of violation against the penalty; 0 keeps the rows hard.
        equality: whether the rows are defects instead of margins.
        price: of a unit of violation that is a part of the cost, with a penalty and without.
    """

    name: str
    value: ca.MX
    weight: float = 1.0
    equality: bool = False
    price: float | None = None


@dataclass(frozen=True)
class Mapped:
    """Nonlinear part of a program's leading rows that brings its own derivatives.

    Attributes:
        value: shape (m,).
        jacobian: sparse, shape (m, n).
        hessian: from multipliers (m,) to the upper triangle (n, n) of the Hessian of their product
            with the value.
    """

    value: ca.MX
    jacobian: ca.MX
    hessian: Callable[[ca.MX], ca.MX]


@dataclass(frozen=True)
class Program:
    """An NLP that is not yet bound to a penalty or a solver.

    Attributes:
        unknowns: symbol, shape (n,).
        start: initial values, shape (n,).
        burns: shape (3, m).
        mean: node means after the burns, shape (6, n_nodes).
        cost: total delta-v.
        blocks: the constraints.
        mapped: what to add to the values of the leading blocks.
    """

    unknowns: ca.MX
    start: Array
    burns: ca.MX
    mean: ca.MX
    cost: ca.MX
    blocks: tuple[NlpRows, ...]
    mapped: Mapped | None = None

    @property
    def smooth(self) -> ca.MX:
        """All rows but for what `mapped` adds, which is what CasADi differentiates."""
        return ca.vertcat(*(block.value for block in self.blocks))

    @property
    def rows(self) -> ca.MX:
        """All rows."""
        smooth = self.smooth
        return smooth if self.mapped is None else smooth + _padded(self.mapped.value, smooth)

    def iterate(self, point: Array) -> Iterate:
        """Burns and means at values of the unknowns."""
        burns, mean = ca.Function("iterate", [self.unknowns], [self.burns, self.mean])(point)
        return Iterate(np.array(burns).T, np.array(mean).T)

    def residuals(self, point: Array) -> dict[str, Array]:
        """Rows by constraint name at values of the unknowns."""
        values = np.array(ca.Function("residuals", [self.unknowns], [self.rows])(point)).ravel()
        ends = np.cumsum([block.value.numel() for block in self.blocks])
        parts = np.split(values, ends[:-1])
        return {block.name: part for block, part in zip(self.blocks, parts, strict=True)}


Transcription = Callable[[FlybyProblem, Arcs, Facets | None, Start, bool], Program]
"""From (problem, arcs, facets of P2 or None for P3, start, whether violations will be weighed)."""


@dataclass(frozen=True)
class Assembled:
    """A program with its penalty, as `nlpsol` wants it.

    Attributes:
        unknowns: the program's and, with a penalty, one slack >= 0 per elastic row (two if == 0).
        objective: total delta-v plus penalty.
        rows: all constraints, shape (m,), bounded below by 0.
        rows_upper: 0 or infinity, shape (m,).
        lower: bounds of the unknowns, shape (n,).
        start: initial values, shape (n,).
        jacobian: of the rows, or None to leave it to CasADi.
        hessian: from the factors of objective and rows to the upper triangle of the Lagrangian's
            Hessian, or None likewise.
    """

    unknowns: ca.MX
    objective: ca.MX
    rows: ca.MX
    rows_upper: Array
    lower: Array
    start: Array
    jacobian: ca.MX | None
    hessian: Callable[[ca.MX, ca.MX], ca.MX] | None


def assemble(program: Program, penalty: float | None) -> Assembled:
    """Stack the blocks; with a penalty w the objective is cost + w sum(weight * violation).

    Violations that have a price are weighed by it in any case.
    """
    counts = [block.value.numel() for block in program.blocks]
    equality = np.repeat([block.equality for block in program.blocks], counts)
    each = [b.weight * (penalty or 0.0) if b.price is None else b.price for b in program.blocks]
    prices = np.repeat(each, counts)
    # A slack fills what a row lacks; a second one empties what an equation has too much.
    row = np.r_[np.flatnonzero(prices), np.flatnonzero(prices * equality)]
    sign = np.ones(len(row))
    sign[np.count_nonzero(prices) :] = -1.0
    give = sp.csc_array((sign, (row, np.arange(len(row)))), shape=(len(prices), len(row)))
    slack = ca.MX.sym("slack", len(row))
    unknowns = ca.vertcat(program.unknowns, slack)
    objective = program.cost + ca.dot(prices[row], slack)
    smooth = program.smooth + ca.DM(sp.csc_matrix(give)) @ slack
    residual = np.concatenate(list(program.residuals(program.start).values()))
    mapped = program.mapped
    jacobian, hessian, rows = None, None, smooth
    if mapped is not None:
        rows = smooth + _padded(mapped.value, smooth)
        jacobian = ca.jacobian(smooth, unknowns) + _padded(mapped.jacobian, smooth, unknowns)

        def hessian(of_objective: ca.MX, of_rows: ca.MX) -> ca.MX:
            lagrangian = of_objective * objective + ca.dot(of_rows, smooth)
            own = mapped.hessian(of_rows[: mapped.value.numel()])
            rest = ca.triu(ca.hessian(lagrangian, unknowns)[0])
            return rest + _padded(own, unknowns, unknowns)

    return Assembled(
        unknowns=unknowns,
        objective=objective,
        rows=rows,
        rows_upper=np.where(equality, 0.0, np.inf),
        lower=np.r_[np.full(program.unknowns.numel(), -np.inf), np.zeros(len(row))],
        start=np.r_[program.start, np.maximum(-sign * residual[row], 0.0)],
        jacobian=jacobian,
        hessian=hessian,
    )


def _padded(matrix: ca.MX, rows: ca.MX, columns: ca.MX | None = None) -> ca.MX:
    """The matrix with structural zeros below and to the right, as many as the vectors are long."""
    width = matrix.shape[1] if columns is None else columns.numel()
    padded = ca.horzcat(matrix, ca.MX(matrix.shape[0], width - matrix.shape[1]))
    return ca.vertcat(padded, ca.MX(rows.numel() - matrix.shape[0], width))
