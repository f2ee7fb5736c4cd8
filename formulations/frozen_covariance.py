"""Frozen covariance: propagated with the previous iterate, not a variable.

The solver then does not know that smaller or other burns shrink the spread. It exists to be
compared against.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from formulations.condensed import Condensed
from formulations.lifting import Linearisation, Sensitivity


class FrozenCovariance(Condensed):
    """Condensed with the factor a constant."""

    def sensitivity(self, lin: Linearisation) -> Sensitivity:
        """The affine map with dS = 0."""
        full = super().sensitivity(lin)
        return replace(
            full,
            factor_constant=lin.factor,
            factor_jacobian=np.zeros_like(full.factor_jacobian),
        )
