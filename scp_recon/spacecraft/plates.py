"""Solar radiation pressure on flat plates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scp_recon.physics.frames import unit
from scp_recon.spacecraft.vehicle import Vehicle

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Plates:
    """The N-plate model of a rigid body; plates do not shade each other.

    Attributes:
        normals: outward unit vectors, body frame, shape (n, 3).
        areas_m2: shape (n,).
        specular, diffuse: fractions of the light that are reflected like that, shape (n,).
    """

    normals: Array
    areas_m2: Array
    specular: Array
    diffuse: Array

    @classmethod
    def of(cls, vehicle: Vehicle) -> Plates:
        """A vehicle's faces and the cells of its panels."""
        plates = vehicle.plates
        return cls(
            unit([plate.normal for plate in plates]),
            np.array([plate.area_m2 for plate in plates]),
            np.array([plate.specular for plate in plates]),
            np.array([plate.diffuse for plate in plates]),
        )

    def force_per_pressure(self, sun_body: Array) -> Array:
        """Force over the pressure of sunlight, body frame, m^2.

        -sum_i A_i cos_i ((1 - rho_s) s + 2 (rho_s cos_i + rho_d / 3) n_i) over the plates with
        cos_i = n_i . s > 0: Montenbruck & Gill, Satellite Orbits, eq. 3.73, with Lambert's law.

        Args:
            sun_body: unit vectors to the Sun, body frame, shape (..., 3).

        Returns:
            Shape (..., 3).
        """
        cosine = np.maximum(0.0, sun_body @ self.normals.T)
        lit = self.areas_m2 * cosine
        along_sun = (lit * (1.0 - self.specular)).sum(axis=-1, keepdims=True) * sun_body
        reflected = 2.0 * lit * (self.specular * cosine + self.diffuse / 3.0)
        return -along_sun - reflected @ self.normals
