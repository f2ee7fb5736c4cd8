"""Derivatives of forces by uncertain parameters.

By the strengths of forces they are central differences between force models. Where the body turns by a
small angle t, its gravity turns with it: with acceleration a, gradient G and curvature H at x,

    da = t x a - G (t x x),        dG = [t] G - G [t] - H (t x x),

so that one evaluation of gravity serves all parameters of pole and spin.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from formulations.arrays import Array, Indices
from scp_recon.physics.forces import ForceModel, accelerations, gravity_curvature, gravity_gradient
from scp_recon.physics.frames import Rotation

STEP = 1e-3
"""Half the distance of two models, in standard deviations: gravity is linear in most parameters, and
cubic terms of angles of degrees are below 1e-9."""


@dataclass(frozen=True, eq=False)
class Partials:
    """Force models and rotations ahead and behind along p parameters, by `STEP` sigma each.

    Attributes:
        ahead, behind: models of the parameters that act on strengths of forces.
        columns: numbers of these among all parameters.
        turns: rotations of the body ahead and behind, of the parameters that turn it.
        turning: numbers of these.
        gravity: the mean gravity that turns with the body.
        count: number p of all parameters.
    """

    ahead: tuple[ForceModel, ...]
    behind: tuple[ForceModel, ...]
    columns: Indices
    turns: tuple[tuple[Rotation, Rotation], ...]
    turning: Indices
    gravity: ForceModel
    count: int

    def in_units(self, length: float, time: float) -> Partials:
        """The same measured in units of `length` and `time`."""
        ahead, behind = (
            tuple(one.in_units(length, time) for one in side) for side in (self.ahead, self.behind)
        )
        turns = tuple((one.in_units(time), other.in_units(time)) for one, other in self.turns)
        gravity = self.gravity.in_units(length, time)
        return replace(self, ahead=ahead, behind=behind, turns=turns, gravity=gravity)

    def accelerations(self, position: Array, time: Array) -> Array:
        """Derivatives of the accelerations at positions (n, 3) and times (n,), shape (n, 3, p)."""
        found = np.zeros((*position.shape, self.count))
        for column, ahead, behind in zip(self.columns, self.ahead, self.behind, strict=True):
            a, b = (accelerations(position.T, one, one.moment(time)) for one in (ahead, behind))
            found[:, :, column] = (a - b).T / (2.0 * STEP)
        if self.turns:
            moment = self.gravity.moment(time)
            pull = accelerations(position.T, self.gravity, moment).T
            gradient = gravity_gradient(position, self.gravity, moment)
            for column, turn in zip(self.turning, self._small_turns(time), strict=True):
                moved = turn @ position[:, :, None]
                found[:, :, column] += (turn @ pull[:, :, None] - gradient @ moved)[:, :, 0]
        return found

    def gradients(self, position: Array, time: Array) -> Array:
        """Derivatives of the gravity gradients at positions (n, 3), times (n,), shape (n, p, 3, 3)."""
        found = np.zeros((len(position), self.count, 3, 3))
        for column, ahead, behind in zip(self.columns, self.ahead, self.behind, strict=True):
            a, b = (gravity_gradient(position, one, one.moment(time)) for one in (ahead, behind))
            found[:, column] = (a - b) / (2.0 * STEP)
        if self.turns:
            moment = self.gravity.moment(time)
            gradient = gravity_gradient(position, self.gravity, moment)
            curvature = gravity_curvature(position, self.gravity, moment)
            for column, turn in zip(self.turning, self._small_turns(time), strict=True):
                moved, turned = turn @ position[:, :, None], turn @ gradient
                found[:, column] += turned + turned.transpose(0, 2, 1)
                found[:, column] -= (curvature @ moved[:, None])[:, :, :, 0]
        return found

    def _small_turns(self, time: Array) -> Iterator[Array]:
        """Matrices [t] of the body's turn along each parameter, shape (n, 3, 3), or (1, 3, 3)."""
        for sides in self.turns:
            if self.gravity.field is None:  # J2 turns with the pole alone
                one, other = (side.pole for side in sides)
                across = np.outer(one - other, 0.5 * (one + other))
                yield (across - across.T)[None] / (2.0 * STEP)
            else:
                one, other = (side.body_to_j2000(time) for side in sides)
                yield (one - other) @ (one + other).transpose(0, 2, 1) / (4.0 * STEP)
