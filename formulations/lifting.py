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
from functools import cached_property

import numpy as np

from formulations.problem import ArcDerivatives, FlybyProblem, Iterate, Nodes
from formulations.regions import Array


def propagate_factor(problem: FlybyProblem, from_burn: Array, burns: Array) -> Array:
    """Factor at every node, shape (n_nodes, 6, columns); columns of later burns are zero.

    Args:
        problem: for its burns and their errors.
        from_burn: STMs from the last burn before each node, shape (n_nodes, 6, 6).
        burns: shape (m, 3).
    """
    legs = problem.legs
    start = np.zeros((problem.n_burns, 6, problem.factor_columns))
    start[0, :, : problem.initial_factor.shape[1]] = problem.initial_factor
    for i in range(problem.n_burns):
        if i > 0:
            start[i] = from_burn[legs.ends[i - 1]] @ start[i - 1]
        start[i, 3:, problem.columns_of_burn(i)] = problem.execution_error * np.diag(burns[i])
    factor = from_burn @ start[legs.of]
    factor[problem.burn_nodes] = start
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
    """An iterate with the derivatives of its arcs. What follows from them is made when asked for."""

    problem: FlybyProblem
    iterate: Iterate
    arcs: ArcDerivatives

    @property
    def is_flown(self) -> bool:
        """Whether the means obey the dynamics, whatever final state they lead to."""
        return bool(np.abs(self.defects[:-1]).max() <= FLOWN)

    @cached_property
    def defects(self) -> Array:
        """Per arc and at the end, shape (n_nodes, 6)."""
        return self.problem.defects(self.iterate, self.arcs.state)

    @cached_property
    def factor(self) -> Array:
        """Covariance factor at every node, shape (n_nodes, 6, columns)."""
        return propagate_factor(self.problem, self.from_burn[:, :6, :6], self.iterate.burns)

    @cached_property
    def from_burn(self) -> Array:
        """Maps of a deviation of the mean after the last burn before each node, (n_nodes, 7, 7).

        The seventh component is the constant one, so that closing the defects is part of the map.
        """
        maps = np.zeros((self.problem.n_nodes - 1, 7, 7))
        maps[:, :6, :6], maps[:, :6, 6], maps[:, 6, 6] = self.arcs.stm, self.defects[:-1], 1.0
        return self.problem.legs.compose(maps)

    def after_burns(self, kicks: Array, constant: Array) -> Array:
        """Deviations after each burn, (m, 7, q), for kicks (m, 3, q) and the constant's row (q,)."""
        start = np.zeros((len(kicks), 7, len(constant)))
        start[0, 6] = constant
        for i, kick in enumerate(kicks):
            if i > 0:
                start[i] = self.from_burn[self.problem.legs.ends[i - 1]] @ start[i - 1]
            start[i, 3:6] += kick
        return start

    @cached_property
    def burn_sensitivity(self) -> Array:
        """`after_burns` of every burn component and, last, of closing the defects, (m, 7, nz + 1)."""
        m = self.problem.n_burns
        kicks = np.eye(3 * m, 3 * m + 1).reshape(m, 3, -1)
        return self.after_burns(kicks, np.eye(3 * m + 1)[-1])

    def at_nodes(self, start: Array, nodes: Nodes) -> Array:
        """Deviations (n, 6, q) at some nodes from those after the burns."""
        problem = self.problem
        deviation = self.from_burn[nodes, :6] @ start[problem.legs.of[nodes]]
        burn = np.searchsorted(problem.burn_nodes, nodes)
        here = problem.burn_nodes[burn] == nodes
        deviation[here] = start[burn[here], :6]
        return deviation


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
    lin: Linearisation, nodes: Nodes | None = None, *, factor: bool = True, curvature: bool = True
) -> Sensitivity:
    """Eliminate the linearised mean and factor dynamics, leaving the burns.

    Args:
        lin: where to linearise; its defects are closed by the affine map.
        nodes: where mean and factor are wanted; all nodes if not given.
        factor: whether the factor is wanted; otherwise it has no columns.
        curvature: keep the STMs' dependence on the mean (the T_k term).

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
    _require_finite(d_mean, d_factor)
    return Sensitivity(
        lin.iterate.mean[nodes] + d_mean[..., -1] - d_mean[..., :-1] @ z,
        d_mean[..., :-1],
        at + d_factor[..., -1] - d_factor[..., :-1] @ z,
        d_factor[..., :-1],
    )


def _factor_sensitivity(lin: Linearisation, nodes: Nodes, *, curvature: bool) -> Array:
    """Derivative of the factor at some nodes, shape (n, 6, c, nz + 1): the product rule by legs.

    With P the STM from the leg's start, d(P S) = P dS + (T . dmu) S there.
    """
    problem, legs = lin.problem, lin.problem.legs
    c, q = problem.factor_columns, lin.burn_sensitivity.shape[-1]
    last = int(nodes.max(initial=0))
    bent = _composed_tensor(lin, last) if curvature else None
    start = np.zeros((problem.n_burns, 6, c, q))

    def reached(at: Nodes) -> Array:
        leg = legs.of[at]
        derivative = lin.from_burn[at, :6, :6] @ start[leg].reshape(-1, 6, c * q)
        derivative = derivative.reshape(-1, 6, c, q)
        if bent is not None:
            d_stm = bent[at] @ lin.burn_sensitivity[leg][:, None]  # (n, 6, 6, q)
            derivative += lin.factor[problem.burn_nodes[leg], None].swapaxes(-1, -2) @ d_stm
        return derivative

    for i, node in enumerate(problem.burn_nodes):
        if node > last:
            break
        if i > 0:
            start[i] = reached(problem.burn_nodes[i : i + 1])[0]
        for axis in range(3):
            column = problem.columns_of_burn(i).start + axis
            start[i, 3 + axis, column, 3 * i + axis] = problem.execution_error
    derivative = reached(nodes)
    burn = np.searchsorted(problem.burn_nodes, nodes)
    here = problem.burn_nodes[burn] == nodes
    derivative[here] = start[burn[here]]
    return derivative


def _composed_tensor(lin: Linearisation, last: int) -> Array:
    """Derivatives of the STMs from the legs' starts by the deviation there, (last + 1, 6, 6, 7).

    Along a leg T' = A T + (T_k . D) P with D the map of the deviation and P the STM so far. What
    the second term adds at each arc needs no recursion; the first carries it on.
    """
    legs, before = lin.problem.legs, lin.from_burn.copy()
    before[lin.problem.burn_nodes] = np.eye(7)
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
