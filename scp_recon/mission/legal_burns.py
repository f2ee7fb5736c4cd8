"""Find the burn times that the attitude schedule allows about a window (Echigo et al., section V.A)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from scp_recon.mission.windows import OfTime, Window, all_windows, whole_windows
from scp_recon.scenario.schema import Scenario, ScheduleRules

Interval = tuple[float, float]
"""Earliest and latest time, s; empty where the first is above the second."""


def burns_before(times_s: Sequence[float], window_s: Window) -> int:
    """Number of burns between the first one and a window."""
    return sum(time <= 0.5 * (window_s[0] + window_s[1]) for time in times_s[1:])


def sun_leg_s(rules: ScheduleRules) -> float:
    """Least time in sun-pointing mode: one slew and one recharge."""
    return rules.attitude_s + rules.recharge_s


def before_burn_s(rules: ScheduleRules) -> float:
    """Time in delta-V mode that ends with a burn: one slew and one heating."""
    return rules.attitude_s + rules.heating_s


def legal_starts(
    window_s: Window, duration_s: float, before: int, after: int, rules: ScheduleRules
) -> Interval:
    """Legal times of the first burn of a flight that observes in a window, the others free to move.

    The flight lasts `duration_s` from first to last burn; `before` burns lie between the first one and
    the window, and `after`, at least one, behind it. The interval is in the window's time, s, and empty
    (first above second) where the flight is too short.
    """
    cycle = sun_leg_s(rules) + before_burn_s(rules)
    latest = window_s[0] - rules.attitude_s - sun_leg_s(rules) - before * cycle
    return window_s[1] + after * cycle - duration_s, latest


def legal_burns(
    window_s: Window,
    duration_s: float,
    before: int,
    after: int,
    rules: ScheduleRules,
    starts_s: Interval | None = None,
) -> list[Interval]:
    """Legal times of each burn, s, the others free to move; arguments as in `legal_starts`.

    A burn needs a cycle of its own after the burn or the window before it: a sun-pointing leg, then
    delta-V mode. Before observation mode there is a sun-pointing leg alone. The first interval is that
    of the first burn, `starts_s`: (0, 0) at the epoch, `legal_starts` if not given.
    """
    cycle = sun_leg_s(rules) + before_burn_s(rules)
    free = legal_starts(window_s, duration_s, before, after, rules)
    early, late = starts_s or free
    before_window = [(early + i * cycle, free[1] + i * cycle) for i in range(1, before + 1)]
    after_window = [
        (window_s[1] + i * cycle, late + duration_s - (after - i) * cycle) for i in range(1, after)
    ]
    return [(early, late), *before_window, *after_window, (early + duration_s, late + duration_s)]


def legal_additions(
    times_s: Sequence[float], window_s: Window, rules: ScheduleRules
) -> list[Interval]:
    """Legal times of one more burn among burns that keep the rules and stay; no empty intervals."""
    cycle = sun_leg_s(rules) + before_burn_s(rules)
    gap = burns_before(times_s, window_s)
    found = []
    for index, (time, following) in enumerate(itertools.pairwise(times_s)):
        if index == gap:
            found.append((time + cycle, window_s[0] - rules.attitude_s - sun_leg_s(rules)))
            time = window_s[1]
        found.append((time + cycle, following - cycle))
    return [(first, last) for first, last in found if first <= last]


def legal_shifts(
    window_s: Window, times_s: Sequence[float], rules: ScheduleRules
) -> list[tuple[int, Interval]]:
    """Epoch shifts, least and greatest, s, by which a window falls legally between burns that stay.

    Each interval comes with the index of the burn before its gap; gaps too short are left out.
    """
    found = []
    for index, (time, following) in enumerate(itertools.pairwise(times_s)):
        latest = window_s[0] - rules.attitude_s - sun_leg_s(rules) - time
        earliest = window_s[1] + sun_leg_s(rules) + before_burn_s(rules) - following
        if earliest <= latest:
            found.append((index, (earliest, latest)))
    return found


BEYOND_S, SHOWN = 2 * 86_400.0, 3
"""How far before and after the flight to look for other windows, and how many to tell."""


def other_windows(scenario: Scenario, slack: OfTime, incidence: OfTime, step_s: float) -> str:
    """Describe the windows near a flight that contains none, and epoch shifts that would include them.

    `slack` (of the limits on lighting) and `incidence` (rad) are functions of times in s.
    """
    times, rules = scenario.burns.times_s, scenario.schedule
    span = -BEYOND_S, scenario.duration_s + BEYOND_S
    windows = all_windows(slack, span, step_s)
    if windows == [span]:
        return "both hold all the time: give observation.window_s"
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
            f"no gap between burns is long enough: expected at least "
            f"{needed + before_burn_s(rules):.0f} s"
        )
    index, (low, high) = min(shifts, key=lambda found: max(found[1][0], -found[1][1]))
    return (
        f"legal between burns.times_s.{index} and {index + 1} with epoch.tdb moved by "
        f"{low:+.0f} to {high:+.0f} s"
    )


def legal_times(times_s: Sequence[float], window_s: Window, rules: ScheduleRules) -> str:
    """Describe a window and the legal times of each burn about it, the others free to move."""
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
