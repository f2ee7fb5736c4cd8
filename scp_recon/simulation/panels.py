"""Compute the power of the solar panels, and the attitude of largest power about an axis.

The power of panels with normals n_i and peak powers p_i under a Sun in the direction s is
sum_i p_i max(0, n_i . s) = max over subsets S of (sum_S p_i n_i) . s: the support function of a
zonotope. A maximum over rotations is therefore a maximum over the sums of subsets, in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from formulations.arrays import Array
from scp_recon.bodies.catalogue import AU_KM
from scp_recon.physics.frames import unit
from scp_recon.scenario.schema import Scenario
from scp_recon.simulation.vehicle import Vehicle

PANELS_MAX = 16
"""More panels would have too many subsets."""


@dataclass(frozen=True)
class SolarArray:
    """At most 16 flat panels on a rigid body, under a given Sun.

    `normals` point out of the cells, body frame, shape (n, 3); `peak_w` is the power with the Sun
    along each, W.
    """

    normals: Array
    peak_w: Array

    def __post_init__(self) -> None:
        """Check the number of panels."""
        if not 0 < len(self.normals) <= PANELS_MAX:
            raise ValueError(f"got {len(self.normals)} panels, expected 1 to {PANELS_MAX}")

    @classmethod
    def of(cls, vehicle: Vehicle, irradiance_w_m2: float) -> SolarArray:
        """A vehicle's panels; p_i = irradiance x area x packing x efficiency."""
        cells = vehicle.panels.packing * vehicle.panels.efficiency
        panels = vehicle.panels.panel
        areas_m2 = np.array([panel.area_m2 for panel in panels])
        return cls(unit([panel.normal for panel in panels]), irradiance_w_m2 * cells * areas_m2)

    def generation(self, sun_body: Array) -> Array:
        """Power of each panel, W, (..., n), for unit vectors to the Sun, body frame, (..., 3)."""
        return self.peak_w * np.maximum(0.0, sun_body @ self.normals.T)

    @cached_property
    def _sums(self) -> Array:
        """Sum of p_i n_i over every subset, shape (2^n, 3)."""
        chosen = np.arange(2 ** len(self.normals))[:, None] >> np.arange(len(self.normals)) & 1
        return chosen @ (self.peak_w[:, None] * self.normals)

    def best_direction(self) -> Array:
        """Body direction of largest power when it faces the Sun; its length is that power, W."""
        sums = self._sums
        return sums[np.argmax(np.linalg.norm(sums, axis=1))]

    def best_about(self, axis_body: Array, sun_angle: Array) -> Array:
        """Largest power, W, over all rotations about an axis that is held in space.

        The unit axis (3,) is in the body frame; angles between it and the Sun are in rad, of any shape.
        With the subset's sum split into N along the axis and M across it, the Sun at an angle t from
        the axis gives N cos t + |M| sin t once M is turned to the Sun.
        """
        along, across = self._split(axis_body)
        angle = np.asarray(sun_angle)[..., None]
        power = along * np.cos(angle) + np.linalg.norm(across, axis=1) * np.sin(angle)
        return power.max(axis=-1)

    def best_roll(self, axis_body: Array, sun_angle: float) -> Array:
        """Unit vector across the axis that the best rotation turns to the Sun's side, shape (3,).

        Any vector across will do, and one is returned, where no panel faces away from the axis.
        """
        along, across = self._split(axis_body)
        size = np.linalg.norm(across, axis=1)
        best = int(np.argmax(along * np.cos(sun_angle) + size * np.sin(sun_angle)))
        if size[best] == 0.0:
            other = np.cross(axis_body, np.eye(3)[np.argmin(np.abs(axis_body))])
            return other / np.linalg.norm(other)
        return across[best] / size[best]

    def _split(self, axis_body: Array) -> tuple[Array, Array]:
        along = self._sums @ axis_body
        return along, self._sums - along[:, None] * axis_body


def irradiance(scenario: Scenario) -> float:
    """Power of sunlight per area at the asteroid, W/m^2; over a flight it changes by 1e-4."""
    distance_au = float(np.linalg.norm(scenario.sun.body_position_km)) / AU_KM
    return scenario.sun.solar_constant_w_m2 / distance_au**2


def align(axis_body: Array, axis: Array, side_body: Array, side: Array) -> Array:
    """Attitude with one body axis along a direction and another turned as far as possible to a second.

    The TRIAD construction; exact in the first pair.

    Args:
        axis_body: unit vector, body frame, shape (3,).
        axis: where it is to point, unit vectors in the inertial frame, shape (..., 3).
        side_body: vector not parallel to `axis_body`, body frame, shape (3,).
        side: where its part across the axis is to point, shape (..., 3). Where it is parallel to the
            axis any rotation about it is as good, and one is returned.

    Returns:
        Matrices from the body to the inertial frame, shape (..., 3, 3).
    """
    axis = np.asarray(axis)
    return _triad(axis, np.asarray(side)) @ _triad(axis_body, side_body).T


def _triad(axis: Array, side: Array) -> Array:
    """Orthonormal columns: the axis, the part of `side` across it, their cross product."""
    across = side - np.einsum("...i,...i->...", side, axis)[..., None] * axis
    size = np.linalg.norm(across, axis=-1, keepdims=True)
    # Without a part across the axis the coordinate axis farthest from it stands in.
    spare = np.eye(3)[np.argmin(np.abs(axis), axis=-1)]
    spare = spare - np.einsum("...i,...i->...", spare, axis)[..., None] * axis
    across = np.where(size > PARALLEL * np.linalg.norm(side, axis=-1, keepdims=True), across, spare)
    across = across / np.linalg.norm(across, axis=-1, keepdims=True)
    return np.stack([axis, across, np.cross(axis, across)], axis=-1)


PARALLEL = 1e-12
"""Sine of the angle below which two directions count as parallel."""
