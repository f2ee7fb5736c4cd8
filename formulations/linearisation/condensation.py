"""Condensation: mean and factor eliminated, as affine functions of the burns; in full, or frozen.

In full the STMs move with the mean (`linearisation`). The frozen forms exist to be compared against:

- **frozen STM**: the factor moves with the burns, but the STMs do not move with the mean. Sequential
  convex programming with it stops at points that do not solve P2.
- **frozen covariance**: propagated with the previous iterate, not a variable. The solver then does not
  know that smaller or other burns shrink the spread.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np

from formulations.arrays import Array, Indices
from formulations.linearisation.linearisation import Linearisation, require_finite


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
    """Eliminate the linearised mean and factor dynamics, leaving the burns, at some nodes or at all.

    The affine map closes the defects. Without `factor` that has no columns; without `curvature` the
    STMs do not depend on the mean (the T_k term).

    Raises:
        LinearisationError: if they are not finite.
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

    Along a leg T' = A T + (T_k . D) P with D the map of the deviation and P the STM so far. What
    the second term adds at each arc needs no recursion; the first carries it on.
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
"""The ways to eliminate mean and factor, by the name of the formulation."""
