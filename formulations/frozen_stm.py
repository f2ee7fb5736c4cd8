"""Frozen STM: the factor moves with the burns, but the STMs do not move with the mean.

Sequential convex programming with it stops at points that do not solve P2; it exists to be compared
against.
"""

from __future__ import annotations

from formulations.condensed import Condensed
from formulations.lifting import Linearisation, Sensitivity, condense


class FrozenStm(Condensed):
    """Condensed without the second-order term."""

    def sensitivity(self, lin: Linearisation) -> Sensitivity:
        """The affine map with dA/dx = 0."""
        return condense(lin, curvature=False)
