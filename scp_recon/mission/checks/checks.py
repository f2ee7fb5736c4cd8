"""Run every check of a mission: units, axes, and entries that contradict each other.

An entry that can also be computed is checked against the computed value. Values that no flight about
a small body can have, such as kilometres in place of metres, are refused before any work. Unlikely
values become warnings, which stand in `solution.json` and above every verdict and change no exit
status. A quantity held to an interval is a row of `intervals`; every other check is a function.

These checks cannot detect: a wrong probability; wrong axes of the boundary states, unless they lead
into the shadow (`solve` shows distance, latitude, climb, plane, and angle off the Sun); a wrong
prime meridian, pole, spin or Sun of a body that is not packaged (`solve` shows the given sense of
rotation, distance and season of the Sun); UTC in place of TDB, unless `epoch.utc` is given too
(every table of burns has both scales); or a small body wholly in kilometres. If `base` names a
complete file, no entry of another date or body is inherited.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from scp_recon.errors import InputError
from scp_recon.mission.checks import known
from scp_recon.mission.checks.intervals import INTERVALS, PLANNER_INTERVALS, STATE_INTERVALS
from scp_recon.mission.feedback import uncorrected_burns, useless_measurement
from scp_recon.mission.scene import Scene
from scp_recon.mission.windows import SCAN_STEP_S, Window
from scp_recon.scenario.fields import ScenarioWarning

Check = Callable[[Scene], Iterator[ScenarioWarning]]


CHECKS: tuple[Check, ...] = (
    *(row.check for row in INTERVALS),
    known.known_body,
    known.assumed,
    known.oblateness,
    known.angles_in_radians,
    known.named_site,
    known.known_orbit,
)
"""Checks before the window is known, in the order of checking."""
STATE_CHECKS: tuple[Check, ...] = (
    *(row.check for row in STATE_INTERVALS),
    uncorrected_burns,
    useless_measurement,
)
"""Checks of the state where planning begins, and of the burns that are left."""
WINDOW_SLACK = 0.05
"""Slack of the lighting limits, deg or h: room for a window given to the nearest second."""


def check_plausible(scene: Scene) -> None:
    """Refuse values with which planning would never end or overflow: `PLANNER_INTERVALS`.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    for row in PLANNER_INTERVALS:
        tuple(row.check(scene))


def check_scene(scene: Scene) -> tuple[ScenarioWarning, ...]:
    """Run every check of `CHECKS`.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    return tuple(found for check in CHECKS for found in check(scene))


def check_state(scene: Scene) -> tuple[ScenarioWarning, ...]:
    """Run every check of `STATE_CHECKS` on the state where planning begins, and on the burns left."""
    return tuple(found for check in STATE_CHECKS for found in check(scene))


def check_window(scene: Scene, window: Window) -> tuple[ScenarioWarning, ...]:
    """Refuse a window in which the site is dark at any time; warn of a given one beyond its limits.

    The limits are those of incidence and local solar time under `[observation]`, with a slack of
    0.05 deg or h. A computed window keeps them.

    Raises:
        InputError: if the site is dark at some time; names the window if given, else the limit.
    """
    limits, entry, lighting = scene.scenario.observation, "observation.window_s", scene.lighting
    computed, (first, last) = limits.window_s is None, window
    times = np.linspace(first, last, int(np.ceil((last - first) / SCAN_STEP_S)) + 1)
    angles, hours = np.rad2deg(lighting.incidence(times)), lighting.local_solar_time(times)
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
