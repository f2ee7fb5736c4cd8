"""The camera whose view the report lays on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Camera:
    """A round field of view about the boresight, in which the site is kept.

    The default is the DARE SmallSat's in NASA MuSCAT: 21 deg over 5120 pixels.

    Attributes:
        field_deg: full angle.
        pixels: across it.
    """

    field_deg: float = 21.0
    pixels: int = 5120

    @property
    def half_angle_rad(self) -> float:
        """Of the cone of view."""
        return float(np.deg2rad(0.5 * self.field_deg))

    @property
    def pixel_rad(self) -> float:
        """Angle that a pixel sees."""
        return float(np.deg2rad(self.field_deg)) / self.pixels

    def __str__(self) -> str:
        """In words."""
        return f"camera of {self.field_deg:g} deg and {self.pixels} pixels across"
