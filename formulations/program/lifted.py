"""Solve the lifted subproblem: mean, covariance factor and virtual control are sparse variables.

    mu_{k+1} = mu^_{k+1} + A_k (mu_k - mu^_k) + d_k + B (dv_i - dv^_i)
    S_{k+1}  = [A_k S_k + (T_k . (mu_k - mu^_k)) S^_k, B (C^_i + C'^_i . (dv_i - dv^_i))]

with hats for the iterate, d for its defects and C for the columns of a burn's errors. Corrections
add B (U Xi) and the columns of their own errors, linearised. The effect of controls on the
innovations Xi is eliminated as in the condensed form. The program has only nodes with a constraint
or a burn. Arcs between them are composed, which is exact to the order of the linearisation and
makes the program ten times smaller. The dynamics are one product of a block-sparse parameter with
all states stacked (every mean, then every factor, row-major), so that the sparsity is constant.

The virtual control is the miss of the final state. Any burns have a trajectory, so the linearised
dynamics can miss only the final state. Virtual control on other arcs would let the model move the
path at the price of a gap, which no flight can have.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from formulations.arrays import Array, Indices
from formulations.linearisation.linearisation import (
    Linearisation,
    LinearisationError,
    factor_kicks,
    require_finite,
)
from formulations.problem.flyby import FlybyProblem, factor_columns_used
from formulations.program.convex_subproblem import ConvexSubproblem
from formulations.program.model import (
    CompiledProgram,
    Model,
    Numbers,
    Shape,
    StateModel,
    write_model,
)
from formulations.program.solvers import FallbackSolver
from formulations.program.subproblem import Penalty, PenaltyParameters, Step, SubproblemError
from formulations.rows.cones import Rows, StateCones

SETTINGS = {"CLARABEL": {"static_regularization_constant": 1e-7}}
"""With the default 1e-8 Clarabel's factorisation breaks down short of the tolerances."""


class LiftedSubproblem(ConvexSubproblem):
    """The textbook form of P3 or P2 around an iterate.

    The numbers of an iterate stand in the program as they are, and it is compiled for each iterate:
    CVXPY's memory for parameters grows with their number times that of the variables.
    """

    def __init__(self, problem: FlybyProblem, rows: Rows, penalty: Penalty, solver: str) -> None:
        super().__init__(problem, rows, penalty, FallbackSolver(solver, SETTINGS))
        self._dynamics, self._name = LiftedDynamics(problem, rows), solver
        self._model: Model | None = None
        self._compiled: CompiledProgram | None = None
        self._buffers: Indices

    def update(self, lin: Linearisation) -> None:
        """Convexify at an iterate. Raises as `Subproblem.update` does."""
        shape = Shape.of(self.problem, floor=bool(lin.problem.raised))
        try:
            model = write_model(shape, self._penalty, partial(self._states, lin))
        except LinearisationError as error:
            raise SubproblemError(str(error)) from error
        if self._model is not None:  # zeros are left out, so that the sparsity may be another
            self._solver = FallbackSolver(self._name, SETTINGS)
        self._at, self._model, self._compiled = lin, model, None

    def _states(self, lin: Linearisation, controls: cp.Variable, _: Numbers) -> StateModel:
        """Final state, rows and equations of the dynamics, in the states and the controls."""
        states, miss = cp.Variable(self._dynamics.size), cp.Variable(6)
        equations = self._dynamics.equations(lin, controls, states, miss)
        cones = self.rows.state_cones(lin)
        self._buffers = np.concatenate([np.zeros(0, np.intp), *(block.rows for block in cones)])
        seen: cp.Expression = states
        if lin.problem.firing is not None:
            seen = states + self._dynamics.drift(lin) @ (controls - lin.controls)
        rows = [write_row(one, self._dynamics.index(one.places), seen, controls) for one in cones]
        return StateModel(miss, rows, equations, [False] * len(rows))

    def _attempt(self, radius: float, charge: PenaltyParameters, planes: Array) -> Step:
        start = perf_counter()
        if self._compiled is None:
            assert self._model is not None
            self._compiled = CompiledProgram(self._model)
        step = self._solve(self._compiled, radius, charge, planes, {}, self._buffers)
        return replace(step, canonicalise_s=perf_counter() - start - step.solver_s)


class LiftedDynamics:
    """The linearised dynamics of mean and factor as sparse equations of all states stacked.

    Attributes:
        size: number of states.
    """

    def __init__(self, problem: FlybyProblem, rows: Rows) -> None:
        self._problem, nodes = problem, rows.nodes
        self._nodes = np.union1d(nodes, problem.leg_starts)
        self._columns = 0
        if rows.with_factor and len(nodes) > 0:
            limited = problem.drifts or any(x is not None for x in problem.final_spread)
            used = factor_columns_used(problem, nodes)
            self._columns = problem.factor_columns if limited else used
        self._arcs = len(self._nodes) - 1
        # The factor is needed up to the last node that a constraint looks at.
        self._factor_arcs = int(np.searchsorted(self._nodes, nodes[-1])) if self._columns else 0
        self._mean_size = 6 * (self._arcs + 1)
        self.size = self._mean_size + 6 * self._columns * (self._factor_arcs + 1)
        # Rows of the states that no arc ends in: the mean and the factor at the first node.
        self._ends = np.r_[6 : self._mean_size, self._mean_size + 6 * self._columns : self.size]
        self._starts = np.setdiff1d(np.arange(self.size), self._ends)

    def index(self, places: Indices) -> Indices:
        """The state at each of `StateCones.places`."""
        _, node, i, j = places
        row = 6 * np.searchsorted(self._nodes, node) + i
        return np.where(j == 0, row, self._mean_size + row * self._columns + j - 1)

    def equations(
        self, lin: Linearisation, controls: cp.Variable, states: cp.Variable, miss: cp.Variable
    ) -> list[cp.Constraint]:
        """The dynamics about an iterate, and the miss of the final state.

        Raises:
            LinearisationError: if their numbers are not finite.
        """
        n, c, arcs = self._factor_arcs, self._columns, compose(lin, self._nodes)
        full = lin.spread.factor[self._nodes[: n + 1], :, :c]
        factor = full[:, :6]
        # (T_k . dmu) S^_k: rows i, factor column c, mean component l.
        bent = np.einsum("kijl,kjc->kicl", arcs.tensor[:n], full[:n], optimize=True)
        own = np.broadcast_to(arcs.stm[:n, :, None, :], bent.shape)
        entries = np.concatenate([arcs.stm.ravel(), own.ravel(), bent.ravel()])
        step = sp.csr_array((entries, self._pattern()), shape=(len(self._ends), self.size))
        closing = np.r_[arcs.shift.ravel(), (arcs.shift_stm[:n] @ full[:n]).ravel()]
        here = np.r_[lin.iterate.mean[self._nodes].ravel(), factor.ravel()]
        (kicks, closed), moved = self._kicks(lin), controls - lin.controls
        off, starts, ends = states - here, self._starts, self._ends
        final, goal = slice(self._mean_size - 6, self._mean_size), lin.problem.final_state
        if lin.problem.firing is not None:
            goal = goal + lin.shifts.final @ moved[lin.problem.time_controls]
        return [
            off[starts] == kicks[starts] @ moved + closed[starts],
            off[ends] == step @ off + kicks[ends] @ moved + closing + closed[ends],
            states[final] == goal + miss,
        ]

    def drift(self, lin: Linearisation) -> sp.csr_array:
        """What moving nodes see in addition to states at given times, by the controls, (states, nz)."""
        n, c, shape = self._factor_arcs, self._columns, (self.size, len(lin.controls))
        every = np.zeros((self.size, len(lin.problem.time_controls)))
        own = lin.shifts.drift(self._nodes)
        every[: self._mean_size] = own.reshape(self._mean_size, -1)
        if c > 0:
            nodes = self._nodes[: n + 1]
            turned = lin.shifts.factor_drift(nodes, lin.spread.factor[nodes, :, :c])
            every[self._mean_size :] = turned.reshape(-1, every.shape[1])
        row, q = np.nonzero(every)
        return sp.csr_array((every[row, q], (row, lin.problem.time_controls[q])), shape=shape)

    def _pattern(self) -> tuple[Indices, Indices]:
        """Rows of the dynamics and the states that they connect.

        In this order: A_k on the mean; A_k on every factor column; T_k . S^_k from the mean.
        """
        k, i, j = np.meshgrid(np.arange(self._arcs), np.arange(6), np.arange(6), indexing="ij")
        mean_row, mean_entry = 6 * k + i, 6 * k + j
        c = self._columns
        k, i, col, j = np.meshgrid(
            np.arange(self._factor_arcs), np.arange(6), np.arange(c), np.arange(6), indexing="ij"
        )
        factor_row = 6 * self._arcs + (6 * k + i) * c + col
        own, from_mean = self._mean_size + (6 * k + j) * c + col, 6 * k + j
        rows = np.concatenate([mean_row.ravel(), factor_row.ravel(), factor_row.ravel()])
        return rows, np.concatenate([mean_entry.ravel(), own.ravel(), from_mean.ravel()])

    def _kicks(self, lin: Linearisation) -> tuple[sp.csr_array, Array]:
        """Derivatives by controls of means and factors at burns, (states, nz), and their defects.

        Of the means B dv; of the factors B C'^_i . dv, and what `factor_kicks` says of corrections; of
        both what a burn changes that comes later, at given times.
        """
        problem, c, controls = self._problem, self._columns, len(lin.controls)
        node, shape = np.searchsorted(self._nodes, problem.burn_nodes), (self.size, controls + 1)
        row, by = 6 * node[:, None] + 3 + np.arange(3), problem.burn_controls
        kicks = sp.csr_array((np.ones(by.size), (row.ravel(), by.ravel())), shape=shape)
        row = 6 * node[:, None] + np.arange(6)
        if problem.firing is not None:
            burn, i, q = np.nonzero(lin.shifts.mean)
            place = row[burn, i], problem.time_controls[q]
            kicks = kicks + sp.csr_array((lin.shifts.mean[burn, i, q], place), shape=shape)
        if c > 0:
            felt = node <= self._factor_arcs
            added = factor_kicks(lin)[felt, :, :c]
            state = self._mean_size + row[felt, :, None] * c + np.arange(c)
            filled = np.nonzero(added)
            kicks = kicks + sp.csr_array(
                (added[filled], (state[filled[:3]], filled[3])), shape=shape
            )
        return kicks[:, :-1], kicks[:, [-1]].toarray().ravel()


@dataclass(frozen=True)
class ComposedArcs:
    """Arcs between chosen nodes, composed from the grid's, as maps of the deviation d at their start.

    Deviation of the mean at the end: stm d + shift. STM along the deviated mean, of p parameters too:
    stm + shift_stm + tensor . d. Shapes: (n, 6, 6), (n, 6), (n, 6, 6 + p), (n, 6, 6 + p, 6).
    """

    stm: Array
    shift: Array
    shift_stm: Array
    tensor: Array


def compose(lin: Linearisation, nodes: Indices) -> ComposedArcs:
    """Compose the arcs between consecutive `nodes`, which must contain every burn's node.

    With A, T, d of the next arc, D the deviation so far and P the STM so far,
    D' = A D + d and dP' = A dP + (T . D) P: the product rule, once for the part that the starting
    deviation causes (tensor) and once for the part that the defects cause (shift_stm).

    Raises:
        LinearisationError: if they are not finite.
    """
    n, size = len(nodes) - 1, 6 + lin.problem.parameters
    composed = ComposedArcs(
        np.empty((n, 6, 6)), np.empty((n, 6)), np.empty((n, 6, size)), np.empty((n, 6, size, 6))
    )
    defects = lin.defects
    for arc, (first, last) in enumerate(itertools.pairwise(nodes)):
        stm, shift, full = np.eye(6), np.zeros(6), np.eye(size)
        shift_stm, tensor = np.zeros((6, size)), np.zeros((6, size, 6))
        for k in range(first, last):
            a, t = lin.arcs.stm[k], lin.bending[k]
            shift_stm = a @ shift_stm + (t @ shift) @ full
            # (T . stm d) full: rows i, columns c of the STM, component l of d.
            tensor = (a @ tensor.reshape(6, -1)).reshape(6, size, 6) + full.T @ (t @ stm)
            stm, shift = a @ stm, a @ shift + defects[k]
            full = lin.stm_of_arcs[k] @ full
        composed.stm[arc], composed.shift[arc] = stm, shift
        composed.shift_stm[arc], composed.tensor[arc] = shift_stm, tensor
    require_finite(composed.stm, composed.shift, composed.shift_stm, composed.tensor)
    return composed


def write_row(
    block: StateCones, index: Indices, states: cp.Expression, controls: cp.Variable
) -> cp.Expression:
    """The y of a block's cones, shape (n, d); `index` has the state at each of its places."""
    shape = block.constants.size, states.size
    y = sp.csr_array((block.entries, (block.places[0], index)), shape=shape) @ states
    if block.burns.size:
        p = block.burns.shape[2]
        y = y + block.burns.reshape(-1, p) @ controls[:p]
    return cp.reshape(y, block.constants.shape, order="C") + block.constants
