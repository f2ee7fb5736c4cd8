"""Legs: what the arcs between two burns do together.

A leg starts after one burn and ends before the next; where a flight coasts before its first burn, that
is a leg too. Everything linear that happens along it is a
product of the arcs' matrices from its start, so those products are made once for all nodes.
"""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Nodes = npt.NDArray[np.intp]


class Legs:
    """The legs of a grid.

    Args:
        n_nodes: nodes of the grid.
        starts: nodes at which legs start, and the last node, where a burn ends the last one; ascending
            from 0 to n_nodes - 1.

    Attributes:
        of: leg in which each node is reached, shape (n_nodes,); the first node counts to leg 0.
        ends: node at which each leg ends, shape (legs,).
    """

    def __init__(self, n_nodes: int, starts: Nodes) -> None:
        self.of = np.maximum(np.searchsorted(starts, np.arange(n_nodes)) - 1, 0)
        self.ends = starts[1:]
        length = round(np.sqrt(n_nodes))
        blocks: list[Nodes] = []
        self._continued: list[int] = []
        for first, last in itertools.pairwise(starts.tolist()):
            for start in range(first, last, length):
                arcs = np.arange(start, start + length)
                if start > first:
                    self._continued.append(len(blocks))
                blocks.append(np.where(arcs < last, arcs, n_nodes - 1))
        self._blocks = np.array(blocks)
        self._arcs = self._blocks.ravel() < n_nodes - 1

    def compose(self, maps: Array) -> Array:
        """Products of the arcs' matrices from the start of each node's leg to the node.

        Within blocks of about sqrt(n) arcs, all blocks at a time; then from block to block. Blocks
        that a leg does not fill end in identities.

        Args:
            maps: of the arcs, shape (n_nodes - 1, d, d).

        Returns:
            Shape (n_nodes, d, d); the identity at the first node.
        """
        one = np.eye(maps.shape[-1])[None]
        blocks = np.concatenate([maps, one])[self._blocks]
        for j in range(1, blocks.shape[1]):
            blocks[:, j] = blocks[:, j] @ blocks[:, j - 1]
        for b in self._continued:
            blocks[b] = blocks[b] @ blocks[b - 1, -1]
        return np.concatenate([one, blocks.reshape(-1, *one.shape[1:])[self._arcs]])
