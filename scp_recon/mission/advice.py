"""What would be legal, in words: for the messages about windows and burns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scp_recon.mission.legal_burns import (
    before_burn_s,
    burns_before,
    legal_burns,
    legal_shifts,
    legal_starts,
    sun_leg_s,
)
from scp_recon.mission.lighting import OfTime
from scp_recon.mission.windows import Window, all_windows, whole_windows
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.sections import ScheduleRules

BEYOND_S, SHOWN = 2 * 86_400.0, 3
"""How far before and after the flight to look for other windows, and how many to tell."""


def other_windows(scenario: Scenario, slack: OfTime, incidence: OfTime, step_s: float) -> str:
    """Windows near a flight that has none, and the epoch shifts that would bring them into it.

    Args:
        scenario: whose flight has no whole window.
        slack: of the limits on lighting, of times in s.
        incidence: at the site in rad, of times in s.
        step_s: of the scan.
    """
    times, rules = scenario.burns.times_s, scenario.schedule
    span = -BEYOND_S, scenario.duration_s + BEYOND_S
    windows = all_windows(slack, span, step_s)
    if windows == [span]:
        return "the site keeps them all the time: give observation.window_s"
    whole = whole_windows(windows, span)
    if not whole:
        looks = np.linspace(*span, 2000)
        least = float(np.rad2deg(incidence(looks)).min())
        return (
            f"nor is there one within {BEYOND_S / 86_400:g} days of it, in which the least "
            f"incidence is {least:.1f} deg"
        )
    middle = 0.5 * scenario.duration_s
    nearest = sorted(whole, key=lambda window: abs(0.5 * sum(window) - middle))[:SHOWN]
    lines = [f"{_edges(window)}: {_shift(window, times, rules)}" for window in sorted(nearest)]
    return "\n".join(["windows near it, in seconds past epoch.tdb:", *lines])


def _edges(window: Window) -> str:
    return f"{window[0]:.1f} to {window[1]:.1f} s"


def _shift(window: Window, times: Sequence[float], rules: ScheduleRules) -> str:
    """The epoch shifts nearest to none that bring a window between the burns as they are."""
    shifts = legal_shifts(window, times, rules)
    if not shifts:
        needed = window[1] - window[0] + rules.attitude_s + 2 * sun_leg_s(rules)
        return (
            f"no gap between burns is long enough for it, which has to be "
            f"{needed + before_burn_s(rules):.0f} s"
        )
    index, (low, high) = min(shifts, key=lambda found: max(found[1][0], -found[1][1]))
    return (
        f"legal between burns.times_s.{index} and {index + 1} with epoch.tdb moved by "
        f"{low:+.0f} to {high:+.0f} s"
    )


def legal_times(times_s: Sequence[float], window_s: Window, rules: ScheduleRules) -> str:
    """The window, and where each burn of a flight may be about it if the others give way."""
    before = burns_before(times_s, window_s)
    after, duration = len(times_s) - 1 - before, times_s[-1]
    earliest, latest = legal_starts(window_s, duration, before, after, rules)
    text = f"the window is {_edges(window_s)}"
    if latest < 0.0:
        many = f" with {before} burns before it" if before else ""
        opens = f"{window_s[0] - latest:.1f} s or later"
        return f"{text}, and{many} has to open at {opens}; {_shift(window_s, times_s, rules)}"
    if earliest > 0.0:
        burns = f"{after} burns" if after > 1 else "a burn"
        last = f"{duration + earliest:.1f} s on"
        return f"{text}, and with {burns} after it the last is legal from {last}"
    intervals = legal_burns(window_s, duration, before, after, rules, (0.0, 0.0))
    words = [f"{i} from {a:.1f} to {b:.1f} s" for i, (a, b) in enumerate(intervals[1:-1], start=1)]
    last = f"{len(times_s) - 1} from {duration + earliest:.1f} s on"
    return f"{text}, and if the other burns give way, legal are burns.times_s." + ", ".join(
        [*words, last]
    )
