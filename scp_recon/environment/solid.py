"""Volume, centre and moments of inertia of a mesh whose inside is homogeneous."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scp_recon.environment.surface import Mesh

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Solid:
    """What is inside a closed mesh.

    Attributes:
        volume_m3: negative where the facets turn inward, as a mirror makes them.
        centre_m: body-fixed, shape (3,).
        inertia_m2: about the centre, over the mass; symmetric, shape (3, 3).
    """

    volume_m3: float
    centre_m: Array
    inertia_m2: Array

    @classmethod
    def of(cls, mesh: Mesh) -> Solid:
        """Sums over the tetrahedra of facets and origin: Tonon 2004, J. Math. Stat. 1 (1).

        Raises:
            ValueError: if there is no volume.
        """
        corners = mesh.vertices_m[mesh.facets]
        volumes = np.linalg.det(corners) / 6.0
        volume = float(volumes.sum())
        if abs(volume) <= 1e-9 * float(np.ptp(mesh.vertices_m, axis=0).prod()):
            raise ValueError("no volume")
        sums = corners.sum(axis=1)
        centre = volumes @ sums / (4.0 * volume)
        # Of a tetrahedron with a corner in the origin: the integral of x x' is V / 20 times this.
        products = np.einsum("nki,nkj->nij", corners, corners) + np.einsum("ni,nj->nij", sums, sums)
        second = np.tensordot(volumes, products, 1) / (20.0 * volume) - np.outer(centre, centre)
        return cls(volume, centre, np.trace(second) * np.eye(3) - second)

    @property
    def radius_m(self) -> float:
        """Of the sphere of the same volume."""
        return float(np.cbrt(3.0 * abs(self.volume_m3) / (4.0 * np.pi)))
