"""Frozen STM: the factor moves with the burns, but the STMs do not move with the mean.

Sequential convex programming with it stops at points that do not solve P2; it exists to be compared
against.
"""

from __future__ import annotations

from formulations.lifting import Linearisation, Sensitivity, condense
from formulations.problem import Nodes


def condense_frozen_stm(lin: Linearisation, nodes: Nodes, *, factor: bool) -> Sensitivity:
    """The affine map with dA/dx = 0; arguments as for `condense`."""
    return condense(lin, nodes, factor=factor, curvature=False)
