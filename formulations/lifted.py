"""Lifted: mean, covariance factor and virtual control as explicit variables, sparse.

    mu_{k+1} = mu^_{k+1} + A_k (mu_k - mu^_k) + d_k + B (dv_i - dv^_i)
    S_{k+1}  = [A_k S_k + (T_k . (mu_k - mu^_k)) S^_k, beta B diag(dv_i)]

with hats for the iterate and d for its defects. Nodes are those that a constraint or a burn touches;
the arcs between are composed, which is exact to the order of the linearisation and keeps the program
a tenth of its size. The dynamics are one product of a block-sparse parameter with all states stacked
(every mean, then every factor, row-major), so that the sparsity is constant.

The virtual control is the miss of the final state. Any burns have a trajectory, so that this is all
the linearised dynamics can miss; on other arcs it would promise to move the path at the price of a
miss, which no flight keeps.
"""

from __future__ import annotations

from typing import ClassVar

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from formulations.lifting import Linearisation, compose
from formulations.problem import FlybyProblem, Nodes, factor_columns_used
from formulations.regions import Array


class Lifted:
    """The textbook form; arguments as for `Condensed`."""

    # With the default 1e-8 its factorisation breaks down short of the tolerances.
    clarabel: ClassVar[dict[str, float]] = {"static_regularization_constant": 1e-7}

    def __init__(
        self, problem: FlybyProblem, burns: cp.Variable, nodes: Nodes, with_factor: bool
    ) -> None:
        self._problem = problem
        self._nodes = np.union1d(nodes, problem.burn_nodes)
        factor = with_factor and len(nodes) > 0
        self._columns = factor_columns_used(problem, nodes) if factor else 0
        self._arcs = len(self._nodes) - 1
        # The factor is needed up to the last node that a constraint looks at.
        self._factor_arcs = int(np.searchsorted(self._nodes, nodes[-1])) if self._columns else 0
        self._mean_size = 6 * (self._arcs + 1)
        states = cp.Variable(self._mean_size + 6 * self._columns * (self._factor_arcs + 1))
        virtual = cp.Variable(6)
        self._indices = self._pattern()
        rows = 6 * self._arcs + 6 * self._columns * self._factor_arcs
        self._stepping = cp.Parameter((rows, states.size), sparsity=self._indices)
        self._constant = cp.Parameter(rows)
        stacked = cp.reshape(burns, (burns.size,), order="C")
        # Rows of the states that no arc ends in: the mean and the factor at the first node.
        ends = np.r_[6 : self._mean_size, self._mean_size + 6 * self._columns : states.size]
        starts = np.setdiff1d(np.arange(states.size), ends)
        self._start = cp.Parameter(6 * (1 + self._columns))
        kicks = self._kicks(states.size)
        self.constraints: list[cp.Constraint] = [
            states[starts] == self._start + kicks[starts] @ stacked,
            states[ends] == self._stepping @ states + self._constant + kicks[ends] @ stacked,
            states[self._mean_size - 6 : self._mean_size] == problem.final_state + virtual,
        ]
        self.virtual_control = virtual
        pick = self._pick(np.searchsorted(self._nodes, nodes), states.size)
        self.outputs = cp.reshape(pick @ states, (3 * len(nodes), 1 + self._columns), order="C")

    def _pattern(self) -> tuple[Nodes, Nodes]:
        """Rows of the dynamics and the state entries that the parameter connects to them.

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

    def _kicks(self, size: int) -> sp.csr_array:
        """B dv on the means and beta B diag(dv) on the factors, (states, 3 burns)."""
        problem = self._problem
        entries: list[tuple[int, int, float]] = []
        for burn, node in enumerate(np.searchsorted(self._nodes, problem.burn_nodes).tolist()):
            for axis in range(3):
                entries.append((6 * node + 3 + axis, 3 * burn + axis, 1.0))
                column = problem.columns_of_burn(burn).start + axis
                if column < self._columns and node <= self._factor_arcs:
                    row = self._mean_size + (6 * node + 3 + axis) * self._columns + column
                    entries.append((row, 3 * burn + axis, problem.execution_error))
        rows, columns, values = zip(*entries, strict=True)
        return sp.csr_array((values, (rows, columns)), shape=(size, 3 * problem.n_burns))

    def _pick(self, nodes: Nodes, size: int) -> sp.csr_array:
        """Position rows (mean, factor columns) of the used nodes among the stacked states."""
        component = np.add.outer(6 * nodes, np.arange(3))
        factor = np.add.outer(self._mean_size + component * self._columns, np.arange(self._columns))
        chosen = np.concatenate([component[..., None], factor], axis=2).ravel()
        ones = np.ones(len(chosen))
        return sp.csr_array((ones, (np.arange(len(chosen)), chosen)), shape=(len(chosen), size))

    def update(self, lin: Linearisation) -> None:
        """Set the parameters for an iterate."""
        n, c, arcs = self._factor_arcs, self._columns, compose(lin, self._nodes)
        start = lin.problem.initial_factor[:, :c]
        start = np.pad(start, ((0, 0), (0, c - start.shape[1])))
        self._start.value = np.r_[lin.problem.initial_state, start.ravel()]
        own = np.broadcast_to(arcs.stm[:n, :, None, :], (n, 6, c, 6))
        factor = lin.factor[self._nodes[:n], :, :c]
        # (T_k . dmu) S^_k: rows i, factor column c, mean component l.
        curved = np.einsum("kijl,kjc->kicl", arcs.tensor[:n], factor, optimize=True)
        values = np.concatenate([arcs.stm.ravel(), own.ravel(), curved.ravel()])
        self._stepping.value_sparse = sp.coo_array(
            (values, self._indices), shape=self._stepping.shape
        )
        mean = lin.iterate.mean[self._nodes]
        factor_constant = arcs.shift_stm[:n] @ factor - np.einsum("kicl,kl->kic", curved, mean[:n])
        mean_constant = self._mean_constant(lin, mean, arcs.stm, arcs.shift)
        self._constant.value = np.concatenate([mean_constant.ravel(), factor_constant.ravel()])

    def _mean_constant(self, lin: Linearisation, mean: Array, stm: Array, shift: Array) -> Array:
        """mu^_{k+1} - A_k mu^_k + d_k - B dv^_i, (arcs, 6)."""
        constant = mean[1:] - np.einsum("kij,kj->ki", stm, mean[:-1]) + shift
        at = np.searchsorted(self._nodes, lin.problem.burn_nodes[1:]) - 1
        constant[at, 3:] -= lin.iterate.burns[1:]
        return constant
