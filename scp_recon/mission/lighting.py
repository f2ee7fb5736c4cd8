"""How a site is lit over time, and when within the scenario's limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scp_recon.physics import geometry
from scp_recon.physics.frames import Rotation
from scp_recon.scenario.sections import Observation

Array = npt.NDArray[np.float64]
OfTime = Callable[[Array], Array]


@dataclass(frozen=True)
class Lighting:
    """A site on a turning body in the Sun.

    Attributes:
        site: body-fixed.
        rotation: attitude of the body.
        to_sun: unit vectors from the body to the Sun, J2000, shape (..., 3), of times in s.
    """

    site: geometry.Site
    rotation: Rotation
    to_sun: OfTime

    def incidence(self, time_s: Array) -> Array:
        """Angle between the site's normal and the Sun, rad."""
        track = geometry.track(self.site, self.rotation, time_s)
        return geometry.incidence(track, self.to_sun(time_s))

    def local_solar_time(self, time_s: Array) -> Array:
        """At the site, in h; a rotation has 24."""
        return geometry.local_solar_time(self.site, self.rotation, self.to_sun(time_s), time_s)


def lighting_slack(limits: Observation, incidence: OfTime, local_solar_time: OfTime) -> OfTime:
    """Smallest distance from a limit, hours and degrees alike: only its sign matters.

    Args:
        limits: largest incidence, and the local solar times between which to observe.
        incidence: at the site in rad, of times in s.
        local_solar_time: at the site in h, of times in s.
    """

    def slack(time_s: Array) -> Array:
        hour = local_solar_time(time_s)
        return np.minimum.reduce(
            [
                limits.incidence_max_deg - np.rad2deg(incidence(time_s)),
                hour - limits.local_solar_time_min_h,
                limits.local_solar_time_max_h - hour,
            ]
        )

    return slack
