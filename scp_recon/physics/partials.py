"""Derivatives of forces by uncertain parameters, by central differences between force models."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from formulations.arrays import Array, Indices
from scp_recon.physics.forces import ForceModel, accelerations, gravity_gradient

STEP = 1e-3
"""Half the distance of two models, in standard deviations: gravity is linear in most parameters, and
cubic terms of angles of degrees are below 1e-9."""


@dataclass(frozen=True, eq=False)
class Partials:
    """Force models ahead and behind along p uncertain parameters, by `STEP` standard deviations each.

    Attributes:
        ahead, behind: models of the parameters that act on forces.
        columns: numbers of these among all parameters.
        count: number p of all parameters.
    """

    ahead: tuple[ForceModel, ...]
    behind: tuple[ForceModel, ...]
    columns: Indices
    count: int

    def in_units(self, length: float, time: float) -> Partials:
        """The same measured in units of `length` and `time`."""
        ahead, behind = (
            tuple(one.in_units(length, time) for one in side) for side in (self.ahead, self.behind)
        )
        return replace(self, ahead=ahead, behind=behind)

    def accelerations(self, position: Array, time: Array) -> Array:
        """Derivatives of the accelerations at positions (n, 3) and times (n,), shape (n, 3, p)."""
        found = np.zeros((*position.shape, self.count))
        for column, ahead, behind in zip(self.columns, self.ahead, self.behind, strict=True):
            a, b = (accelerations(position.T, one, one.moment(time)) for one in (ahead, behind))
            found[:, :, column] = (a - b).T / (2.0 * STEP)
        return found

    def gradients(self, position: Array, time: Array) -> Array:
        """Derivatives of the gravity gradients at positions (n, 3), times (n,), shape (n, p, 3, 3)."""
        found = np.zeros((len(position), self.count, 3, 3))
        for column, ahead, behind in zip(self.columns, self.ahead, self.behind, strict=True):
            a, b = (gravity_gradient(position, one, one.moment(time)) for one in (ahead, behind))
            found[:, column] = (a - b) / (2.0 * STEP)
        return found
