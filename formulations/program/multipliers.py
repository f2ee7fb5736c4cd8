"""Multipliers of a plan by the Karush-Kuhn-Tucker conditions, and its primer.

The multipliers are the prices of the constraints; the primer gives the first-order saving of another
burn anywhere along the flight. With the multipliers of an optimum the Lagrangian L is a function of the
means mu_k and the factors S_k. With psi_k = dL/dmu_k and Psi_k = dL/dS_k, all later nodes included, the
adjoint of the dynamics reads

    psi_k = A_k' psi_{k+1} + sum_ij T_k[i, j, :] (Psi_{k+1} S_k')[i, j] + dL/dmu_k at the node itself,
    Psi_k = A_k' Psi_{k+1} + dL/dS_k at the node itself.

Corrected burns also depend on the errors E of estimates. Their adjoint Omega obeys the same
equation as Psi and adds to psi in the same way. Corrections act on it through the innovations of
`linearisation.factor`. A burn dv added at node k changes the least cost by ||dv|| - p_k'dv +
o(||dv||) with the primer

    p_k = -B'psi_k - sum over the columns that all burns share of C'B'(Psi_k + Omega_k).

Where p_k'u <= 1 for every allowed direction u, no small burn helps. The new burn's own errors count at
second order, as long as they shrink with it and the position is uncertain. J. Breakwell's and
D. Lawden's primer (Optimal Trajectories for Space Navigation, 1963) is the case without uncertainty and
with the final state as the only constraint.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from formulations.arrays import Array, Booleans
from formulations.linearisation.factor import flight_filter
from formulations.linearisation.linearisation import Linearisation, condense, miss_of
from formulations.problem.controls import UNIT
from formulations.problem.cost import cost
from formulations.problem.flyby import FlybyProblem
from formulations.rows.cones import Rows, slopes_by_states

BINDING, UNRESOLVED = 1e-5, 10.0
"""Slack up to which a constraint counts as active, and the same over the rows' resolution: a program
that stops at a reduction of the merit by that leaves rows a slack of about it over their price."""
VANISHED = 1e-6
"""Size of a burn, nondimensional, below which its direction is rounding."""
TINY = 1e-300
"""Stands for zero in a quotient."""
MISS = 6
"""Multipliers of the final state's miss, which come first."""
BURN_LIMITS = 3
"""Limits on each burn, whose multipliers come next: its size and two cones."""


def multipliers(problem: FlybyProblem, rows: Rows, lin: Linearisation) -> Array:
    """Multipliers m of the miss and of every violation, in the order of `MeritFunction.excess`.

    Those of the rules of firing times and phases follow, if these are controls. Non-negative
    multipliers, except for the miss, that make grad(cost) + J'm least at a solution; J are the
    derivatives of the excess without inactive constraints. Shape (6 + 3 m + rows + rules,). A burn that
    is held, raised or vanished, where its size has no derivative, is left out. Nocedal & Wright,
    Numerical Optimization, 2006, eq. (12.34).
    """
    there, slope = _free(problem, lin), cost(problem, lin.iterate).gradient
    jacobian, room = _excess_slopes(problem, rows, lin)
    active = room < max(BINDING, UNRESOLVED * rows.resolution)
    counts = np.concatenate([np.full(6, True), active])
    prices = np.zeros(len(counts))
    if there.any():
        low = np.concatenate([np.full(6, -np.inf), np.zeros(len(room))])[counts]
        matrix, goal = jacobian[counts][:, there].T, -slope[there]
        prices[counts] = lsq_linear(matrix, goal, (low, np.inf), method="bvls").x
    return prices


def slope_left(problem: FlybyProblem, rows: Rows, lin: Linearisation, prices: Array) -> float:
    """Largest component of grad(cost) + J'm, without vanished burns: 0 at an optimum."""
    jacobian, _ = _excess_slopes(problem, rows, lin)
    left = np.abs(cost(problem, lin.iterate).gradient + jacobian.T @ prices)
    return float(left[_free(problem, lin)].max(initial=0.0))


def _free(problem: FlybyProblem, lin: Linearisation) -> Booleans:
    """Mask of controls by which the cost has a derivative, zero at an optimum, shape (controls,).

    Cost and limits have a kink where a burn vanishes. The cost of its gains has a kink where burn
    and gains vanish together, or, if corrections cost nothing, where the gains vanish.
    """
    at, feedback = lin.problem, problem.feedback
    free = np.zeros(len(lin.controls), dtype=np.bool_)
    apart = feedback is None or feedback.cost == "nominal"
    for burn in np.setdiff1d(np.arange(at.n_burns), (*at.held, *at.raised)):
        first, stop = at.controls_before[burn : burn + 2]
        every = np.arange(first, stop)
        timed = np.isin(every, at.time_controls)
        own = slice(first, first + 3), every[~timed][3 if apart else 0 :]
        fired, corrected = (np.linalg.norm(lin.controls[part]) > VANISHED for part in own)
        free[first:stop] = np.repeat([fired, corrected], [3, stop - first - 3])
        # The flight's ends move it whether or not there is a burn.
        free[every[timed]] = fired or corrected or burn in (0, at.n_burns - 1)
    return free


def _excess_slopes(problem: FlybyProblem, rows: Rows, lin: Linearisation) -> tuple[Array, Array]:
    """Derivatives by all controls, (6 + 3 m + rows + rules, controls), and slack without the miss's."""
    burns, m, controls = lin.iterate.burns, problem.n_burns, len(lin.controls)
    by_burn, every = np.zeros((3, m, controls)), np.arange(m)[:, None]
    sizes = np.linalg.norm(burns, axis=1)
    by_burn[0, every, problem.burn_controls] = burns / np.maximum(sizes, VANISHED)[:, None]
    for nappe, cone in enumerate(problem.burn_cones, start=1):
        planes = cone.facets(cone.across(burns), cone.half_angle)
        by_burn[nappe, every, problem.burn_controls] = -planes.normal
    limits = problem.burn_margins(burns)["dv_max"], *(-c.inside(burns) for c in problem.burn_cones)
    miss = miss_of(lin)[1]
    slopes, slack = np.zeros((rows.count, controls)), np.empty(rows.count)
    for cones in rows.cones(lin, condense(lin, rows.nodes, factor=rows.condensed)):
        p, y = cones.values.shape[2], cones.at(lin.controls)
        size = np.linalg.norm(y[:, 1:], axis=1)
        tail = y[:, 1:] / np.maximum(size, TINY)[:, None]
        slack[cones.rows] = y[:, 0] - size
        slopes[cones.rows, :p] = np.einsum("nd,ndp->np", tail, cones.values[:, 1:])
        slopes[cones.rows, :p] -= cones.values[:, 0]
    jacobian = np.vstack([miss, by_burn.reshape(BURN_LIMITS * m, controls), slopes])
    if (firing := lin.problem.firing) is not None:
        by_times = np.zeros((len(firing.least), controls))
        by_times[:, problem.time_controls] = -UNIT * firing.matrix
        jacobian = np.vstack([jacobian, by_times])
        slack = np.r_[slack, firing.slack(problem.firing_times(lin.iterate.times))]
    return jacobian, np.concatenate([*limits, slack])


def primer(rows: Rows, lin: Linearisation, prices: Array) -> Array:
    """The primer at every node, (n_nodes, 3), of an optimum whose errors shrink with the burns."""
    adjoints = adjoint(rows, lin, prices)
    errors = lin.problem.execution_errors
    unit = errors.jacobian(np.zeros((1, 3)))[0, :, : errors.shared]
    both = adjoints.by_factor + adjoints.by_error
    shared = both[:, 3:, lin.problem.shared_columns]
    return -adjoints.by_mean[:, 3:] - np.einsum("nis,isj->nj", shared, unit)


class Adjoints(NamedTuple):
    """Derivatives of the Lagrangian at every node, after a burn and a measurement there.

    Attributes:
        by_mean: psi, by the means, shape (n_nodes, 6).
        by_factor: Psi, by the factors S, shape (n_nodes, 6, c).
        by_error: Omega, by the factors E of the estimates' errors, shape (n_nodes, 6, c).
    """

    by_mean: Array
    by_factor: Array
    by_error: Array


def adjoint(rows: Rows, lin: Linearisation, prices: Array) -> Adjoints:
    """The adjoints; prices are in the order of `multipliers`."""
    problem, arcs = lin.problem, lin.arcs
    first = MISS + BURN_LIMITS * problem.n_burns
    by_mean, by_state = slopes_by_states(lin, rows.state_cones(lin), prices[first:])
    by_mean[-1] += prices[:MISS]
    by_factor = np.pad(by_state, ((0, 0), (0, problem.parameters), (0, 0)))
    by_error = np.zeros_like(by_factor)
    stm = lin.stm_of_arcs
    known = flight_filter(problem, stm, lin.iterate, 6 + problem.parameters)
    of_rows = np.zeros((len(known.before), 6, problem.factor_columns))
    for k in range(problem.n_nodes - 2, -1, -1):
        by_mean[k] += by_mean[k + 1] @ arcs.stm[k]
        bent = by_factor[k + 1, :6] @ lin.spread.factor[k].T
        by_factor[k] += stm[k].T @ by_factor[k + 1]
        if problem.feedback is not None:
            after = by_factor[k + 1], by_error[k + 1]
            before = _before(lin, known.before, k + 1, after, of_rows)
            bent += before[:6] @ known.error[k].T
            by_error[k] = stm[k].T @ before
        by_mean[k] += np.einsum("ijl,ij->l", lin.bending[k], bent)
    return Adjoints(by_mean, by_factor[:, :6], by_error[:, :6])


def _before(
    lin: Linearisation, before: Sequence[Array], node: int, pulls: tuple[Array, Array], rows: Array
) -> Array:
    """Omega as it is before a node's measurements and burn, from Psi and Omega after them.

    `before` are the errors E before the measurements; the pull at the rows of Xi, (k, 6, c), grows.
    """
    problem, feedback, (by_factor, by_error) = lin.problem, lin.problem.feedback, pulls
    assert feedback is not None
    for j in np.flatnonzero(problem.burn_nodes[feedback.burns] == node).tolist():
        gains = problem.gains_of(lin.iterate, j)
        rows[: j + 1] += (gains.T @ by_factor[3:6]).reshape(j + 1, 6, -1)
    for j in np.flatnonzero(feedback.cut_offs == node)[::-1].tolist():
        one, error = lin.spread.innovations[j], before[j]
        along, pulled = error @ one.rows.T, by_error @ one.rows.T
        own = rows[j] - pulled.T @ error - along.T @ by_error
        low = np.tril(own @ one.rows.T)
        low[range(6), range(6)] *= 0.5
        moved = own - (low + low.T) @ one.rows
        by_error = by_error - pulled @ one.rows
        by_error[:6] += solve_triangular(one.root, moved, lower=True, trans="T")
    return by_error
