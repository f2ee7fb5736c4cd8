"""Describe firing times as controls: which burns move, the rules, and how a grid follows them.

Nodes between two fixed nodes move with the burns between these, in proportion, so that every leg keeps
its number of arcs. The times of all nodes are therefore affine in the firing times.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from formulations.arrays import Array, Indices

UNIT = 0.05
"""Time by which a unit of a control moves a burn: the trust region's scale. Means are bilinear in burns
and times, and after a step of a whole unit of time the linear model would say nothing."""


@dataclass(frozen=True, eq=False)
class FiringTimes:
    """Times of some burns, which may move as long as matrix t >= least.

    Attributes:
        burns: numbers of these burns, ascending; neither at the first nor at the last node; shape (q,).
        nodes: times of the grid's nodes before any burn has moved, shape (n_nodes,).
        shares: derivative of these times by the firing times, shape (n_nodes, q).
        matrix: of the rules, shape (r, q).
        least: shape (r,).
        names: of the rules, r of them.
    """

    burns: Indices
    nodes: Array
    shares: Array
    matrix: Array
    least: Array
    names: tuple[str, ...]

    @classmethod
    def on_grid(
        cls,
        burns: Indices,
        nodes: Array,
        burn_nodes: Indices,
        fixed: Indices,
        rules: tuple[Array, Array, tuple[str, ...]],
    ) -> Self:
        """Firing times on a grid whose `fixed` nodes stay, as do those of burns that do not move.

        Args:
            burns: that move.
            nodes: times of the nodes.
            burn_nodes: node of every burn of the problem.
            fixed: further nodes that stay; the first and the last always do.
            rules: matrix, least values and names.
        """
        marks = np.unique(np.r_[0, burn_nodes, fixed, len(nodes) - 1])
        own = (marks[:, None] == burn_nodes[burns]).astype(float)
        columns = [np.interp(nodes, nodes[marks], one) for one in own.T]
        return cls(burns, nodes, np.reshape(columns, (-1, len(nodes))).T, *rules)

    def at(self, times: Array) -> Array:
        """Times of the nodes, shape (n_nodes,), for firing times (q,)."""
        moving = self.shares.argmax(axis=0)
        return self.nodes + self.shares @ (times - self.nodes[moving])

    def slack(self, times: Array) -> Array:
        """How much later or earlier each rule lets the burns be, >= 0 where it holds, shape (r,)."""
        return self.matrix @ times - self.least
