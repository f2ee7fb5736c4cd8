"""The axis of sites that are spread over the body's shape."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from scp_recon.campaign.study.axes import EPOCH, LATITUDE, LONGITUDE, Axis, Row
from scp_recon.campaign.study.sites import even_sites, surface_of
from scp_recon.mission.mission import rotation_of
from scp_recon.physics.orbit import two_body
from scp_recon.scenario.fields import Section
from scp_recon.scenario.schema import Scenario

NAME = "site.name"
STRIDE = np.sqrt(2.0)
"""Its multiples order the sites; those of the golden ratio are their longitudes."""
Moment = Annotated[float, Field(ge=-1e7, le=1e7)]


class Spread(Section):
    """How many sites, and when they are looked at."""

    count: Annotated[int, Field(ge=4, le=10_000)]
    """Sites, each with an equal share of the area, nearly."""
    noon_at_s: Moment | None = None
    """Move the epoch, by less than a rotation, so that it is local solar noon at the site so long after
    it: then each site is seen at the same time of its flight. Without it the epoch stays."""


class ShapeSites(Axis):
    """Sites spread evenly over the base's shape file, or its ellipsoid.

    They come in an order in which the first ones are spread evenly too: a campaign that was stopped has
    a coarser map.
    """

    spread: Spread

    def count(self, _base: Scenario, /) -> int:
        """As said."""
        return self.spread.count

    def rows(self, base: Scenario, _seed: tuple[int, ...], _folder: Path, /) -> list[Row]:
        """Latitude, longitude, name and, if it moves, the epoch of each."""
        sites = even_sites(surface_of(base), self.spread.count)
        order = sorted(range(len(sites)), key=lambda number: number * STRIDE % 1.0)
        return [self._row(base, *sites[number]) for number in order]

    def _row(self, base: Scenario, latitude: float, longitude: float) -> Row:
        latitude, longitude = round(latitude, 2), round(longitude, 2)
        row: Row = {
            NAME: f"{abs(latitude):.1f}{'NS'[latitude < 0]} {longitude % 360:.1f}E",
            LATITUDE: latitude,
            LONGITUDE: longitude,
        }
        if self.spread.noon_at_s is not None:
            shift = noon_s(base, longitude) - self.spread.noon_at_s
            row[EPOCH] = (base.epoch.tdb + timedelta(seconds=round(shift))).isoformat()
        return row


def noon_s(scenario: Scenario, longitude_deg: float) -> float:
    """The first local solar noon after a scenario's epoch at an east longitude, in s past the epoch.

    By Newton's method on the Sun's body-fixed longitude.
    """
    rotation, sun = rotation_of(scenario), scenario.sun
    day = 2.0 * np.pi / abs(rotation.rate)
    to_body = two_body(sun.body_position_km, sun.body_velocity_km_s, (0.0, 3.0 * day))

    def longitude_at(time_s: float) -> float:
        x, y, _ = rotation.body_to_j2000(time_s).T @ -to_body(time_s)
        return float(np.arctan2(y, x))

    time = 0.0
    for _ in range(3):
        ahead = longitude_at(time) - np.deg2rad(longitude_deg)
        turn = ahead % (2.0 * np.pi) if time == 0.0 else (ahead + np.pi) % (2.0 * np.pi) - np.pi
        time += turn / rotation.rate
    return time
