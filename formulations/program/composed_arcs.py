"""Arcs between chosen nodes, composed from the grid's, with the STMs' dependence on the mean.

Of the lifted form, which keeps mean and factor as variables on some of the nodes only.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from formulations.linearisation.linearisation import Linearisation, require_finite
from formulations.problem.flyby import Nodes
from formulations.problem.regions import Array


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
    require_finite(composed.stm, composed.shift, composed.shift_stm, composed.tensor)
    return composed
