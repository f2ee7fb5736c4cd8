"""State constraints of a subproblem: their margins, and second-order cones in the burns."""

from __future__ import annotations

from typing import Literal, NamedTuple, Protocol

import numpy as np

from formulations.arrays import Array, Indices
from formulations.linearisation.linearisation import Linearisation, Sensitivity, condense
from formulations.problem.flyby import FlybyProblem

Unit = Literal["length", "sigma"]
"""Unit of margins: length, or standard deviations on the normal quantile scale."""

NEAR_LENGTH = 0.002
"""Slack in units of length below which a row counts as near."""


BINDING = 1.0
"""Margin, in standard deviations, up to which a row is curved."""

CURVED_MAX = 18
"""Directions in which a row of a node is curved at most: those of most curvature."""

BEND = 3.0
"""c: standard deviations over which a row bends before it goes on straight."""

FINAL_POSITION, FINAL_VELOCITY = "final_position_sigma", "final_velocity_sigma"
PARTS = ((FINAL_POSITION, slice(0, 3)), (FINAL_VELOCITY, slice(3, 6)))


class Margins(NamedTuple):
    """Margins of one constraint's rows (>= 0 where satisfied) and the nodes they belong to.

    Attributes:
        nodes: of the rows, shape (n,).
        margin: of each row, shape (n,).
        path: means (., 6) of the free drift that they judge, if that is known in full.
    """

    nodes: Indices
    margin: Array
    path: Array | None = None


NO_PLACES, NO_ENTRIES = np.zeros((4, 0), dtype=np.intp), np.zeros(0)


class Cones(NamedTuple):
    """Second-order cones in the controls: y = values z' + constants has y_0 + buffer >= ||y_1..||.

    All have one dimension d (d = 1: half-spaces) and depend on the first p controls z' only: see
    `FlybyProblem.controls`. Before mean and factor are eliminated, y has in addition the sum of
    entries * [mu_k, S_k][i, j].

    Attributes:
        rows: index of each cone's buffer, shape (n,).
        values: shape (n, d, p); p = 0 where y depends on states alone.
        constants: shape (n, d).
        triangular: whether the last d - 1 rows of [values, constants] are zero below the diagonal.
        shared: whether all bound one row, and have its buffer.
        places: of each entry the component of y, among all n d, the node k, the state's component i and
            the column j, 0 of the mean and 1 onwards of the factor; shape (4, e), the same at every
            iterate.
        entries: shape (e,).
    """

    rows: Indices
    values: Array
    constants: Array
    triangular: bool = False
    shared: bool = False
    places: Indices = NO_PLACES
    entries: Array = NO_ENTRIES

    def at(self, controls: Array) -> Array:
        """The part of y by all controls, shape (n, d)."""
        return self.values @ controls[: self.values.shape[2]] + self.constants


def placed(component: Indices, node: Indices, i: Indices, j: Indices) -> Indices:
    """`Cones.places`, all of them broadcast against each other, shape (4, e)."""
    return np.stack([part.ravel() for part in np.broadcast_arrays(component, node, i, j)])


POSITION = np.arange(3)[:, None]
"""Components of the position, in `placed` beside columns."""


def triangular_cones(rows: Indices, head: Array, tail: Array) -> Cones:
    """Cones head (z', 1) + buffer >= ||tail (z', 1)||, reduced to the tail's triangular factor.

    With tail = Q R, Q preserves the norm, and R has a row for each burn component and one more.

    Args:
        rows: index of each cone's buffer, shape (n,).
        head: shape (n, p + 1).
        tail: shape (n, d, p + 1).
    """
    both = np.concatenate([head[:, None], np.linalg.qr(tail, mode="r")], axis=1)
    return Cones(rows, both[..., :-1], both[..., -1], triangular=True)


def curved_cones(
    rows: Indices, margin: Array, slope: Array, hessian: Array, z: Array, most: int = CURVED_MAX
) -> Cones:
    """Rows margin + slope'd + d'hessian d/2 >= 0 in d about z, their concave part as a cone.

    Args:
        rows: index of each row's buffer, shape (r,).
        margin: at z, shape (r,).
        slope: shape (r, p).
        hessian: shape (r, p, p); of its negative part the most is used.
        z: burns about which the rows are made, shape (p,).
        most: directions in which they are curved at most.
    """
    r, p = slope.shape
    curvature, axes = np.linalg.eigh(-0.5 * (hessian + hessian.swapaxes(1, 2)))
    curvature, axes = curvature[:, -most:], axes[:, :, -most:]
    bend = np.sqrt(BEND * np.maximum(curvature, 0.0))[:, :, None] * axes.swapaxes(1, 2)
    curved, d = np.any(bend, axis=(1, 2)), bend.shape[1]
    tail = np.zeros((r, d + 1, p + 1))
    tail[:, :d, :p], tail[:, :d, p] = bend, -bend @ z
    tail[curved, d, p] = BEND
    head = np.column_stack([slope, margin - slope @ z + BEND * curved])
    return triangular_cones(rows, head, tail)


def on_states(
    cones: Cones, lin: Linearisation, row: Indices, nodes: Indices, gradient: Array
) -> Cones:
    """Cones whose heads' slopes act on the states instead: only the curvature stays with the burns.

    Args:
        cones: as `curved_cones` makes them.
        lin: the iterate that they are made at.
        row: of the cones, which one a part of the gradient belongs to, shape (e,).
        nodes: where that part belongs, shape (e,).
        gradient: by positions or states and factors, side by side, shape (e, 3 or 6, 1 + c).
    """
    n, d, _ = cones.values.shape
    component = np.arange(gradient.shape[1])[:, None]
    places = placed(
        (d * row)[:, None, None], nodes[:, None, None], component, np.arange(gradient.shape[2])
    )
    at = np.concatenate([lin.iterate.mean[nodes, :, None], lin.factor[nodes]], axis=2)
    values, constants = cones.values.copy(), cones.constants.copy()
    constants[:, 0] = cones.at(lin.controls)[:, 0]
    here = np.einsum("eij,eij->e", gradient, at[:, : gradient.shape[1], : gradient.shape[2]])
    constants[:, 0] -= np.bincount(row, here, n)
    values[:, 0] = 0.0
    return Cones(cones.rows, values, constants, places=places, entries=gradient.ravel())


def slopes_by_states(lin: Linearisation, blocks: list[Cones], prices: Array) -> tuple[Array, Array]:
    """Derivative of the rows' violations ||y_1..|| - y_0, weighed by prices (rows,), at an iterate.

    Returns:
        By the means, shape (n_nodes, 6), and by the factors, shape (n_nodes, 6, c).
    """
    states = np.concatenate([lin.iterate.mean[:, :, None], lin.factor], axis=2)
    slope = np.zeros(states.shape)
    for block in blocks:
        component, *at = block.places
        entries = block.entries * states[tuple(at)]
        y = block.at(lin.controls)
        y += np.bincount(component, entries, y.size).reshape(y.shape)
        size = np.maximum(np.linalg.norm(y[:, 1:], axis=1, keepdims=True), 1e-300)
        by_y = prices[block.rows, None] * np.hstack([np.full((len(y), 1), -1.0), y[:, 1:] / size])
        np.add.at(slope, tuple(at), block.entries * by_y.ravel()[component])
    return slope[..., 0], slope[..., 1:]


class Rows(Protocol):
    """The state constraints of a subproblem."""

    @property
    def problem(self) -> FlybyProblem:
        """The problem whose constraints they are."""

    @property
    def nodes(self) -> Indices:
        """Nodes on which the rows depend, ascending."""

    @property
    def with_factor(self) -> bool:
        """Whether the rows depend on the covariance factor."""

    @property
    def condensed(self) -> bool:
        """Whether `cones` needs the condensed factor, or takes derivatives on its own."""

    @property
    def count(self) -> int:
        """Number of rows, and of buffers."""

    @property
    def near(self) -> float:
        """Slack up to which a row is included in the program from the start."""

    @property
    def unit(self) -> Unit:
        """Unit of the margins."""

    @property
    def resolution(self) -> float:
        """Relative change of the merit below the rows' own errors."""

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Margins by constraint name from the nonlinear mean and factor, never from the model."""

    def cones(self, lin: Linearisation, s: Sensitivity) -> list[Cones]:
        """The rows, convexified at an iterate, for mean and factor at `nodes` affine in the burns."""

    def state_cones(self, lin: Linearisation) -> list[Cones]:
        """The rows of `cones` before mean and factor are eliminated."""


def controls_felt(problem: FlybyProblem, nodes: Indices) -> Indices:
    """Number of controls on which positions at some nodes depend: those of earlier burns.

    The first burn always counts, so that every cone depends on some controls, and so does a later one
    with which the node moves in time.
    """
    felt = np.maximum(np.searchsorted(problem.burn_nodes, nodes), 1)
    if problem.firing is not None:
        numbers = 1 + problem.firing.owners(problem.n_burns - 1)
        moves = problem.firing.shares[nodes] > 0.0
        felt = np.maximum(felt, (numbers * moves).max(axis=1, initial=0))
    return problem.controls_before[felt]


class FinalSpread:
    """Limits on the covariance after the last burn (`final_spread`): rows after all others.

    They bound the root of the summed variances of the position, and of the velocity. With the factor S
    affine in the burns each is one second-order cone,

        ||vec(S_final)|| <= limit + buffer,

    S_final the factor's rows of position or of velocity at the last node, after the last burn. `first`
    is the number of rows before.
    """

    def __init__(self, problem: FlybyProblem, first: int) -> None:
        limits = zip(PARTS, problem.final_spread, strict=True)
        self._limits = [(*part, limit) for part, limit in limits if limit is not None]
        self._first, self._last = first, problem.n_nodes - 1
        self._columns = problem.factor_columns
        self.count = len(self._limits)

    @property
    def nodes(self) -> Indices:
        """The last node, if there is a limit."""
        return np.full(min(self.count, 1), self._last, dtype=np.intp)

    def margins(self, lin: Linearisation) -> dict[str, Margins]:
        """Limits less the roots, in units of length and of speed."""
        return {
            name: Margins(self.nodes, np.array([limit - np.linalg.norm(lin.factor[-1, part])]))
            for name, part, limit in self._limits
        }

    def cones(self, lin: Linearisation, s: Sensitivity) -> list[Cones]:
        """One cone per limit, in all controls; the last node of `s` is the problem's last."""
        if self.count and not s.factor_jacobian.shape[2]:
            s = condense(lin, self.nodes)
        cones = []
        for number, (_, part, limit) in enumerate(self._limits):
            jacobian = s.factor_jacobian[-1, part]
            jacobian = jacobian.reshape(-1, jacobian.shape[-1])
            spread = np.column_stack([jacobian, s.factor_constant[-1, part].ravel()])
            head = np.r_[np.zeros(jacobian.shape[1]), limit]
            rows = np.array([self._first + number])
            cones.append(triangular_cones(rows, head[None], spread[None]))
        return cones

    def state_cones(self) -> list[Cones]:
        """One each, in the factor's entries."""
        cones = []
        for number, (_, part, limit) in enumerate(self._limits):
            y = 1 + np.arange(3 * self._columns).reshape(3, -1)
            columns = 1 + np.arange(self._columns)
            places = placed(y, self.nodes, np.arange(6)[part, None], columns)
            rows, constants = np.array([self._first + number]), limit * np.eye(1, 1 + y.size)
            none = np.zeros((1, 1 + y.size, 0))
            ones = np.ones(y.size)
            cones.append(Cones(rows, none, constants, places=places, entries=ones))
        return cones
