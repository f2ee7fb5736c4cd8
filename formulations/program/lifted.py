"""Solve the lifted subproblem: mean, covariance factor and virtual control are sparse variables.

    mu_k = mu^_k + P_k (mu_s - mu^_s) + d_k + B (dv_i - dv^_i)
    S_k  = [P_k S_s + (T_k . (mu_s - mu^_s)) S^_s, B (C^_i + C'^_i . (dv_i - dv^_i))]

with hats for the iterate, s the node where the leg to k starts, P and T the STM and the second-order
tensor from there, d the sum of the defects and C the columns of a burn's errors. Corrections
add B (U Xi) and the columns of their own errors, linearised. The effect of controls on the
innovations Xi is eliminated as in the condensed form. The program has only nodes with a constraint
or a burn. STMs from the legs' starts are exact to the order of the linearisation and make the program
ten times smaller than one of all arcs. The dynamics are one product of a block-sparse parameter with
all states stacked (every mean, then every factor, row-major), so that the sparsity is constant.

The virtual control is the miss of the final state. Any burns have a trajectory, so the linearised
dynamics can miss only the final state. Virtual control on other arcs would let the model move the
path at the price of a gap, which no flight can have.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from time import perf_counter

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from formulations.arrays import Array, Indices
from formulations.linearisation.linearisation import (
    Linearisation,
    LinearisationError,
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
from formulations.rows.cones import Cones, Rows


class LiftedSubproblem(ConvexSubproblem):
    """The textbook form of P3 or P2 around an iterate.

    The numbers of an iterate stand in the program as they are, and it is compiled for each iterate:
    CVXPY's memory for parameters grows with their number times that of the variables.
    """

    def __init__(self, problem: FlybyProblem, rows: Rows, penalty: Penalty, solver: str) -> None:
        super().__init__(problem, rows, penalty, FallbackSolver(solver))
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
            self._solver = FallbackSolver(self._name)
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
        # Number of the node at which the leg to each node but the first begins.
        begun = problem.leg_starts[problem.legs.of[self._nodes[1:]]]
        self._begun = np.searchsorted(self._nodes, begun)
        # The factor is needed up to the last node that a constraint looks at.
        self._factor_arcs = int(np.searchsorted(self._nodes, nodes[-1])) if self._columns else 0
        self._mean_size = 6 * (self._arcs + 1)
        self.size = self._mean_size + 6 * self._columns * (self._factor_arcs + 1)
        # Rows of the states that no arc ends in: the mean and the factor at the first node.
        self._ends = np.r_[6 : self._mean_size, self._mean_size + 6 * self._columns : self.size]
        self._starts = np.setdiff1d(np.arange(self.size), self._ends)

    def index(self, places: Indices) -> Indices:
        """The state at each of `Cones.places`."""
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
        n, c, reached = self._factor_arcs, self._columns, self._nodes[1:]
        maps, tensor = lin.affine_map_from_last_burn[reached, :6], lin.bent[reached[:n]]
        require_finite(maps, tensor)
        stm, factor = maps[:, :, :6], lin.factor[self._nodes[: n + 1], :, :c]
        # (T_k . dmu) S^_k: rows i, factor column c, mean component l; the last one is constant.
        start = lin.spread.factor[self._nodes[self._begun[:n]], :, :c]
        bent = np.einsum("kijl,kjc->kicl", tensor, start, optimize=True)
        own = np.broadcast_to(stm[:n, :, None], (n, 6, c, 6))
        entries = np.concatenate([stm.ravel(), own.ravel(), bent[..., :6].ravel()])
        step = sp.csr_array((entries, self._pattern()), shape=(len(self._ends), self.size))
        closing = np.r_[maps[:, :, 6].ravel(), bent[..., 6].ravel()]
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
        mean_row, mean_entry = 6 * k + i, 6 * self._begun[k] + j
        c = self._columns
        k, i, col, j = np.meshgrid(
            np.arange(self._factor_arcs), np.arange(6), np.arange(c), np.arange(6), indexing="ij"
        )
        factor_row = 6 * self._arcs + (6 * k + i) * c + col
        from_mean = 6 * self._begun[k] + j
        own = self._mean_size + from_mean * c + col
        rows = np.concatenate([mean_row.ravel(), factor_row.ravel(), factor_row.ravel()])
        return rows, np.concatenate([mean_entry.ravel(), own.ravel(), from_mean.ravel()])

    def _kicks(self, lin: Linearisation) -> tuple[sp.csr_array, Array]:
        """Derivatives by controls of means and factors at burns, (states, nz), and their defects.

        Of the means B dv; of the factors B C'^_i . dv, and what corrections change; of
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
            added = lin.factor_sensitivity.kicks()[felt, :6, :c]
            state = self._mean_size + row[felt, :, None] * c + np.arange(c)
            filled = np.nonzero(added)
            kicks = kicks + sp.csr_array(
                (added[filled], (state[filled[:3]], filled[3])), shape=shape
            )
        return kicks[:, :-1], kicks[:, [-1]].toarray().ravel()


def write_row(
    block: Cones, index: Indices, states: cp.Expression, controls: cp.Variable
) -> cp.Expression:
    """The y of a block's cones, shape (n, d); `index` has the state at each of its places."""
    shape = block.constants.size, states.size
    y = sp.csr_array((block.entries, (block.places[0], index)), shape=shape) @ states
    if block.values.size:
        p = block.values.shape[2]
        y = y + block.values.reshape(-1, p) @ controls[:p]
    return cp.reshape(y, block.constants.shape, order="C") + block.constants
