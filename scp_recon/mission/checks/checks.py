"""Runs every check of a mission: units, axes, and entries that contradict each other.

Whatever can be computed is computed, and what is given as well is checked against it. What no body
and no flight about one reaches is refused before any work, as kilometres in the place of metres are;
what is unlikely becomes a warning, which stands in `solution.json` and above every verdict, and
changes no exit status. A quantity that is held to an interval is a row of `intervals`, anything else a
function.

Physics cannot tell a probability, the axes of the boundary states (unless wrong ones lead into the
shadow; `solve` shows their distance, angle off the Sun and climb), the prime meridian, pole or spin of
a body that is not packaged, a small body wholly in kilometres, or a Sun of another epoch in a complete
file: name that file as `base` instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from scp_recon.errors import InputError
from scp_recon.mission.checks import known
from scp_recon.mission.checks.intervals import INTERVALS, PLANNER_INTERVALS, STATE_INTERVALS
from scp_recon.mission.scene import Scene
from scp_recon.mission.windows import SCAN_STEP_S, Window
from scp_recon.scenario.fields import ScenarioWarning

Check = Callable[[Scene], Iterator[ScenarioWarning]]


CHECKS: tuple[Check, ...] = (
    known.stale_entries,
    *(row.check for row in INTERVALS),
    known.known_body,
    known.oblateness,
    known.site_angles,
    known.named_site,
    known.known_orbit,
)
"""Checks before the window is known, in the order of checking."""
WINDOW_SLACK = 0.05
"""In degrees, or hours: a window given to the nearest second is no other one."""


def check_plausible(scene: Scene) -> None:
    """Refuse what would never end, or end in figures that are not finite: `PLANNER_INTERVALS`.

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
    """Hold the state where planning begins, and its sigmas, to `STATE_INTERVALS`."""
    return tuple(found for row in STATE_INTERVALS for found in row.check(scene))


def check_window(scene: Scene, window: Window) -> tuple[ScenarioWarning, ...]:
    """Refuse a window in which the site is dark, be it for a moment; warn of one beyond its limits.

    The latter of a window that was given. Limits are the file's own of incidence and local solar time,
    with a slack of 0.05 deg or h.

    Raises:
        InputError: if the site is dark at some time in it; of a window that was computed it names the
            limit.
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
