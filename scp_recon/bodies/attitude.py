"""Read the attitudes of a tumbling body from a table in time, and interpolate between its rows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array
from scp_recon.errors import InputError
from scp_recon.files import read_text

ENTRY, COLUMNS = "body.attitude_file", ("tdb_s", "qw", "qx", "qy", "qz")
BYTES_MAX = 2_000_000


@dataclass(frozen=True, eq=False)
class AttitudeTable:
    """A table of attitudes; SciPy's `RotationSpline` interpolates with continuous acceleration.

    Attributes:
        tdb_s: times, TDB past J2000, ascending, shape (n,).
        quaternions: from body-fixed components to J2000, scalar first, shape (n, 4).
    """

    tdb_s: Array
    quaternions: Array

    @cached_property
    def _spline(self) -> Any:
        from scipy.spatial.transform import Rotation, RotationSpline  # what turns evenly needs none

        return RotationSpline(self.tdb_s, Rotation.from_quat(self.quaternions, scalar_first=True))

    def matrix(self, tdb_s: npt.ArrayLike) -> Array:
        """Rotations from body-fixed to J2000 at times, shape (..., 3, 3).

        Raises:
            InputError: before the first row or after the last.
        """
        times = np.asarray(tdb_s, dtype=float)
        first, last = self.tdb_s[0], self.tdb_s[-1]
        if times.size and not first <= times.min() <= times.max() <= last:
            given = f"rows from {first:.0f} to {last:.0f} s of TDB past J2000"
            needed = f"must span {times.min():.0f} to {times.max():.0f} s"
            raise InputError(ENTRY, given, needed)
        return np.asarray(self._spline(times.ravel()).as_matrix()).reshape(*times.shape, 3, 3)

    def spin(self, tdb_s: float) -> Array:
        """Angular velocity at a time, body-fixed, rad/s, shape (3,)."""
        return np.asarray(self._spline(tdb_s, 1))

    def iau(self, days: float) -> tuple[float, float, float, float]:
        """Right ascension and declination of body-fixed z, W and its rate at an epoch; deg, deg/day.

        The rate is the whole spin. The epoch is in TDB days past J2000.
        """
        axes, spin = self.matrix(86_400.0 * days), self.spin(86_400.0 * days)
        x, z = axes[:, 0], axes[:, 2]
        ra, dec = np.arctan2(z[1], z[0]), np.arcsin(np.clip(z[2], -1.0, 1.0))
        node = np.array([-np.sin(ra), np.cos(ra), 0.0])
        meridian = np.arctan2(x @ np.cross(z, node), x @ node)
        angles = np.rad2deg([ra, dec, meridian, np.linalg.norm(spin) * 86_400.0])
        return float(angles[0]), float(angles[1]), float(angles[2]) % 360.0, float(angles[3])


def read_attitude(path: Path) -> AttitudeTable:
    """Read attitudes from a CSV with the header tdb_s,qw,qx,qy,qz; lines with # are comments.

    Raises:
        InputError: if the file cannot be read, or is not such a table.
    """
    text = read_text(path, ENTRY, "table of attitudes", BYTES_MAX)
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    header, *rows = [one for one in lines if one[1] and one[1][0] != "#"] or [(1, "")]
    number, line = header
    wanted, values = f"must be {','.join(COLUMNS)}, the header of a table", list[list[float]]()
    try:
        if tuple(name.strip() for name in line.split(",")) != COLUMNS:
            raise ValueError(line)
        wanted = f"must be {len(COLUMNS)} finite numbers"
        while len(values) < len(rows):
            number, line = rows[len(values)]
            row = [float(word) for word in line.split(",")]
            if len(row) != len(COLUMNS) or not np.isfinite(row).all():
                raise ValueError(line)
            values.append(row)
    except ValueError:
        raise InputError(ENTRY, f"{path}, line {number}: {line[:60]!r}", wanted) from None
    table = np.array(values).reshape(-1, len(COLUMNS))
    return AttitudeTable(table[:, 0], table[:, 1:])
