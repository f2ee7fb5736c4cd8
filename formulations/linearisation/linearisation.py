"""Covariance lifting, its full linearisation, and mean and factor as affine functions of the burns.

The factor S with Sigma = S S' obeys

    S_{k+1} = [A_k S_k, B C(dv_i)],   S_0 = [Sigma_0^{1/2}, B C(dv_0)]

with the columns C of the burns' errors (`execution_errors`). Where these are proportional to the burn,
for given STMs the factor is affine in the burns, so that a facet's standard deviation ||S'a|| is
convex and nothing is relaxed. The STMs depend on the mean; the product rule

    dS_{k+1} = A_k dS_k + (T_k . dmu_k) S_k

with the second-order tensor T_k of the arc keeps that dependence.

Condensation eliminates mean and factor, in full or frozen. The frozen forms exist to be compared:

- **frozen STM**: the factor depends on the burns, but the STMs not on the mean. Sequential convex
  programming with it stops at points that do not solve P2.
- **frozen covariance**: the covariance is the previous iterate's, not a variable. The program then does
  not see that smaller or other burns shrink the spread.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Protocol

import numpy as np

from formulations.arrays import Array, Indices
from formulations.problem.flyby import ArcDerivatives, FlybyProblem, Iterate


def propagate_factor(
    problem: FlybyProblem, affine_map_from_last_burn: Array, burns: Array
) -> Array:
    """Factor at every node, shape (n_nodes, 6, columns); columns of later burns are zero.

    Takes burns (m, 3) and the STMs from the last burn before each node, shape (n_nodes, 6, 6).
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
    """Raise LinearisationError unless all numbers are finite."""
    if not all(np.isfinite(part).all() for part in parts):
        raise LinearisationError("the dynamics have no finite derivatives at the iterate")


@dataclass(frozen=True, eq=False)
class Linearisation:
    """An iterate with the derivatives of its arcs. Derived quantities are computed lazily and cached.

    Boundary states and initial covariance are those of its own problem, wherever it is evaluated.

    Attributes:
        problem: that the iterate flies.
        iterate: burns and means.
        arcs: their ends and derivatives.
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
        """Defects per arc and at the end, shape (n_nodes, 6)."""
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
        """Deviations at the legs' starts, (legs + 1, 7, q), after velocity changes (m, 3, q) there.

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


@dataclass(frozen=True)
class Sensitivity:
    """Mean and factor at n nodes as affine functions of all burns stacked, z = burns.ravel().

    mu_k = mean_constant[k] + mean_jacobian[k] z, and the same for S_k.
    Shapes: (n, 6), (n, 6, nz), (n, 6, c), (n, 6, c, nz).
    """

    mean_constant: Array
    mean_jacobian: Array
    factor_constant: Array
    factor_jacobian: Array


def condense(
    lin: Linearisation, nodes: Indices | None = None, *, factor: bool = True, curvature: bool = True
) -> Sensitivity:
    """Eliminate the linearised mean and factor, leaving the burns as variables, at some nodes or all.

    The affine map closes the defects. Without `factor` the factor has no columns; without
    `curvature` the T_k term is left out: the STMs do not depend on the mean.

    Raises:
        LinearisationError: if mean or factor is not finite.
    """
    z = lin.iterate.burns.ravel()
    nodes = np.arange(lin.problem.n_nodes) if nodes is None else nodes
    # The last column of each derivative is the part that does not depend on the burns: what closing
    # the defects moves.
    d_mean = lin.at_nodes(lin.burn_sensitivity, nodes)
    if factor:
        at, d_factor = lin.factor[nodes], _factor_sensitivity(lin, nodes, curvature=curvature)
    else:
        at, d_factor = np.zeros((len(nodes), 6, 0)), np.zeros((len(nodes), 6, 0, len(z) + 1))
    require_finite(d_mean, d_factor)
    return Sensitivity(
        lin.iterate.mean[nodes] + d_mean[..., -1] - d_mean[..., :-1] @ z,
        d_mean[..., :-1],
        at + d_factor[..., -1] - d_factor[..., :-1] @ z,
        d_factor[..., :-1],
    )


def _factor_sensitivity(lin: Linearisation, nodes: Indices, *, curvature: bool) -> Array:
    """Derivative of the factor at some nodes, shape (n, 6, c, nz + 1): the product rule by legs.

    With P the STM from the leg's start, d(P S) = P dS + (T . dmu) S there.
    """
    problem, legs, starts = lin.problem, lin.problem.legs, lin.problem.leg_starts
    c, q = problem.factor_columns, lin.burn_sensitivity.shape[-1]
    last = int(nodes.max(initial=0))
    bent = _composed_tensor(lin, last) if curvature else None
    start = np.zeros((len(starts), 6, c, q))
    errors = problem.execution_errors
    shared, of_errors = errors.shared, errors.jacobian(lin.iterate.burns)

    def reached(at: Indices) -> Array:
        leg = legs.of[at]
        derivative = lin.affine_map_from_last_burn[at, :6, :6] @ start[leg].reshape(-1, 6, c * q)
        derivative = derivative.reshape(-1, 6, c, q)
        if bent is not None:
            d_stm = bent[at] @ lin.burn_sensitivity[leg][:, None]  # (n, 6, 6, q)
            derivative += lin.factor[starts[leg], None].swapaxes(-1, -2) @ d_stm
        return derivative

    for leg, node in enumerate(starts):
        if node > last:
            break
        if leg > 0:
            start[leg] = reached(starts[leg : leg + 1])[0]
        i = leg - problem.coasts
        if i >= 0:
            by = slice(3 * i, 3 * i + 3)
            start[leg, 3:, problem.shared_columns, by] += of_errors[i, :, :shared]
            start[leg, 3:, problem.columns_of_burn(i), by] += of_errors[i, :, shared:]
    derivative = reached(nodes)
    last_leg = np.searchsorted(starts, nodes)
    here = starts[last_leg] == nodes
    derivative[here] = start[last_leg[here]]
    return derivative


def _composed_tensor(lin: Linearisation, last: int) -> Array:
    """Derivatives of the STMs from the legs' starts by the deviation there, (last + 1, 6, 6, 7).

    Along a leg T' = A T + (T_k . D) P with D the map of the deviation and P the STM so far. The
    second term of all arcs is computed at once; the first propagates it.
    """
    legs, before = lin.problem.legs, lin.affine_map_from_last_burn.copy()
    before[lin.problem.leg_starts] = np.eye(7)
    before = before[:last]
    stm, tensor = lin.arcs.stm[:last], lin.arcs.tensor[:last]
    added = tensor @ before[:, None, :6]  # rows i, columns (j, l)
    added = before[:, None, :6, :6].swapaxes(-1, -2) @ added
    composed = np.zeros((last + 1, 6, 42))
    composed[1:] = added.reshape(last, 6, 42)
    inside = np.setdiff1d(np.arange(1, last), legs.ends)
    for k in inside:
        composed[k + 1] += stm[k] @ composed[k]
    return composed.reshape(last + 1, 6, 6, 7)


def condense_frozen_covariance(lin: Linearisation, nodes: Indices, *, factor: bool) -> Sensitivity:
    """The affine map with dS = 0; arguments as for `condense`."""
    mean = condense(lin, nodes, factor=False)
    if not factor:
        return mean
    constant = lin.factor[nodes]
    jacobian = np.zeros((*constant.shape, mean.mean_jacobian.shape[-1]))
    return replace(mean, factor_constant=constant, factor_jacobian=jacobian)


class Condensation(Protocol):
    """Mean and factor at some nodes as affine functions of the burns."""

    def __call__(self, lin: Linearisation, nodes: Indices, *, factor: bool) -> Sensitivity:
        """See `condense`."""


CONDENSATIONS: dict[str, Condensation] = {
    "condensed": condense,
    "frozen-stm": partial(condense, curvature=False),
    "frozen-covariance": condense_frozen_covariance,
}
"""Condensations by the name of the formulation."""
