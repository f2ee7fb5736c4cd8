"""Rotations between J2000, the asteroid's body-fixed frame and the Sun-North frame.

A matrix named `a_to_b` maps components in frame a to components in frame b.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array
from scp_recon.bodies.catalogue import DAY_S, J2000_TDB
from scp_recon.bodies.files import AttitudeTable


def unit(vector: npt.ArrayLike) -> Array:
    """Unit vectors along the last axis."""
    vector = np.asarray(vector, dtype=float)
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def sun_north_to_j2000(sun_direction: Array, pole: Array) -> Array:
    """Rotation from Sun-North (X to the Sun, Z towards the spin pole) to J2000, shape (3, 3).

    Both arguments are unit vectors, J2000, and not parallel.
    """
    x = unit(sun_direction)
    y = unit(np.cross(pole, x))
    return np.stack([x, y, np.cross(x, y)], axis=1)


@dataclass(frozen=True)
class Rotation:
    """Uniform rotation of a body by the IAU convention; or of one a flight, by arrays of angles.

    Attributes:
        pole_ra, pole_dec: right ascension and declination of the pole, rad, J2000.
        meridian: angle W of the prime meridian at `t = 0`, rad.
        rate: dW/dt at `t = 0`, rad/s.
        acceleration: d2W/dt2, rad/s^2.
    """

    pole_ra: float
    pole_dec: float
    meridian: float
    rate: float
    acceleration: float

    @classmethod
    def from_iau(
        cls,
        pole_ra_deg: float,
        pole_dec_deg: float,
        w_deg: tuple[float, float, float],
        tdb: datetime,
    ) -> Rotation:
        """Rotation at `tdb` by W = w0 + w1 d + w2 d^2 in degrees, d in TDB days past J2000."""
        d = (tdb - J2000_TDB).total_seconds() / DAY_S
        w0, w1, w2 = w_deg
        return cls(
            pole_ra=np.deg2rad(pole_ra_deg),
            pole_dec=np.deg2rad(pole_dec_deg),
            meridian=np.deg2rad((w0 + w1 * d + w2 * d**2) % 360.0),
            rate=np.deg2rad(w1 + 2.0 * w2 * d) / DAY_S,
            acceleration=np.deg2rad(2.0 * w2) / DAY_S**2,
        )

    @property
    def period_h(self) -> float:
        """Time of a turn at `t = 0`, either way; infinite without one."""
        return 2.0 * np.pi / abs(self.rate) / 3600.0 if self.rate else np.inf

    @property
    def pole(self) -> Array:
        """Unit vector of the spin pole, J2000."""
        # A column in a row: products with a strided vector round otherwise than with its copy.
        return self.body_to_j2000(0.0)[..., :, 2].copy()

    def body_to_j2000(self, time_s: Any) -> Array:
        """Rotation matrices at times after the epoch, shape (..., 3, 3).

        The transpose of R3(W) R1(90 deg - dec) R3(90 deg + ra), Archinal et al. 2018, fig. 1.
        """
        w = self.angle(np.asarray(time_s, dtype=float))[..., None]
        c, s = np.cos(w), np.sin(w)
        node, across, pole = self.equator
        x = c * node + s * across
        y = -s * node + c * across
        return np.stack([x, y, np.broadcast_to(pole, x.shape)], axis=-1)

    @cached_property
    def equator(self) -> Array:
        """Node of the equator on J2000's, a quarter turn on, and pole, as rows of shape (3, ..., 3)."""
        ra, dec = np.broadcast_arrays(self.pole_ra, self.pole_dec)
        node = np.stack([-np.sin(ra), np.cos(ra), np.zeros(ra.shape)], axis=-1)
        pole = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)
        return np.stack([node, np.cross(pole, node), pole])

    def angle(self, time: Any) -> Any:
        """Angle W of the prime meridian at times, arrays or symbols alike, rad."""
        return self.meridian + self.rate * time + 0.5 * self.acceleration * time**2

    def in_units(self, time: float) -> Rotation:
        """The same rotation by times in units of `time`."""
        return replace(self, rate=self.rate * time, acceleration=self.acceleration * time**2)


@dataclass(frozen=True)
class TabulatedRotation(Rotation):
    """A body that turns as a table of attitudes says; angles and rate are those at the epoch.

    Attributes:
        table: of attitudes.
        epoch_s: time zero in the table, s.
        unit_s: of times, s.
    """

    table: AttitudeTable
    epoch_s: float
    unit_s: float = 1.0

    @classmethod
    def from_table(cls, table: AttitudeTable, tdb: datetime) -> TabulatedRotation:
        """The rotation with `tdb` as time zero."""
        seconds = (tdb - J2000_TDB).total_seconds()
        ra, dec, meridian, rate = np.deg2rad(table.iau(seconds / DAY_S)).tolist()
        return cls(ra, dec, meridian, rate / DAY_S, 0.0, table, seconds)

    def body_to_j2000(self, time_s: Any) -> Array:
        """Rotation matrices at times, shape (..., 3, 3); raises InputError outside the table."""
        times = np.asarray(time_s, dtype=float)
        return self.table.matrix(self.epoch_s + self.unit_s * times)

    def in_units(self, time: float) -> TabulatedRotation:
        """The same rotation by times in units of `time`."""
        return replace(self, rate=self.rate * time, unit_s=self.unit_s * time)
