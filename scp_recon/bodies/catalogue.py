"""Look up packaged bodies: their data, and their heliocentric states by mean elements.

Every number's source stands in `data/bodies/NAME.toml`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from formulations.arrays import Array
from scp_recon.errors import InputError

GM_SUN_KM3_S2 = 132_712_440_041.279
"""DE440: Park et al. 2021."""
OBLIQUITY = np.deg2rad(84_381.448 / 3600.0)
"""Obliquity of the ecliptic of J2000, IAU 1976: the plane of JPL's elements."""
ECLIPTIC_NORTH = np.array([0.0, -np.sin(OBLIQUITY), np.cos(OBLIQUITY)])
"""Pole of the ecliptic, J2000."""
AU_KM = 149_597_870.7
"""IAU 2012 resolution B2."""
DAY_S = 86_400.0
J2000_TDB = datetime(2000, 1, 1, 12)


@dataclass(frozen=True)
class PackagedBody:
    """A body's packaged data.

    Attributes:
        entries: entries of the table `[body]`, in its units; without pole and meridian if it tumbles.
        elements: Kepler orbits, one a year: TDB days past J2000 of its middle, mean motion (deg/day),
            eccentricity, inclination, node, argument of perihelion, mean anomaly (deg), J2000 ecliptic,
            heliocentric; shape (n, 7).
        span: first and last day of the elements, TDB days past J2000.
        years: first and last year of that.
        assumed: assumptions by entry, dotted from `[body]` on, for entries without a measurement.
    """

    entries: dict[str, Any]
    elements: Array
    span: tuple[float, float]
    years: tuple[int, int]
    assumed: Mapping[str, str] = field(default_factory=dict)

    def covers(self, days: float) -> bool:
        """Whether an epoch, TDB days past J2000, is in the elements' span."""
        return self.span[0] <= days <= self.span[1]

    def heliocentric(self, days: float) -> tuple[Array, Array]:
        """Position (km) and velocity (km/s) from the Sun, J2000, shape (3,) each; TDB days past J2000.

        Raises:
            InputError: outside the elements' span.
        """
        if not self.covers(days):
            raise InputError(
                "epoch.tdb",
                f"{J2000_TDB + timedelta(days=days):%Y-%m-%d}",
                f"must be from {self.years[0]} to {self.years[1]}, for which mean elements of "
                f"{self.entries['name']} are packaged, or sun.body_position_km and "
                "sun.body_velocity_km_s be given",
            )
        return self.extrapolated(days)

    def extrapolated(self, days: float) -> tuple[Array, Array]:
        """As `heliocentric`; outside the span by the elements of the nearest year."""
        return kepler(self.elements[np.argmin(np.abs(self.elements[:, 0] - days))], days)


def kepler(elements: Array, days: float) -> tuple[Array, Array]:
    """Position (km) and velocity (km/s) on a Kepler orbit, J2000 equatorial, shape (3,) each.

    `elements` is a row of `PackagedBody.elements`, and `days` are TDB past J2000.
    """
    middle, motion_deg, e, *angles_deg = elements.tolist()
    motion = np.deg2rad(motion_deg)
    inclination, node, perihelion, anomaly = np.deg2rad(angles_deg)
    eccentric = eccentric_anomaly(anomaly + motion * (days - middle), e)
    n = motion / DAY_S
    a = (GM_SUN_KM3_S2 / n**2) ** (1.0 / 3.0)
    b, rate = a * np.sqrt(1.0 - e * e), n / (1.0 - e * np.cos(eccentric))
    in_plane = np.array([a * (np.cos(eccentric) - e), b * np.sin(eccentric), 0.0])
    moving = rate * np.array([-a * np.sin(eccentric), b * np.cos(eccentric), 0.0])
    turn = _about_x(OBLIQUITY) @ _about_z(node) @ _about_x(inclination) @ _about_z(perihelion)
    return turn @ in_plane, turn @ moving


def eccentric_anomaly(mean: Any, eccentricity: float) -> Any:
    """Eccentric anomaly of mean anomalies, rad, by Newton's method: converges in five for e < 0.4."""
    found = mean
    for _ in range(50 if eccentricity else 0):
        miss = found - eccentricity * np.sin(found) - mean
        before, found = found, found - miss / (1.0 - eccentricity * np.cos(found))
        if np.all(found == before):
            break
    return found


def _about_x(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _about_z(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def body_names() -> list[str]:
    """Names of the packaged bodies."""
    return [body.entries["name"] for body in _bodies().values()]


def packaged_body(name: object) -> PackagedBody | None:
    """The packaged body of a name, in any case, with or without its number; None if there is none."""
    return _bodies().get(name.strip(NUMBER).casefold()) if isinstance(name, str) else None


NUMBER = " ()0123456789"
"""A number before or behind a name: (101955) Bennu."""


@cache
def _bodies() -> dict[str, PackagedBody]:
    found = {}
    folder = files("scp_recon") / "data" / "bodies"
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        if file.name.endswith(".toml"):
            data = tomllib.loads(file.read_text(encoding="utf-8"))
            if "attitude_file" in data["body"]:
                data["body"]["attitude_file"] = str(folder / data["body"]["attitude_file"])
            elements = np.array(data["sun"]["elements"])
            elements[:, 0] -= 2_451_545.0
            half = 0.5 * np.diff(elements[:2, 0]).item()
            span = elements[0, 0] - half, elements[-1, 0] + half
            first, last = data["sun"]["years"]
            found[data["body"]["name"].casefold()] = PackagedBody(
                data["body"], elements, span, (first, last), data.get("assumed", {})
            )
    return found
