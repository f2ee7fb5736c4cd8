"""Covariance lifting: the factor S with Sigma = S S', and its full linearisation.

    S_{k+1} = [A_k S_k, B C(dv_i)],   S_0 = [Sigma_0^{1/2}, B C(dv_0)]

with the columns C of the burns' errors (`execution_errors`). Where these are proportional to the burn,
for given STMs the factor is affine in the burns, so that a facet's standard deviation ||S'a|| is
convex and nothing is relaxed. The STMs depend on the mean; the product rule

    dS_{k+1} = A_k dS_k + (T_k . dmu_k) S_k

with the second-order tensor T_k of the arc keeps that dependence.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from formulations.arrays import Array, Indices
from formulations.problem.flyby import ArcDerivatives, FlybyProblem, Iterate


def propagate_factor(
    problem: FlybyProblem, affine_map_from_last_burn: Array, burns: Array
) -> Array:
    """Factor at every node, shape (n_nodes, 6, columns); columns of later burns are zero.

    Of burns (m, 3) and the STMs from the last burn before each node, shape (n_nodes, 6, 6).
    """
    legs = problem.legs
    start = np.zeros((len(problem.leg_starts), 6, problem.factor_columns))
    start[0, :, : problem.first_factor.shape[1]] = problem.first_factor
    shared, columns = problem.execution_errors.shared, problem.execution_errors.columns(burns)
    for leg in range(len(start)):
        if leg > 0:
            start[leg] = affine_map_from_last_burn[legs.ends[leg - 1]] @ start[leg - 1]
        burn = leg - problem.coasts
        if burn >= 0:
            start[leg, 3:, problem.shared_columns] += columns[burn, :, :shared]
            start[leg, 3:, problem.columns_of_burn(burn)] = columns[burn, :, shared:]
    factor = affine_map_from_last_burn @ start[legs.of]
    factor[problem.leg_starts] = start
    return factor


DYNAMICALLY_FEASIBLE = 1e-9
"""Largest defect of an arc that obeys the dynamics."""


class LinearisationError(ArithmeticError):
    """The dynamics have no finite derivatives at an iterate."""


def require_finite(*parts: Array) -> None:
    """Raises LinearisationError unless all numbers are finite."""
    if not all(np.isfinite(part).all() for part in parts):
        raise LinearisationError("the dynamics have no finite derivatives at the iterate")


@dataclass(frozen=True, eq=False)
class Linearisation:
    """An iterate with the derivatives of its arcs. Derived quantities are computed lazily and cached.

    Its problem is what the iterate flies: its boundary states and initial covariance count wherever it
    is judged.
    """

    problem: FlybyProblem
    iterate: Iterate
    arcs: ArcDerivatives

    @property
    def is_dynamically_feasible(self) -> bool:
        """Whether the means obey the dynamics, whatever final state they lead to."""
        return bool(np.abs(self.defects[:-1]).max() <= DYNAMICALLY_FEASIBLE)

    @cached_property
    def defects(self) -> Array:
        """Per arc and at the end, shape (n_nodes, 6)."""
        return self.problem.defects(self.iterate, self.arcs.state)

    @cached_property
    def factor(self) -> Array:
        """Covariance factor at every node, shape (n_nodes, 6, columns)."""
        stm = self.affine_map_from_last_burn[:, :6, :6]
        return propagate_factor(self.problem, stm, self.iterate.burns)

    @cached_property
    def affine_map_from_last_burn(self) -> Array:
        """Maps of a deviation of the mean after the last burn before each node, (n_nodes, 7, 7).

        The seventh component is the constant one, so that closing the defects is part of the map.
        """
        maps = np.zeros((self.problem.n_nodes - 1, 7, 7))
        maps[:, :6, :6], maps[:, :6, 6], maps[:, 6, 6] = self.arcs.stm, self.defects[:-1], 1.0
        return self.problem.legs.compose(maps)

    def after_burns(self, kicks: Array, constant: Array) -> Array:
        """Deviations at the legs' starts, (legs + 1, 7, q), after burns kick by (m, 3, q) there.

        The row of the constant has shape (q,).
        """
        legs, coasts = self.problem.legs, self.problem.coasts
        start = np.zeros((len(kicks) + coasts, 7, len(constant)))
        start[0, 6] = constant
        for leg in range(len(start)):
            if leg > 0:
                start[leg] = self.affine_map_from_last_burn[legs.ends[leg - 1]] @ start[leg - 1]
            if leg >= coasts:
                start[leg, 3:6] += kicks[leg - coasts]
        return start

    @cached_property
    def burn_sensitivity(self) -> Array:
        """`after_burns` of every burn component and, last, of closing the defects, (., 7, nz + 1)."""
        m = self.problem.n_burns
        kicks = np.eye(3 * m, 3 * m + 1).reshape(m, 3, -1)
        return self.after_burns(kicks, np.eye(3 * m + 1)[-1])

    def at_nodes(self, start: Array, nodes: Indices) -> Array:
        """Deviations (n, 6, q) at some nodes from those at the legs' starts."""
        problem = self.problem
        deviation = self.affine_map_from_last_burn[nodes, :6] @ start[problem.legs.of[nodes]]
        leg = np.searchsorted(problem.leg_starts, nodes)
        here = problem.leg_starts[leg] == nodes
        deviation[here] = start[leg[here], :6]
        return deviation


def step_mean(lin: Linearisation, burns: Array) -> Array:
    """Node means that the linear model predicts for other burns, its defects closed, (n_nodes, 6)."""
    kicks = (burns - lin.iterate.burns)[:, :, None]
    every = np.arange(lin.problem.n_nodes)
    return lin.iterate.mean + lin.at_nodes(lin.after_burns(kicks, np.ones(1)), every)[:, :, 0]


def final_state_map(lin: Linearisation) -> tuple[Array, Array]:
    """Final mean as an affine function of all burns stacked: constant (6,) and Jacobian (6, nz)."""
    end = lin.burn_sensitivity[-1, :6]
    constant = lin.iterate.mean[-1] + end[:, -1] - end[:, :-1] @ lin.iterate.burns.ravel()
    return constant, end[:, :-1]
