"""Locate a second body on its Kepler orbit about the first."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array
from scp_recon.bodies.catalogue import eccentric_anomaly
from scp_recon.physics.frames import Rotation
from scp_recon.scenario import body


@dataclass(frozen=True, eq=False)
class Companion:
    """A second body, in any consistent units; time zero is the epoch.

    Attributes:
        gm: gravitational parameter.
        semi_major_axis: of its orbit about the first body's centre.
        eccentricity: of that orbit.
        mean_anomaly: at `t = 0`, rad.
        rate: mean motion, rad per time.
        axes: unit vectors to the periapsis and a quarter turn ahead, inertial, shape (2, 3).
    """

    gm: float
    semi_major_axis: float
    eccentricity: float
    mean_anomaly: float
    rate: float
    axes: Array

    @classmethod
    def of(cls, given: body.Companion, tdb: datetime) -> Companion:
        """The companion of a scenario's table at `tdb`, SI."""
        rate = 2.0 * np.pi / (3600.0 * given.period_h)
        passed = rate * (tdb - given.epoch_tdb).total_seconds()
        ra, dec, periapsis, anomaly = np.deg2rad(
            [given.pole_ra_deg, given.pole_dec_deg, given.periapsis_deg, given.mean_anomaly_deg]
        )
        plane = Rotation(ra, dec, periapsis, 0.0, 0.0).body_to_j2000(0.0)[:, :2].T.copy()
        anomaly = float((anomaly + passed) % (2.0 * np.pi))
        size = given.semi_major_axis_m
        return cls(given.gm_m3_s2, size, given.eccentricity, anomaly, rate, plane)

    def position(self, time: npt.ArrayLike) -> Array:
        """Position of its centre from that of the first body at times, shape (..., 3)."""
        mean = self.mean_anomaly + self.rate * np.asarray(time, dtype=float)
        e = self.eccentricity
        anomaly = eccentric_anomaly(mean, e)
        along = np.stack([np.cos(anomaly) - e, np.sqrt(1.0 - e * e) * np.sin(anomaly)], axis=-1)
        return np.asarray(self.semi_major_axis * along @ self.axes)

    def in_units(self, length: float, time: float) -> Companion:
        """The same measured in units of `length` and `time`."""
        return replace(
            self,
            gm=self.gm * time**2 / length**3,
            semi_major_axis=self.semi_major_axis / length,
            rate=self.rate * time,
        )
