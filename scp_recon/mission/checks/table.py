"""Whether a mission is hardly what was meant: units, axes, and entries that contradict each other.

Every check computes what the other entries make of one of them. What no body and no flight about one
reaches is refused, as kilometres in the place of metres are; what is unlikely becomes a warning.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from scp_recon.errors import InputError
from scp_recon.mission.checks import body, figure, flight, risk, spread, sun
from scp_recon.mission.checks.given import Given
from scp_recon.mission.windows import SCAN_STEP_S
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.warning import ScenarioWarning

Array = npt.NDArray[np.float64]
Times = Callable[[Array], Array]

CHECKS: tuple[Callable[[Given], Iterator[ScenarioWarning]], ...] = (
    body.copied,
    body.density,
    body.size,
    body.spin,
    body.known_body,
    figure.semi_axes,
    figure.oblateness,
    body.site_position,
    body.site_angles,
    body.named_site,
    body.site_normal,
    sun.distance,
    sun.orbit,
    sun.known_orbit,
    flight.safety,
    flight.site_distances,
    flight.boundary,
    flight.shadow,
    flight.burn_size,
    flight.limit_angles,
    flight.spacecraft,
    flight.durations,
    spread.burn_errors,
    risk.of_flights,
)
"""What a mission is held to, in this order."""
WINDOW_SLACK = 0.05
"""In degrees, or hours: a window given to the nearest second is no other one."""


def check_given(given: Given) -> tuple[ScenarioWarning, ...]:
    """Run every check of `CHECKS`.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    return tuple(found for check in CHECKS for found in check(given))


def check_window(
    scenario: Scenario, window: tuple[float, float], incidence: Times, local_solar_time: Times
) -> tuple[ScenarioWarning, ...]:
    """Hold a window to the light, and one that was given to the limits it stands in for.

    Between its edges too.

    Args:
        scenario: gives the limits.
        window: s.
        incidence: solar incidence at the site in rad, of times in s.
        local_solar_time: at the site in h, of times in s.

    Raises:
        InputError: if the site is dark at some time in it; of a window that was computed it names the
            limit.
    """
    limits, entry = scenario.observation, "observation.window_s"
    computed, (first, last) = limits.window_s is None, window
    times = np.linspace(first, last, int(np.ceil((last - first) / SCAN_STEP_S)) + 1)
    angles, hours = np.rad2deg(incidence(times)), local_solar_time(times)
    worst, given = float(angles.max()), f"[{first:g}, {last:g}] s"
    at = float(times[np.argmax(angles)])
    if worst >= 90.0:
        dark = f"{given}, in which incidence reaches {worst:.1f} deg at {at:.0f} s"
        limit = f"the limit is {limits.incidence_max_deg:g} deg"
        if computed:
            dark = f"{limits.incidence_max_deg:g} deg, which makes a window of {dark}"
        entry = "observation.incidence_max_deg" if computed else entry
        raise InputError(entry, dark, f"must keep the site in the light, below 90 deg; {limit}")
    if computed:
        return ()
    found = []
    if worst > limits.incidence_max_deg + WINDOW_SLACK:
        text = f"{given}, in which incidence reaches {worst:.1f} deg at {at:.0f} s"
        expected = f"observation.incidence_max_deg is {limits.incidence_max_deg:g} deg"
        found.append(ScenarioWarning.of(entry, text, expected))
    low, high = limits.local_solar_time_min_h, limits.local_solar_time_max_h
    if hours.min() < low - WINDOW_SLACK or hours.max() > high + WINDOW_SLACK:
        text = f"{given}, in which it is {hours.min():.2f} to {hours.max():.2f} h local solar time"
        expected = f"observation.local_solar_time_min_h and _max_h are {low:g} and {high:g} h"
        found.append(ScenarioWarning.of(entry, text, expected))
    return tuple(found)
