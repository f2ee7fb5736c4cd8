"""What a scenario file is drafted from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from scp_recon.draft.flyby import Design
from scp_recon.mission.windows import Window

INCIDENCE_MAX_DEG, ROOM_DEG = 60.0, 10.0
"""Limit as a rule; where the least at a site is nearer to it than the room, it is that much above."""


@dataclass(frozen=True)
class GivenBody:
    """A body that is not packaged, by numbers.

    Attributes:
        gm_m3_s2: gravitational parameter.
        radius_m: of the sphere that stands for it.
        period_h: sidereal spin period.
        pole_deg: right ascension and declination of the spin pole, J2000.
        position_km: heliocentric, J2000, at the epoch of the file.
        velocity_km_s: the same.
        meridian_deg: angle W of the prime meridian at the epoch of the file.
    """

    gm_m3_s2: float
    radius_m: float
    period_h: float
    pole_deg: tuple[float, float]
    position_km: tuple[float, float, float]
    velocity_km_s: tuple[float, float, float]
    meridian_deg: float


@dataclass(frozen=True)
class Draft:
    """What a scenario file is written from.

    Attributes:
        name: of the scenario.
        body: its name.
        given: the body's numbers, none for a packaged one.
        site_deg: planetocentric latitude and east longitude.
        epoch: TDB of the first burn.
        radius_m: reference radius of the body.
        incidence_max_deg: limit.
        hours: local solar times between which to observe.
        window_s: where it has to be written, because an earlier one is in the flight.
        design: of the flyby; none before there is one.
        outcome: what planning it came to.
    """

    name: str
    body: str
    given: GivenBody | None
    site_deg: tuple[float, float]
    epoch: datetime
    radius_m: float
    incidence_max_deg: float = INCIDENCE_MAX_DEG
    hours: tuple[float, float] = (8.0, 16.0)
    window_s: Window | None = None
    design: Design | None = None
    outcome: Sequence[str] = ()
