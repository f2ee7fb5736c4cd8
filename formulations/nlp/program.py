"""Nonlinear programs as CasADi expressions: unknowns, rows by constraint name, weights and prices.

The rows are the limits on the burns, P3's sets or P2's facets. Every row is a margin (>= 0 where
satisfied) or a defect (== 0), in the units in which `Subproblem` counts violations, so that one L1
penalty serves both methods.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
import scipy.sparse as sp

from formulations.arrays import Array
from formulations.nlp.covariance import Covariance, root
from formulations.problem.facets import Facets
from formulations.problem.flyby import FlybyProblem, Iterate
from formulations.problem.regions import Ball, Cone, Region
from formulations.program.subproblem import DYNAMICS_WEIGHT


@dataclass(frozen=True)
class Arcs:
    """CasADi flow map F(x, h) -> x_next of states (6,), which takes SX symbols, and each arc's h.

    The h are rows of an array (n, k): the duration, then the numbers that time-dependent forces
    need. `by_parameters` is the derivative G(x, h), (6, p), of x_next by p uncertain parameters; None
    without any.
    """

    flow: ca.Function
    durations: Array
    by_parameters: ca.Function | None = None


@dataclass(frozen=True)
class Start:
    """Initial guess: an iterate and, for P2, its covariance factor (n_nodes, 6, c)."""

    iterate: Iterate
    factor: Array | None = None


@dataclass(frozen=True)
class NlpRows:
    """Rows of one constraint: value >= 0, or value == 0 if `equality`.

    Attributes:
        name: as in `MeritFunction.violations`, or the transcription's own.
        value: shape (m,).
        weight: of a unit of violation, times the penalty; 0 keeps the rows hard.
        equality: whether the rows are defects instead of margins.
        price: cost of a unit of violation, with or without a penalty.
    """

    name: str
    value: ca.MX
    weight: float = 1.0
    equality: bool = False
    price: float | None = None


@dataclass(frozen=True)
class Mapped:
    """Nonlinear part of a program's leading rows, with its own derivatives.

    The value has shape (m,), the sparse Jacobian (m, n); the Hessian maps multipliers (m,) to the upper
    triangle (n, n) of that of their product with the value.
    """

    value: ca.MX
    jacobian: ca.MX
    hessian: Callable[[ca.MX], ca.MX]


@dataclass(frozen=True)
class Program:
    """An NLP without penalty or solver.

    Attributes:
        unknowns: symbol, shape (n,).
        start: initial values, shape (n,).
        burns: shape (3, m).
        mean: node means after the burns, shape (6, n_nodes).
        cost: total delta-v.
        blocks: the constraints.
        mapped: addition to the values of the leading blocks.
        times: firing times where these are unknowns, shape (q,); else empty.
    """

    unknowns: ca.MX
    start: Array
    burns: ca.MX
    mean: ca.MX
    cost: ca.MX
    blocks: tuple[NlpRows, ...]
    mapped: Mapped | None = None
    times: ca.MX = field(default_factory=lambda: ca.MX(0, 1))

    @property
    def smooth(self) -> ca.MX:
        """All rows without the addition of `mapped`; CasADi differentiates these."""
        return ca.vertcat(*(block.value for block in self.blocks))

    @property
    def rows(self) -> ca.MX:
        """All rows."""
        smooth = self.smooth
        return smooth if self.mapped is None else smooth + _padded(self.mapped.value, smooth)

    def iterate(self, point: Array) -> Iterate:
        """Burns, means and firing times at values of the unknowns."""
        parts = [self.burns, self.mean, self.times]
        burns, mean, times = ca.Function("iterate", [self.unknowns], parts)(point)
        return Iterate(np.array(burns).T, np.array(mean).T, times=np.array(times).ravel())

    def residuals(self, point: Array) -> dict[str, Array]:
        """Rows by constraint name at values of the unknowns."""
        values = np.array(ca.Function("residuals", [self.unknowns], [self.rows])(point)).ravel()
        ends = np.cumsum([block.value.numel() for block in self.blocks])
        parts = np.split(values, ends[:-1])
        return {block.name: part for block, part in zip(self.blocks, parts, strict=True)}


Transcription = Callable[[FlybyProblem, Arcs, Facets | None, Start, bool], Program]
"""Makes a program of problem, arcs, facets (None for P3), start, and whether violations are weighed."""


@dataclass(frozen=True)
class Assembled:
    """A program with its penalty, in the form of `nlpsol`.

    Attributes:
        unknowns: the program's and, with a penalty, one slack >= 0 per elastic row (two if == 0).
        objective: total delta-v plus penalty.
        rows: all constraints, shape (m,), bounded below by 0.
        rows_upper: 0 or infinity, shape (m,).
        lower: bounds of the unknowns, shape (n,).
        start: initial values, shape (n,).
        jacobian: of the rows; None leaves it to CasADi.
        hessian: from the factors of objective and rows to the upper triangle of the Lagrangian's
            Hessian; None leaves it to CasADi.
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

    Violations with a price are charged it in any case.
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
        lower=np.r_[np.full(len(program.start), -np.inf), np.zeros(len(row))],
        start=np.r_[program.start, np.maximum(-sign * residual[row], 0.0)],
        jacobian=jacobian,
        hessian=hessian,
    )


def _padded(matrix: ca.MX, rows: ca.MX, columns: ca.MX | None = None) -> ca.MX:
    """The matrix with structural zeros below and to the right, by the lengths of two vectors."""
    width = matrix.shape[1] if columns is None else columns.numel()
    padded = ca.horzcat(matrix, ca.MX(matrix.shape[0], width - matrix.shape[1]))
    return ca.vertcat(padded, ca.MX(rows.numel() - matrix.shape[0], width))


def burn_blocks(problem: FlybyProblem, burns: ca.MX, *, printed: bool) -> list[NlpRows]:
    """Size and battery cone of burns (3, m); those held are zero, and those raised are large enough.

    `printed` writes angles by the paper's ratios, not as in `FlybyProblem.burn_margins`.
    """
    held, raised = burns[:, list(problem.held)], burns[:, list(problem.raised)]
    nappes = [
        -_inside_cone(burns, cone.axis, cone.half_angle, printed) for cone in problem.burn_cones
    ]
    return [
        NlpRows("dv_max", (problem.dv_max - norms(burns)).T),
        NlpRows("dv_battery", ca.horzcat(*nappes).T),
        NlpRows("dv_held", ca.vec(held), weight=0.0, equality=True),
        NlpRows("dv_min", (norms(raised) - problem.dv_min).T, weight=0.0),
    ]


def final_state_block(problem: FlybyProblem, mean: ca.MX, goal: ca.MX | None = None) -> NlpRows:
    """Miss of the final state for means (6, n_nodes); the problem's if no goal (6,) is given."""
    miss = mean[:, -1] - (problem.final_state if goal is None else goal)
    return NlpRows("final_state", miss, DYNAMICS_WEIGHT, equality=True, price=problem.miss_weight)


def state_blocks(
    problem: FlybyProblem,
    facets: Facets | None,
    mean: ca.MX,
    deviation: ca.MX | None,
    *,
    printed: bool,
) -> Iterator[NlpRows]:
    """State constraints on the means (6, n_nodes): P3's sets, without facets, or b - a'r - q ||S'a||.

    P3, and P2 without a facet, have no standard deviations along the facets' normals, shape (m,).
    `printed` writes P3's cones by ratios.
    """
    if facets is None:
        for constraint in problem.constraints:
            inside = _inside(constraint.region, mean[:3, constraint.nodes.tolist()], printed).T
            yield NlpRows(constraint.name, inside if constraint.keep == "in" else -inside)
    elif deviation is not None:
        along = ca.sum1(mean[:3, facets.node.tolist()] * facets.normal.T).T
        margin: ca.MX = ca.DM(facets.offset) - along - ca.DM(facets.quantile) * deviation
        for index, constraint in enumerate(problem.constraints):
            rows = np.flatnonzero(facets.constraint == index)
            if len(rows):
                yield NlpRows(constraint.name, margin[rows.tolist()])


def deviations(spread: Covariance, facets: Facets, node: Sequence[ca.MX]) -> ca.MX:
    """Standard deviation along every facet's normal, (m,)."""
    parts, order = [], []
    for k in np.unique(facets.node):
        rows = np.flatnonzero(facets.node == k)
        parts.append(spread.deviation(facets.normal[rows], node[k][6:]))
        order.append(rows)
    return ca.vertcat(*parts)[np.argsort(np.concatenate(order)).tolist()]


def _inside(region: Region, position: ca.MX, printed: bool) -> ca.MX:
    if isinstance(region, Ball):
        return region.radius - norms(position - region.center.T)
    assert isinstance(region, Cone), "IPOPT's programs know balls and cones only"
    return _inside_cone(position - region.apex.T, region.axis, region.half_angle, printed)


def _inside_cone(offset: ca.MX, axis: Array, half_angle: float, printed: bool) -> ca.MX:
    """Row (1, n) for offsets (3, n) from the apex: distance inside, or cosine less the limit's."""
    along = ca.sum1(offset * axis.T)
    if printed:
        return along / norms(offset) - np.cos(half_angle)
    across = norms(offset - axis.T * ca.repmat(along, 3, 1))
    return np.sin(half_angle) * along - np.cos(half_angle) * across


def norms(columns: ca.MX) -> ca.MX:
    """Sizes of columns, a row."""
    return root(ca.sum1(columns**2))
