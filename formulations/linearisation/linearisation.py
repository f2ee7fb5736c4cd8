"""Linearise mean and covariance factor about an iterate, as affine functions of the burns.

Covariance lifting replaces the covariance Sigma by a factor S with Sigma = S S', which obeys

    S_{k+1} = [A_k S_k, B C(dv_i)],   S_0 = [Sigma_0^{1/2}, B C(dv_0)]

with the columns C of the burns' errors (`execution_errors`). If the errors are proportional to the
burn, then for given STMs the factor is affine in the burns. The standard deviation ||S'a|| of a
facet is therefore convex, and nothing is relaxed. The STMs depend on the mean. The product rule

    dS_{k+1} = A_k dS_k + (T_k . dmu_k) S_k

with the second-order tensor T_k of the arc keeps that dependence.

Condensation eliminates mean and factor, with the full or with a frozen linearisation. The frozen
forms serve for comparison:

- **frozen STM**: the factor depends on the burns, but the STMs do not depend on the mean.
  Sequential convex programming then stops at points that do not solve P2.
- **frozen covariance**: the covariance is the previous iterate's, not a variable. The program then does
  not see that smaller or other burns shrink the spread.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Generic, Protocol, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from formulations.arrays import Array, Indices
from formulations.linearisation.factor import (
    FactorSensitivity,
    Filter,
    Spread,
    flight_filter,
    propagate_factor,
)
from formulations.linearisation.shifts import Shifts
from formulations.problem.controls import UNIT, Feedback
from formulations.problem.cost import Bend, Valued, bends, cost
from formulations.problem.flow import ArcDerivatives, bending, by_parameters
from formulations.problem.flyby import NO_GAINS, NO_TIMES, FlybyProblem, Iterate

DYNAMICALLY_FEASIBLE = 1e-9
"""Largest defect of an arc that obeys the dynamics."""


Found = TypeVar("Found")


class Seen(WeakKeyDictionary["Linearisation", Found], Generic[Found]):
    """Results at iterates that are still in use; a copy in another process begins empty."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Seen, ()


class LinearisationError(ArithmeticError):
    """The dynamics have no finite derivatives at an iterate."""


def require_finite(*parts: Array) -> None:
    """Raise LinearisationError unless all numbers are finite."""
    if not all(np.isfinite(part).all() for part in parts):
        raise LinearisationError("the dynamics have no finite derivatives at the iterate")


def affine_maps(stm: Array, defect: Array, by_parameters: Array | None = None) -> Array:
    """Maps of deviations, of the constant one and of p parameters along n arcs, (n, 7 + p, 7 + p).

    They close the defects; the parameters are as constant as the one.
    """
    p = 0 if by_parameters is None else by_parameters.shape[2]
    maps = np.zeros((len(stm), 7 + p, 7 + p))
    maps[:, :6, :6], maps[:, :6, 6], maps[:, 6, 6] = stm, defect, 1.0
    if by_parameters is not None:
        maps[:, :6, 7:], maps[:, 7:, 7:] = by_parameters, np.eye(p)
    return maps


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

    def known(self, feedback: Feedback | None) -> Linearisation:
        """The linearisation for the problem with this feedback; without gains if it is another."""
        if self.problem.feedback is feedback:
            return self
        plain = replace(self.iterate, gains=NO_GAINS)
        return Linearisation(replace(self.problem, feedback=feedback), plain, self.arcs)

    @property
    def informed(self) -> Linearisation:
        """The linearisation without gains on axes that carry no information, only rounding."""
        lin, feedback = self, self.problem.feedback
        if feedback is None or not self.iterate.gains.any():
            return self
        # What a cut-off tells depends on earlier gains: they are executed with errors.
        for j in range(len(feedback.burns)):
            axes = lin.spread.innovations[j].axes
            if axes.shape[1] == len(axes):
                continue
            gains = lin.iterate.gains.copy()
            for later in range(j, len(feedback.burns)):
                own = feedback.of_burn(gains, later)[:, 6 * j : 6 * j + 6]
                own[:] = own @ axes @ axes.T
            lin = Linearisation(self.problem, replace(self.iterate, gains=gains), self.arcs)
        return lin

    def with_drifts(self, drifts: Mapping[str, Array]) -> Linearisation:
        """The same with means of drifts, on which nothing derived depends."""
        other = copy(self)
        object.__setattr__(other, "iterate", replace(self.iterate, drifts=drifts))
        return other

    @property
    def controls(self) -> Array:
        """Burns, firing times and phases, and gains in one vector: see `FlybyProblem.controls`."""
        iterate = self.iterate
        return self.problem.controls(iterate.burns, iterate.gains, iterate.times)

    @cached_property
    def cost(self) -> Valued:
        """The objective and its gradient by the controls."""
        return cost(self.problem, self.iterate)

    @cached_property
    def bends(self) -> tuple[Bend, Bend]:
        """Curvature of the minimised cost, if corrections cost anything."""
        return bends(self.problem, self.iterate)

    @cached_property
    def factor(self) -> Array:
        """Covariance factor of the state at every node, shape (n_nodes, 6, columns)."""
        return self.spread.factor[:, :6]

    @cached_property
    def spread(self) -> Spread:
        """Covariance factor, and the innovations of the measurements."""
        return propagate_factor(self.problem, self.stm_from_last_burn, self.iterate)

    @cached_property
    def flown_filter(self) -> Filter:
        """What the filter that flies knows; without feedback, what is known before departure."""
        feedback = self.problem.feedback
        considers = feedback is not None and feedback.considers
        estimated = 6 if considers else 6 + self.problem.parameters
        return flight_filter(self.problem, self.stm_of_arcs, self.iterate, estimated)

    @cached_property
    def affine_map_from_last_burn(self) -> Array:
        """Maps of a deviation of the mean after the last burn before each node, (n_nodes, 7, 7).

        The seventh component is the constant one, so that closing the defects is part of the map.
        """
        return self._maps_from_last_burn[:, :7, :7]

    @cached_property
    def stm_from_last_burn(self) -> Array:
        """STMs of the state and the p parameters from there, (n_nodes, 6 + p, 6 + p)."""
        maps = self._maps_from_last_burn
        if not self.problem.parameters:
            return maps[:, :6, :6]
        return np.delete(np.delete(maps, 6, axis=1), 6, axis=2)

    @cached_property
    def _maps_from_last_burn(self) -> Array:
        maps = affine_maps(self.arcs.stm, self.defects[:-1], self.by_parameters)
        return self.problem.legs.compose(maps)

    @cached_property
    def stm_of_arcs(self) -> Array:
        """STMs of the state and the p parameters along each arc, (n_nodes - 1, 6 + p, 6 + p)."""
        if not (p := self.problem.parameters):
            return self.arcs.stm
        stm = np.tile(np.eye(6 + p), (len(self.arcs.stm), 1, 1))
        stm[:, :6, :6], stm[:, :6, 6:] = self.arcs.stm, self.by_parameters
        return stm

    @cached_property
    def by_parameters(self) -> Array:
        """Derivatives of the arcs' ends by the uncertain parameters, shape (n_nodes - 1, 6, p)."""
        return by_parameters(self.arcs, self.problem.parameters)

    @cached_property
    def bending(self) -> Array:
        """Derivatives of STMs and `by_parameters` by the arcs' starts, (n_nodes - 1, 6, 6 + p, 6)."""
        return bending(self.arcs, self.problem.parameters)

    @cached_property
    def bent(self) -> Array:
        """Derivatives of the state's rows of the STMs from the legs' starts by the deviation there.

        Shape (n_nodes, 6, 6 + p, 7).
        """
        return _composed_tensor(self, self.problem.n_nodes - 1)

    @cached_property
    def factor_sensitivity(self) -> FactorSensitivity:
        """Derivatives of the factor by the controls: see `condense` and `gradient`."""
        return sensitivity_of_factor(self, self.bent)

    def after_burns(self, kicks: Array, constant: Array) -> Array:
        """Deviations at the legs' starts, (legs + 1, 7, q), after changes (m, 3 or 6, q) there.

        Of the velocity, or of the whole state. The row of the constant has shape (q,).
        """
        legs, coasts = self.problem.legs, self.problem.coasts
        start = np.zeros((len(kicks) + coasts, 7, len(constant)))
        start[0, 6] = constant
        for leg in range(len(start)):
            if leg > 0:
                start[leg] = self.affine_map_from_last_burn[legs.ends[leg - 1]] @ start[leg - 1]
            if leg >= coasts:
                start[leg, 6 - kicks.shape[1] : 6] += kicks[leg - coasts]
        return start

    @cached_property
    def burn_sensitivity(self) -> Array:
        """`after_burns` of every burn component and, last, of closing the defects, (., 7, nz + 1)."""
        m = self.problem.n_burns
        kicks = np.eye(3 * m, 3 * m + 1).reshape(m, 3, -1)
        return self.after_burns(kicks, np.eye(3 * m + 1)[-1])

    @cached_property
    def shifts(self) -> Shifts:
        """Derivatives by firing times and phases, where these are controls."""
        return Shifts(self.problem, self.iterate, self.arcs)

    @cached_property
    def sensitivity(self) -> Array:
        """`after_burns` of every control and, last, of closing the defects, (., 7, controls + 1).

        Gains do not move the mean. A burn that moves leaves the mean at given times as it was before
        it, and changes that after it.
        """
        own, problem = self.burn_sensitivity, self.problem
        every = np.zeros((*own.shape[:-1], problem.controls_before[-1] + 1))
        every[..., problem.burn_controls.ravel()], every[..., -1] = own[..., :-1], own[..., -1]
        if problem.firing is not None:
            kicks = self.shifts.mean
            every[..., problem.time_controls] = self.after_burns(kicks, np.zeros(kicks.shape[-1]))
        return every

    def at_nodes(self, start: Array, nodes: Indices) -> Array:
        """Deviations (n, 6, q) at some nodes from those at the legs' starts."""
        problem = self.problem
        deviation = self.affine_map_from_last_burn[nodes, :6] @ start[problem.legs.of[nodes]]
        leg = np.searchsorted(problem.leg_starts, nodes)
        here = problem.leg_starts[leg] == nodes
        deviation[here] = start[leg[here], :6]
        return deviation


def step_mean(lin: Linearisation, burns: Array, times: Array = NO_TIMES) -> Array:
    """Node means that the linear model predicts for other burns and firing times, (n_nodes, 6).

    Its defects are closed. Without `times` these stay.
    """
    kicks = (burns - lin.iterate.burns)[:, :, None]
    every = np.arange(lin.problem.n_nodes)
    mean = lin.iterate.mean + lin.at_nodes(lin.after_burns(kicks, np.ones(1)), every)[:, :, 0]
    if not times.size:
        return mean
    here = lin.controls[lin.problem.time_controls]
    step = (times / UNIT - here)[:, None]
    moved = lin.at_nodes(lin.after_burns(lin.shifts.mean @ step, np.zeros(1)), every)
    return np.asarray(mean + (moved + lin.shifts.drift(every) @ step)[:, :, 0])


def miss_of(lin: Linearisation) -> tuple[Array, Array]:
    """Miss of the final state as an affine function of all controls: (6,) and (6, controls)."""
    end, problem = lin.sensitivity[-1, :6], lin.problem
    jacobian = end[:, :-1].copy()
    if problem.firing is not None:
        jacobian[:, problem.time_controls] -= lin.shifts.final
    constant = lin.iterate.mean[-1] + end[:, -1] - jacobian @ lin.controls
    return constant - problem.final_state, jacobian


def final_state_map(lin: Linearisation) -> tuple[Array, Array]:
    """Final mean as an affine function of all burns stacked: constant (6,) and Jacobian (6, nz)."""
    end = lin.burn_sensitivity[-1, :6]
    constant = lin.iterate.mean[-1] + end[:, -1] - end[:, :-1] @ lin.iterate.burns.ravel()
    return constant, end[:, :-1]


@dataclass(frozen=True)
class Sensitivity:
    """Mean and factor at n nodes as affine functions of the controls z: see `FlybyProblem.controls`.

    mu_k = mean_constant[k] + mean_jacobian[k] z, and the same for S_k.
    Shapes: (n, 6), (n, 6, nz), (n, 6, c), (n, 6, c, nz).
    """

    mean_constant: Array
    mean_jacobian: Array
    factor_constant: Array
    factor_jacobian: Array


def condense(
    lin: Linearisation,
    nodes: Indices | None = None,
    *,
    factor: bool = True,
    curvature: bool = True,
) -> Sensitivity:
    """Eliminate the linearised mean and factor, leaving the controls, at some nodes or all.

    The affine map closes the defects. Without `factor` the factor has no columns; without
    `curvature` the T_k term is left out: the STMs do not depend on the mean.

    Raises:
        LinearisationError: if mean or factor is not finite.
    """
    z, timed = lin.controls, lin.problem.time_controls
    nodes = np.arange(lin.problem.n_nodes) if nodes is None else nodes
    # The last column of each derivative is the part that does not depend on the controls: what closing
    # the defects moves.
    d_mean = lin.at_nodes(lin.sensitivity, nodes)
    if timed.size:
        d_mean[..., timed] += lin.shifts.drift(nodes)
    at, d_factor = np.zeros((len(nodes), 6, 0)), np.zeros((len(nodes), 6, 0, len(z) + 1))
    if factor:
        legs = lin.factor_sensitivity if curvature else sensitivity_of_factor(lin, None)
        at, d_factor = lin.factor[nodes], legs.at(nodes)[:, :6]
        if timed.size:
            d_factor[..., timed] += lin.shifts.factor_drift(nodes, lin.spread.factor[nodes])
    require_finite(d_mean, d_factor)
    return Sensitivity(
        lin.iterate.mean[nodes] + d_mean[..., -1] - d_mean[..., :-1] @ z,
        d_mean[..., :-1],
        at + d_factor[..., -1] - d_factor[..., :-1] @ z,
        d_factor[..., :-1],
    )


def gradient(lin: Linearisation, by_mean: Array, by_factor: Array) -> Array:
    """The derivative by the controls of a function with given derivatives at all nodes.

    `condense`, transposed. For a row that depends on many nodes it costs less to take their derivatives
    back to the legs' starts than to carry those by all controls to the nodes.

    Args:
        lin: where it is taken.
        by_mean: by the means' first components, shape (n_nodes, 3 or 6).
        by_factor: by the factor's first rows and columns, shape (n_nodes, 3 or 6, d).
    """
    problem, spread, starts = lin.problem, lin.spread, lin.problem.leg_starts
    by_starts = lin.factor_sensitivity.starts
    felt = np.flatnonzero(by_mean.any(axis=1) | by_factor.any(axis=(1, 2)))
    inside = np.setdiff1d(felt, starts)
    (rows, columns), legs = by_factor.shape[1:], problem.legs.of[inside]
    d_factor = np.zeros((len(starts), *by_starts.shape[1:3]))
    d_factor[:, :rows, :columns] = by_factor[starts]
    d_mean = np.zeros((len(starts), 7))
    d_mean[:, : by_mean.shape[1]] = by_mean[starts]
    stm = spread.stm[inside, :rows, : d_factor.shape[1]].swapaxes(1, 2)
    np.add.at(d_factor[..., :columns], legs, stm @ by_factor[inside])
    both = by_factor[inside] @ spread.factor[starts[legs], :, :columns].swapaxes(1, 2)
    pulled = np.einsum("nijl,nij->nl", lin.bent[inside, :rows], both)
    maps = lin.affine_map_from_last_burn[inside, : by_mean.shape[1]]
    np.add.at(d_mean, legs, pulled + np.einsum("nij,ni->nj", maps, by_mean[inside]))
    slope = np.einsum("lj,ljq->q", d_mean, lin.sensitivity[..., :-1])
    slope += np.einsum("lic,licq->q", d_factor, by_starts[..., :-1])
    if problem.firing is not None:
        every = np.arange(problem.n_nodes)
        drift = lin.shifts.drift(every)[:, : by_mean.shape[1]]
        turned = lin.shifts.factor_drift(every, spread.factor[:, :, :columns])[:, :rows]
        slope[problem.time_controls] += np.tensordot(by_mean, drift, 2)
        slope[problem.time_controls] += np.tensordot(by_factor, turned, 3)
    return np.asarray(slope)


def sensitivity_of_factor(lin: Linearisation, bent: Array | None) -> FactorSensitivity:
    """Derivatives of the factor, whose STMs bend with the mean unless they are held."""
    shifted = None if lin.problem.firing is None else lin.shifts.factor(lin.spread)
    return FactorSensitivity(lin.problem, lin.iterate, lin.spread, lin.sensitivity, bent, shifted)


def _composed_tensor(lin: Linearisation, last: int) -> Array:
    """Derivatives of the STMs from the legs' starts by the deviation there, (last + 1, 6, 6 + p, 7).

    Along a leg T' = A T + (T_k . D) P with D the map of the deviation and P the STM so far. The
    second term of all arcs is computed at once; the first propagates it.
    """
    legs, before = lin.problem.legs, lin.affine_map_from_last_burn.copy()
    before[lin.problem.leg_starts] = np.eye(7)
    before, here = before[:last], before[:last, :6, :6]
    if p := lin.problem.parameters:
        here = lin.stm_from_last_burn[:last].copy()
        here[lin.problem.leg_starts[:-1]] = np.eye(6 + p)
    stm, tensor = lin.arcs.stm[:last], lin.bending[:last]
    added = tensor @ before[:, None, :6]  # rows i, columns (j, l)
    added = here[:, None].swapaxes(-1, -2) @ added
    composed = np.zeros((last + 1, 6, 7 * (6 + p)))
    composed[1:] = added.reshape(last, 6, -1)
    inside = np.setdiff1d(np.arange(1, last), legs.ends)
    for k in inside:
        composed[k + 1] += stm[k] @ composed[k]
    return composed.reshape(last + 1, 6, 6 + p, 7)


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
