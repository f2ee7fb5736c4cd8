"""Multipliers of a plan by the conditions of Karush, Kuhn and Tucker: what each constraint costs."""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear

from formulations.linearisation.condensation import condense
from formulations.linearisation.linearisation import Linearisation, final_state_map
from formulations.problem.flyby import FlybyProblem
from formulations.problem.regions import Array
from formulations.rows.cones import Rows

BINDING = 1e-5
"""Room up to which a constraint may have a multiplier."""
VANISHED = 1e-6
"""Size of a burn, nondimensional, below which its direction is rounding."""


def multipliers(problem: FlybyProblem, rows: Rows, lin: Linearisation) -> Array:
    """Multipliers m of the miss and of every violation, in the order of `MeritFunction.excess`.

    The non-negative (those of the miss of either sign) that make grad(total delta-v) + J'm least, with
    J the derivatives of the excess and the constraints with room left out. A burn that has vanished is
    left out too, as its size has no derivative there. Nocedal & Wright, Numerical Optimization, 2006,
    eq. (12.34).

    Args:
        problem: limits of the burns.
        rows: state constraints.
        lin: a solution, nondimensional.

    Returns:
        Shape (6 + 3 m + rows,).
    """
    burns = lin.iterate.burns
    sizes = np.linalg.norm(burns, axis=1)
    there = np.repeat(sizes > VANISHED, 3)
    directions = burns / np.maximum(sizes, VANISHED)[:, None]
    jacobian, room = _excess_slopes(problem, rows, lin, directions)
    counts = np.concatenate([np.full(6, True), room < BINDING])
    found = np.zeros(len(counts))
    if there.any():
        low = np.concatenate([np.full(6, -np.inf), np.zeros(len(room))])[counts]
        matrix, goal = jacobian[counts][:, there].T, -directions.ravel()[there]
        found[counts] = lsq_linear(matrix, goal, (low, np.inf), method="bvls").x
    return found


def slope_left(problem: FlybyProblem, rows: Rows, lin: Linearisation, prices: Array) -> float:
    """Largest component of grad(total delta-v) + J'm, of burns that are there: zero at an optimum.

    Args:
        problem: limits of the burns.
        rows: state constraints.
        lin: the iterate, nondimensional.
        prices: its `multipliers` m.
    """
    burns = lin.iterate.burns
    sizes = np.linalg.norm(burns, axis=1)
    directions = burns / np.maximum(sizes, VANISHED)[:, None]
    jacobian, _ = _excess_slopes(problem, rows, lin, directions)
    left = np.abs(directions.ravel() + jacobian.T @ prices)
    return float(left[np.repeat(sizes > VANISHED, 3)].max(initial=0.0))


def _excess_slopes(
    problem: FlybyProblem, rows: Rows, lin: Linearisation, directions: Array
) -> tuple[Array, Array]:
    """Derivatives by all burns' components, (6 + 3 m + rows, 3 m), and room but of the miss."""
    burns, m = lin.iterate.burns, len(directions)
    by_burn = np.zeros((3, m, m, 3))
    every = np.arange(m)
    by_burn[0, every, every] = directions
    for nappe, cone in enumerate(problem.burn_cones, start=1):
        planes = cone.facets(cone.across(burns), cone.half_angle)
        by_burn[nappe, every, every] = -planes.normal
    limits = problem.burn_margins(burns)["dv_max"], *(-c.inside(burns) for c in problem.burn_cones)
    slopes, slack = np.zeros((rows.count, burns.size)), np.empty(rows.count)
    for cones in rows.cones(lin, condense(lin, rows.nodes, factor=rows.with_factor)):
        p, y = cones.values.shape[2], cones.at(burns)
        size = np.linalg.norm(y[:, 1:], axis=1)
        tail = y[:, 1:] / np.maximum(size, 1e-300)[:, None]
        slack[cones.rows] = y[:, 0] - size
        slopes[cones.rows, :p] = np.einsum("nd,ndp->np", tail, cones.values[:, 1:])
        slopes[cones.rows, :p] -= cones.values[:, 0]
    jacobian = np.vstack([final_state_map(lin)[1], by_burn.reshape(3 * m, 3 * m), slopes])
    return jacobian, np.concatenate([*limits, slack])
