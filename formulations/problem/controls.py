"""Describe the controls beside the burns: gains of corrected burns, firing times and phases.

At the cut-off before a corrected burn the state is measured, with errors independent from cut-off
to cut-off. A linear Kalman filter along the plan turns the measurement into an innovation xi ~ N(0,
I_6), independent of all earlier ones. The commanded burn is its nominal value plus gains times all
innovations until then,

    dv_i + U_i0 xi_0 + ... + U_ij xi_j,    j the cut-off of burn i.

Gains are velocities, as burns are. The sum of squares of a burn's gains is the variance of its
correction.

Firing times and phases move within rules. Nodes between two fixed nodes move with the burns between
these, in proportion, so that every leg keeps its number of arcs. The times of all nodes are
therefore affine in the firing times. Where the first or the last burn moves, the boundary state
stays what it is and holds at another time; phases move boundary states along an orbit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Self

import numpy as np

from formulations.arrays import Array, Indices

Cost = Literal["nominal", "expected", "dv99"]
"""Kinds of cost by the sum of the burns' sizes: the plan's own, the mean, the 99 % quantile."""


@dataclass(frozen=True, eq=False)
class Feedback:
    """The k corrected burns of a problem, with their measurements, cost and probability.

    Examples:
        >>> burns, cut_offs = np.array([1, 2]), np.array([5, 9])
        >>> Feedback(burns, cut_offs, np.array([np.eye(6)] * 2), "dv99", 0.99).size
        54

    Attributes:
        burns: numbers of the corrected burns from 0, ascending, shape (k,).
        cut_offs: node at which the state is measured before each, ascending, shape (k,); that of the
            burn itself if it is measured just before it.
        measurement: factors N of the measurements' errors, with N N' the covariance, shape (k, 6, 6).
        cost: of the burns' sizes, which is minimised.
        probability: with which a corrected burn keeps each limit on burns.
        considers: whether the filter that flies does not estimate uncertain parameters, and allows for
            their errors alone. Gains on all its estimates so far can do what they can do on those of
            the best filter, so plans are made with the innovations of the latter.
    """

    burns: Indices
    cut_offs: Indices
    measurement: Array
    cost: Cost
    probability: float
    considers: bool = False

    @cached_property
    def first_gain(self) -> Indices:
        """Index of each corrected burn's first gain, and the number of gains, shape (k + 1,)."""
        return np.cumsum([0, *(18 * (j + 1) for j in range(len(self.burns)))])

    @property
    def size(self) -> int:
        """Number of gains."""
        return int(self.first_gain[-1])

    def of_burn(self, gains: Array, j: int) -> Array:
        """Gains of the corrected burn j on the innovations known to it, shape (3, 6 (j + 1))."""
        return gains[self.first_gain[j] : self.first_gain[j + 1]].reshape(3, -1)


UNIT = 0.05
"""Time or phase by which a unit of a control moves: the trust region's scale. Means are bilinear in
burns and times, and after a step of a whole unit of time the linear model would say nothing."""

DIFFERENCE = 1e-5
"""Step of the central differences of boundary states by phase, rad."""


@dataclass(frozen=True, eq=False)
class Boundary:
    """Boundary states by phase, where one or both of the phases are controls.

    Attributes:
        first: state (6,) and covariance factor (6, c) before the first burn, by its phase in rad.
        last: state (6,) after the last burn.
        phases: of both before any has moved.
        free: numbers of the phases that move, 0 and 1, ascending.
    """

    first: Callable[[float], tuple[Array, Array]]
    last: Callable[[float], Array]
    phases: tuple[float, float]
    free: tuple[int, ...]

    def slopes(self, phases: Array) -> tuple[Array, Array, Array]:
        """Derivatives at phases (2,): of the first state and factor by the first, and of the last."""
        ahead, behind = (self.first(phases[0] + side * DIFFERENCE) for side in (1, -1))
        ends = [self.last(phases[1] + side * DIFFERENCE) for side in (1, -1)]
        pairs = (*zip(ahead, behind, strict=True), ends)
        first, factor, last = ((a - b) / (2.0 * DIFFERENCE) for a, b in pairs)
        return first, factor, last


@dataclass(frozen=True, eq=False)
class FiringTimes:
    """Times of some burns and phases, t (q,), which may move as long as matrix t >= least.

    Attributes:
        burns: numbers of these burns, ascending; their times come first in t.
        nodes: times of the grid's nodes before any burn has moved, shape (n_nodes,).
        shares: derivative of these times by t, shape (n_nodes, q).
        matrix: of the rules, shape (r, q).
        least: shape (r,).
        names: of the rules, r of them.
        boundary: states by phase; None if these are given.
    """

    burns: Indices
    nodes: Array
    shares: Array
    matrix: Array
    least: Array
    names: tuple[str, ...]
    boundary: Boundary | None = None

    @classmethod
    def on_grid(
        cls,
        burns: Indices,
        nodes: Array,
        burn_nodes: Indices,
        fixed: Indices,
        rules: tuple[Array, Array, tuple[str, ...]],
        boundary: Boundary | None = None,
        cut_offs: Mapping[int, int] | None = None,
    ) -> Self:
        """Firing times on a grid whose `fixed` nodes stay, as do those of burns that do not move.

        Args:
            burns: that move.
            nodes: times of the nodes.
            burn_nodes: node of every burn of the problem.
            fixed: further nodes that stay; the first and the last do unless a burn there moves.
            rules: matrix, least values and names.
            boundary: states by phase, if any is free.
            cut_offs: nodes that move along with burns, by the numbers of these.
        """
        along = cut_offs or {}
        marks = np.unique(np.r_[0, burn_nodes, fixed, list(along.values()), len(nodes) - 1])
        marks = marks.astype(np.intp)
        follow = np.array([along.get(int(burn), burn_nodes[burn]) for burn in burns], np.intp)
        own = (marks[:, None] == burn_nodes[burns]) | (marks[:, None] == follow)
        columns = [np.interp(nodes, nodes[marks], one) for one in own.T.astype(float)]
        columns += [np.zeros(len(nodes))] * (len(boundary.free) if boundary else 0)
        return cls(burns, nodes, np.reshape(columns, (-1, len(nodes))).T, *rules, boundary)

    @cached_property
    def start(self) -> Array:
        """Times and phases before any has moved, shape (q,)."""
        # A burn is the last of the nodes that move as it does: its cut-off comes before.
        last = self.shares[::-1, : len(self.burns)].argmax(axis=0)
        times = self.nodes[len(self.nodes) - 1 - last]
        free = (
            [] if self.boundary is None else [self.boundary.phases[i] for i in self.boundary.free]
        )
        return np.r_[times, free]

    def owners(self, last: int) -> Indices:
        """Burn to which each control belongs, shape (q,); `last` is the number of the last burn."""
        free = () if self.boundary is None else self.boundary.free
        return np.r_[self.burns, [(0, last)[i] for i in free]].astype(np.intp)

    def phases(self, times: Array) -> Array:
        """Both phases of the boundary, shape (2,), for times and phases (q,)."""
        assert self.boundary is not None
        phases = np.array(self.boundary.phases)
        phases[list(self.boundary.free)] = times[len(self.burns) :]
        return phases

    def at(self, times: Array) -> Array:
        """Times of the nodes, shape (n_nodes,), for times and phases (q,)."""
        return self.nodes + self.shares @ (times - self.start)

    def slack(self, times: Array) -> Array:
        """How far each rule lets burns and phases move, >= 0 where it holds, shape (r,)."""
        return self.matrix @ times - self.least
