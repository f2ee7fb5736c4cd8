"""Estimate the attitude by a multiplicative Kalman filter on gyro, star tracker and Sun sensors.

Basilisk's filters estimate the Sun's direction alone, or predict with the wheels' torques and miss
slews on thrusters; here the gyro propagates the attitude from sample to sample.
Markley and Crassidis, Fundamentals of Spacecraft Attitude Determination and Control, section 6.2.
Quaternions are unit, scalar first, from the body to J2000, as plain numbers: SciPy's rotations take
twenty times as long one by one.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin, sqrt

import numpy as np

from formulations.arrays import Array


@dataclass(frozen=True)
class SensorSigmas:
    """1-sigma of the tracker and the gyro's increments, rad, and of the Sun sensors' cosines."""

    star_tracker: float
    gyro: float
    sun_sensor: float


class AttitudeFilter:
    """Attitude, and the covariance of its error in the body frame, rad^2, shape (3, 3).

    The first quaternion, shape (4,), is known to `sigma` about each axis, rad.
    """

    def __init__(self, quaternion: Array, sigmas: SensorSigmas, sigma: float) -> None:
        self.quaternion, self.sigmas = quaternion, sigmas
        self.covariance: Array = sigma**2 * np.eye(3)

    @property
    def to_j2000(self) -> Array:
        """Rotation matrix from the body to J2000, shape (3, 3)."""
        return matrix(self.quaternion)

    @property
    def mrp(self) -> Array:
        """Modified Rodrigues parameters of at most length one, shape (3,)."""
        q = self.quaternion if self.quaternion[0] >= 0.0 else -self.quaternion
        return q[1:] / (1.0 + q[0])

    def turn(self, increment: Array) -> None:
        """Propagate with the gyro's rotation vector since the last call, body frame, rad."""
        step = from_rotation_vector(increment)
        self.quaternion = product(self.quaternion, step)
        transition = matrix(step).T
        self.covariance = transition @ self.covariance @ transition.T
        self.covariance += self.sigmas.gyro**2 * np.eye(3)

    def see(self, stars: Array | None, cosines: Array, boresights: Array, sun: Array) -> None:
        """Update with the measurements of star tracker and Sun sensors.

        A Sun sensor that contradicts the prediction by `GATE_SIGMA`, as in a shadow, is left out.

        Args:
            stars: measured attitude, shape (4,); None without one.
            cosines: between the Sun and the boresights of the Sun sensors that see it, shape (n,).
            boresights: of these, body frame, shape (n, 3).
            sun: unit vector to the Sun, J2000.
        """
        sun_body = self.to_j2000.T @ sun
        innovation = cosines - boresights @ sun_body
        # A small rotation e of the body moves the Sun by s x e.
        sensitivity = boresights @ cross_matrix(sun_body)
        variance = np.full(len(cosines), self.sigmas.sun_sensor**2)
        spread = np.einsum("ni,ij,nj->n", sensitivity, self.covariance, sensitivity) + variance
        credible = innovation**2 <= GATE_SIGMA**2 * np.maximum(spread, VARIANCE_MIN)
        innovation, sensitivity, variance = (
            x[credible] for x in (innovation, sensitivity, variance)
        )
        if stars is not None:
            error = product(self.quaternion * np.array([1.0, -1.0, -1.0, -1.0]), stars)
            innovation = np.append(2.0 * np.sign(error[0]) * error[1:], innovation)
            sensitivity = np.vstack([np.eye(3), sensitivity])
            variance = np.append(np.full(3, self.sigmas.star_tracker**2), variance)
        self._update(innovation, sensitivity, np.maximum(variance, VARIANCE_MIN))

    def _update(self, innovation: Array, sensitivity: Array, variance: Array) -> None:
        """Kalman's update in Joseph's form."""
        weighted = sensitivity @ self.covariance
        gain = np.linalg.solve(weighted @ sensitivity.T + np.diag(variance), weighted).T
        self.quaternion = product(self.quaternion, from_rotation_vector(gain @ innovation))
        rest = np.eye(3) - gain @ sensitivity
        self.covariance = rest @ self.covariance @ rest.T + gain * variance @ gain.T


GATE_SIGMA = 6.0
"""Largest innovation accepted; by chance it is exceeded once in 5e8 readings."""

VARIANCE_MIN = 1e-18
"""Variance added so that the gain of a perfect sensor is defined, rad^2."""


def product(p: Array, q: Array) -> Array:
    """Hamilton product, normalised, shape (4,)."""
    a, b, c, d = p.tolist()
    w, x, y, z = q.tolist()
    s = a * w - b * x - c * y - d * z
    i = a * x + b * w + c * z - d * y
    j = a * y - b * z + c * w + d * x
    k = a * z + b * y - c * x + d * w
    return np.array([s, i, j, k]) / sqrt(s * s + i * i + j * j + k * k)


def from_rotation_vector(vector: Array) -> Array:
    """Quaternion of a rotation about a vector by its length in rad, shape (4,)."""
    x, y, z = vector.tolist()
    half = 0.5 * sqrt(x * x + y * y + z * z)
    scale = 0.5 * sin(half) / half if half > 0.0 else 0.5
    return np.array([cos(half), scale * x, scale * y, scale * z])


def matrix(q: Array) -> Array:
    """Rotation matrix of a unit quaternion, shape (3, 3)."""
    v = cross_matrix(q[1:])
    return np.eye(3) + 2.0 * q[0] * v + 2.0 * v @ v


def cross_matrix(vector: Array) -> Array:
    """Matrix that multiplies like the cross product with a vector, shape (3, 3)."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
