"""Describe the policy of corrected burns: measurements before each burn, and gains on them.

At the cut-off before a corrected burn the state is measured, with errors independent from cut-off
to cut-off. A linear Kalman filter along the plan turns the measurement into an innovation xi ~ N(0,
I_6), independent of all earlier ones. The commanded burn is its nominal value plus gains times all
innovations until then,

    dv_i + U_i0 xi_0 + ... + U_ij xi_j,    j the cut-off of burn i,

Gains are velocities, as burns are. The sum of squares of a burn's gains is the variance of its
correction.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from formulations.arrays import Array, Indices

Cost = Literal["nominal", "expected", "dv99"]
"""Of the burns' sizes summed: the plan's own, the mean, or the 99 % quantile."""


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
