"""Frozen covariance: propagated with the previous iterate, not a variable.

The solver then does not know that smaller or other burns shrink the spread. It exists to be
compared against.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from formulations.lifting import Linearisation, Sensitivity, condense
from formulations.problem import Nodes


def condense_frozen_covariance(lin: Linearisation, nodes: Nodes, *, factor: bool) -> Sensitivity:
    """The affine map with dS = 0; arguments as for `condense`."""
    mean = condense(lin, nodes, factor=False)
    if not factor:
        return mean
    constant = lin.factor[nodes]
    jacobian = np.zeros((*constant.shape, mean.mean_jacobian.shape[-1]))
    return replace(mean, factor_constant=constant, factor_jacobian=jacobian)
