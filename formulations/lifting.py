"""Covariance lifting: the factor S with Sigma = S S', and its full linearisation.

    S_{k+1} = [A_k S_k, beta B diag(dv_i)],   S_0 = [Sigma_0^{1/2}, beta B diag(dv_0)]

For given STMs the factor is affine in the burns, so that a facet's standard deviation ||S'a|| is
convex and nothing is relaxed. The STMs depend on the mean; the product rule

    dS_{k+1} = A_k dS_k + (T_k . dmu_k) S_k

with the second-order tensor T_k of the arc keeps that dependence.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from formulations.problem import ArcDerivatives, FlybyProblem, Iterate, Nodes
from formulations.regions import Array


def propagate_factor(problem: FlybyProblem, stm: Array, burns: Array) -> Array:
    """Factor at every node, shape (n_nodes, 6, columns); columns of later burns are zero."""
    factor = np.zeros((problem.n_nodes, 6, problem.factor_columns))
    factor[0, :, : problem.initial_factor.shape[1]] = problem.initial_factor
    burn_at = dict(zip(problem.burn_nodes.tolist(), range(problem.n_burns), strict=True))
    for k in range(problem.n_nodes):
        if k > 0:
            factor[k] = stm[k - 1] @ factor[k - 1]
        if k in burn_at:
            i = burn_at[k]
            factor[k, 3:, problem.columns_of_burn(i)] = problem.execution_error * np.diag(burns[i])
    return factor


FLOWN = 1e-9
"""Largest defect of an arc that obeys the dynamics."""


class LinearisationError(ArithmeticError):
    """The dynamics have no finite derivatives at an iterate."""


def _require_finite(*parts: Array) -> None:
    if not all(np.isfinite(part).all() for part in parts):
        raise LinearisationError("the dynamics have no finite derivatives at the iterate")


@dataclass(frozen=True)
class Linearisation:
    """An iterate with the derivatives of its arcs and its covariance factor."""

    problem: FlybyProblem
    iterate: Iterate
    arcs: ArcDerivatives
    factor: Array

    @classmethod
    def at(cls, problem: FlybyProblem, iterate: Iterate, arcs: ArcDerivatives) -> Linearisation:
        """Linearise at an iterate whose arcs have been propagated."""
        return cls(problem, iterate, arcs, propagate_factor(problem, arcs.stm, iterate.burns))

    @property
    def is_flown(self) -> bool:
        """Whether the means obey the dynamics, whatever final state they lead to."""
        return bool(np.abs(self.defects[:-1]).max() <= FLOWN)

    @property
    def defects(self) -> Array:
        """Per arc and at the end, shape (n_nodes, 6)."""
        return self.problem.defects(self.iterate, self.arcs.state)


@dataclass(frozen=True)
class Sensitivity:
    """Mean and factor as affine functions of all burns stacked, z = burns.ravel().

    mu_k = mean_constant[k] + mean_jacobian[k] z, and the same for S_k.
    Shapes: (n, 6), (n, 6, nz), (n, 6, c), (n, 6, c, nz).
    """

    mean_constant: Array
    mean_jacobian: Array
    factor_constant: Array
    factor_jacobian: Array


def condense(lin: Linearisation, *, curvature: bool = True) -> Sensitivity:
    """Eliminate the linearised mean and factor dynamics, leaving the burns.

    Args:
        lin: where to linearise; its defects are closed by the affine map.
        curvature: keep the STMs' dependence on the mean (the T_k term).

    Raises:
        LinearisationError: if they are not finite.
    """
    problem, z = lin.problem, lin.iterate.burns.ravel()
    nodes, columns, nz = problem.n_nodes, problem.factor_columns, len(z)
    # The last column of each derivative is the part that does not depend on the burns: what closing
    # the defects moves.
    d_mean = np.zeros((nodes, 6, nz + 1))
    d_factor = np.zeros((nodes, 6, columns, nz + 1))
    burn_at = dict(zip(problem.burn_nodes.tolist(), range(problem.n_burns), strict=True))
    defects = lin.defects
    for k in range(nodes):
        if k > 0:
            stm = lin.arcs.stm[k - 1]
            d_mean[k] = stm @ d_mean[k - 1]
            d_mean[k, :, nz] += defects[k - 1]
            d_factor[k] = (stm @ d_factor[k - 1].reshape(6, -1)).reshape(d_factor[k].shape)
            if curvature:
                d_stm = lin.arcs.tensor[k - 1] @ d_mean[k - 1]  # (6, 6, nz + 1)
                d_factor[k] += lin.factor[k - 1].T @ d_stm
        if k in burn_at:
            i = burn_at[k]
            d_mean[k, 3:, 3 * i : 3 * i + 3] += np.eye(3)
            for axis in range(3):
                column = problem.columns_of_burn(i).start + axis
                d_factor[k, 3 + axis, column, 3 * i + axis] = problem.execution_error
    _require_finite(d_mean, d_factor)
    return Sensitivity(
        lin.iterate.mean + d_mean[..., nz] - d_mean[..., :nz] @ z,
        d_mean[..., :nz],
        lin.factor + d_factor[..., nz] - d_factor[..., :nz] @ z,
        d_factor[..., :nz],
    )


def step_mean(lin: Linearisation, burns: Array) -> Array:
    """Node means that the linear model predicts for other burns, its defects closed, (n_nodes, 6)."""
    problem, defects = lin.problem, lin.defects
    kicks = np.zeros((problem.n_nodes, 6))
    kicks[problem.burn_nodes, 3:] = burns - lin.iterate.burns
    deviation = kicks.copy()
    for k in range(1, problem.n_nodes):
        deviation[k] += lin.arcs.stm[k - 1] @ deviation[k - 1] + defects[k - 1]
    return lin.iterate.mean + deviation


def final_state_map(lin: Linearisation) -> tuple[Array, Array]:
    """Final mean as an affine function of all burns stacked: constant (6,) and Jacobian (6, nz)."""
    problem = lin.problem
    jacobian, shift = np.zeros((6, 3 * problem.n_burns)), np.zeros(6)
    to_end, defects = np.eye(6), lin.defects
    burn_at = dict(zip(problem.burn_nodes.tolist(), range(problem.n_burns), strict=True))
    for k in range(problem.n_nodes - 1, -1, -1):
        if k in burn_at:
            i = burn_at[k]
            jacobian[:, 3 * i : 3 * i + 3] = to_end[:, 3:]
        if k > 0:
            shift += to_end @ defects[k - 1]
            to_end = to_end @ lin.arcs.stm[k - 1]
    constant = lin.iterate.mean[-1] + shift - jacobian @ lin.iterate.burns.ravel()
    return constant, jacobian


@dataclass(frozen=True)
class ComposedArcs:
    """Arcs between chosen nodes, composed from the grid's, as maps of the deviation d at their start.

    Deviation of the mean at the end: stm d + shift. STM along the deviated mean:
    stm + shift_stm + tensor . d. Shapes: (n, 6, 6), (n, 6), (n, 6, 6), (n, 6, 6, 6).
    """

    stm: Array
    shift: Array
    shift_stm: Array
    tensor: Array


def compose(lin: Linearisation, nodes: Nodes) -> ComposedArcs:
    """Compose the arcs between consecutive `nodes`, which must contain every burn's node.

    With A, T, d of the next arc, D the deviation so far and P the STM so far,
    D' = A D + d and dP' = A dP + (T . D) P: the product rule, once for the part that the starting
    deviation causes (tensor) and once for the part that the defects cause (shift_stm).

    Raises:
        LinearisationError: if they are not finite.
    """
    n = len(nodes) - 1
    composed = ComposedArcs(
        np.empty((n, 6, 6)), np.empty((n, 6)), np.empty((n, 6, 6)), np.empty((n, 6, 6, 6))
    )
    defects = lin.defects
    for arc, (first, last) in enumerate(itertools.pairwise(nodes)):
        stm, shift = np.eye(6), np.zeros(6)
        shift_stm, tensor = np.zeros((6, 6)), np.zeros((6, 6, 6))
        for k in range(first, last):
            a, t = lin.arcs.stm[k], lin.arcs.tensor[k]
            shift_stm = a @ shift_stm + (t @ shift) @ stm
            # (T . stm d) stm: rows i, columns c of the STM, component l of d.
            tensor = (a @ tensor.reshape(6, 36)).reshape(6, 6, 6) + stm.T @ (t @ stm)
            stm, shift = a @ stm, a @ shift + defects[k]
        composed.stm[arc], composed.shift[arc] = stm, shift
        composed.shift_stm[arc], composed.tensor[arc] = shift_stm, tensor
    _require_finite(composed.stm, composed.shift, composed.shift_stm, composed.tensor)
    return composed
