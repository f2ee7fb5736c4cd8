"""The primer: what another burn, anywhere along a flight, would save at first order.

By the multipliers of an optimum the Lagrangian L is a function of the means mu_k and the factors S_k.
With psi_k = dL/dmu_k and Psi_k = dL/dS_k, everything later included, the adjoint of the dynamics reads

    psi_k = A_k' psi_{k+1} + sum_ij T_k[i, j, :] (Psi_{k+1} S_k')[i, j] + dL/dmu_k at the node itself,
    Psi_k = A_k' Psi_{k+1} + dL/dS_k at the node itself.

A burn dv added at node k changes the least total delta-v by ||dv|| - p_k'dv + o(||dv||) with the primer

    p_k = -B'psi_k - sum over the columns that all burns share of C'(B'Psi_k).

Where p_k'u <= 1 for every direction u that is allowed, no small burn helps there. Errors that the new
burn draws for itself count at second order, as long as they shrink with it and the position is not
known for certain. J. Breakwell's and D. Lawden's primer (Optimal Trajectories for Space Navigation,
1963) is the case in which nothing is uncertain and only the final state is asked for.
"""

from __future__ import annotations

import numpy as np

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.regions import Array
from formulations.rows.cones import Rows

MISS = 6
"""Multipliers of the final state's miss, which come first."""
BURN_LIMITS = 3
"""Limits on each burn, whose multipliers come next: its size and two cones."""


def primer(rows: Rows, lin: Linearisation, prices: Array) -> Array:
    """The primer at every node, nondimensional, shape (n_nodes, 3).

    Args:
        rows: state constraints of the optimum.
        lin: the optimum, whose errors shrink with the burns.
        prices: its `multipliers`.
    """
    by_mean, by_factor = adjoint(rows, lin, prices)
    errors = lin.problem.execution_errors
    unit = errors.jacobian(np.zeros((1, 3)))[0, :, : errors.shared]
    shared = by_factor[:, 3:, lin.problem.shared_columns]
    return -by_mean[:, 3:] - np.einsum("nis,isj->nj", shared, unit)


def adjoint(rows: Rows, lin: Linearisation, prices: Array) -> tuple[Array, Array]:
    """Derivatives psi of the Lagrangian by the means, (n_nodes, 6), and Psi by the factors, (., 6, c).

    Args:
        rows: state constraints.
        lin: where.
        prices: of the miss, the burns' limits and the rows, in the order of `multipliers`.
    """
    problem, arcs = lin.problem, lin.arcs
    first = MISS + BURN_LIMITS * problem.n_burns
    here, here_factor = rows.pulled(lin, prices[first:])
    columns = problem.factor_columns if rows.with_factor else 0
    by_mean = np.zeros((problem.n_nodes, 6))
    by_factor = np.zeros((problem.n_nodes, 6, columns))
    by_mean[:, :3] = here
    by_mean[-1] += prices[:MISS]
    by_factor[:, : here_factor.shape[1], : here_factor.shape[2]] = here_factor
    for k in range(problem.n_nodes - 2, -1, -1):
        by_mean[k] += by_mean[k + 1] @ arcs.stm[k]
        if columns:
            bent = by_factor[k + 1] @ lin.factor[k].T
            by_mean[k] += np.einsum("ijl,ij->l", arcs.tensor[k], bent)
            by_factor[k] += arcs.stm[k].T @ by_factor[k + 1]
    return by_mean, by_factor
