"""Multipliers of a plan by the Karush-Kuhn-Tucker conditions, and its primer.

The multipliers are the prices of the constraints; the primer gives the first-order saving of another
burn anywhere along the flight. With the multipliers of an optimum the Lagrangian L is a function of the
means mu_k and the factors S_k. With psi_k = dL/dmu_k and Psi_k = dL/dS_k, all later nodes included, the
adjoint of the dynamics reads

    psi_k = A_k' psi_{k+1} + sum_ij T_k[i, j, :] (Psi_{k+1} S_k')[i, j] + dL/dmu_k at the node itself,
    Psi_k = A_k' Psi_{k+1} + dL/dS_k at the node itself.

A burn dv added at node k changes the least total delta-v by ||dv|| - p_k'dv + o(||dv||) with the primer

    p_k = -B'psi_k - sum over the columns that all burns share of C'(B'Psi_k).

Where p_k'u <= 1 for every allowed direction u, no small burn helps. The new burn's own errors count at
second order, as long as they shrink with it and the position is uncertain. J. Breakwell's and
D. Lawden's primer (Optimal Trajectories for Space Navigation, 1963) is the case without uncertainty and
with the final state as the only constraint.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear

from formulations.arrays import Array, Booleans
from formulations.linearisation.linearisation import (
    Linearisation,
    condense,
    final_state_map,
)
from formulations.problem.flyby import FlybyProblem
from formulations.rows.cones import Rows

BINDING = 1e-5
"""Slack up to which a constraint counts as active."""
VANISHED = 1e-6
"""Size of a burn, nondimensional, below which its direction is rounding."""
MISS = 6
"""Multipliers of the final state's miss, which come first."""
BURN_LIMITS = 3
"""Limits on each burn, whose multipliers come next: its size and two cones."""


def multipliers(problem: FlybyProblem, rows: Rows, lin: Linearisation) -> Array:
    """Multipliers m of the miss and of every violation, in the order of `MeritFunction.excess`.

    Non-negative multipliers, except for the miss, that make grad(total delta-v) + J'm least at a
    solution; J are the derivatives of the excess without inactive constraints. Shape
    (6 + 3 m + rows,). A burn that is held, raised or vanished, where its size has no
    derivative, is left out. Nocedal & Wright, Numerical Optimization, 2006, eq. (12.34).
    """
    burns = lin.iterate.burns
    sizes = np.linalg.norm(burns, axis=1)
    there = _free(lin, sizes)
    directions = burns / np.maximum(sizes, VANISHED)[:, None]
    jacobian, room = _excess_slopes(problem, rows, lin, directions)
    counts = np.concatenate([np.full(6, True), room < BINDING])
    prices = np.zeros(len(counts))
    if there.any():
        low = np.concatenate([np.full(6, -np.inf), np.zeros(len(room))])[counts]
        matrix, goal = jacobian[counts][:, there].T, -directions.ravel()[there]
        prices[counts] = lsq_linear(matrix, goal, (low, np.inf), method="bvls").x
    return prices


def slope_left(problem: FlybyProblem, rows: Rows, lin: Linearisation, prices: Array) -> float:
    """Largest component of grad(total delta-v) + J'm, without vanished burns: 0 at an optimum."""
    burns = lin.iterate.burns
    sizes = np.linalg.norm(burns, axis=1)
    directions = burns / np.maximum(sizes, VANISHED)[:, None]
    jacobian, _ = _excess_slopes(problem, rows, lin, directions)
    left = np.abs(directions.ravel() + jacobian.T @ prices)
    return float(left[_free(lin, sizes)].max(initial=0.0))


def _free(lin: Linearisation, sizes: Array) -> Booleans:
    """Burn components along which the cost has a derivative that vanishes at an optimum, (3 m,)."""
    held = np.isin(np.arange(len(sizes)), (*lin.problem.held, *lin.problem.raised))
    return np.repeat((sizes > VANISHED) & ~held, 3)


def _excess_slopes(
    problem: FlybyProblem, rows: Rows, lin: Linearisation, directions: Array
) -> tuple[Array, Array]:
    """Derivatives by all burns' components, (6 + 3 m + rows, 3 m), and slack without the miss's."""
    burns, m = lin.iterate.burns, len(directions)
    by_burn = np.zeros((3, m, m, 3))
    every = np.arange(m)
    by_burn[0, every, every] = directions
    for nappe, cone in enumerate(problem.burn_cones, start=1):
        planes = cone.facets(cone.across(burns), cone.half_angle)
        by_burn[nappe, every, every] = -planes.normal
    limits = problem.burn_margins(burns)["dv_max"], *(-c.inside(burns) for c in problem.burn_cones)
    slopes, slack = np.zeros((rows.count, burns.size)), np.empty(rows.count)
    for cones in rows.cones(lin, condense(lin, rows.nodes, factor=rows.condensed)):
        p, y = cones.values.shape[2], cones.at(lin.controls)
        size = np.linalg.norm(y[:, 1:], axis=1)
        tail = y[:, 1:] / np.maximum(size, 1e-300)[:, None]
        slack[cones.rows] = y[:, 0] - size
        slopes[cones.rows, :p] = np.einsum("nd,ndp->np", tail, cones.values[:, 1:])
        slopes[cones.rows, :p] -= cones.values[:, 0]
    jacobian = np.vstack([final_state_map(lin)[1], by_burn.reshape(3 * m, 3 * m), slopes])
    return jacobian, np.concatenate([*limits, slack])


def primer(rows: Rows, lin: Linearisation, prices: Array) -> Array:
    """The primer at every node, (n_nodes, 3), of an optimum whose errors shrink with the burns."""
    by_mean, by_factor = adjoint(rows, lin, prices)
    errors = lin.problem.execution_errors
    unit = errors.jacobian(np.zeros((1, 3)))[0, :, : errors.shared]
    shared = by_factor[:, 3:, lin.problem.shared_columns]
    return -by_mean[:, 3:] - np.einsum("nis,isj->nj", shared, unit)


def adjoint(rows: Rows, lin: Linearisation, prices: Array) -> tuple[Array, Array]:
    """Derivatives psi of the Lagrangian by the means, (n_nodes, 6), and Psi by the factors, (., 6, c).

    Prices are in the order of `multipliers`.
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
