"""Where burns may be about a window: Echigo et al., section V.A."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from scp_recon.mission.windows import Window
from scp_recon.scenario.sections import ScheduleRules

Interval = tuple[float, float]
"""Earliest and latest time, s; empty where the first is above the second."""


def burns_before(times_s: Sequence[float], window_s: Window) -> int:
    """Burns between the first one and a window."""
    return sum(time <= 0.5 * (window_s[0] + window_s[1]) for time in times_s[1:])


def middle_gap(times_s: Sequence[float]) -> int:
    """Burns between the first one and a window in the flight's middle gap: with four burns, one."""
    return (len(times_s) - 2) // 2


def sun_leg_s(rules: ScheduleRules) -> float:
    """Least time in sun-pointing mode: one slew and one recharge."""
    return rules.attitude_s + rules.recharge_s


def before_burn_s(rules: ScheduleRules) -> float:
    """Time in delta-V mode that ends with a burn: one slew and one heating."""
    return rules.attitude_s + rules.heating_s


def legal_starts(
    window_s: Window, duration_s: float, before: int, after: int, rules: ScheduleRules
) -> Interval:
    """When a flight that observes in a window may begin, with its other burns placed freely.

    Args:
        window_s: edges.
        duration_s: from the first burn to the last.
        before: burns between the first one and the window.
        after: burns after the window, at least one.
        rules: durations.

    Returns:
        Earliest and latest time of the first burn, in the window's time. An interval is empty where its
        first is above its second: the flight is too short.
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
    """Where each burn may be if the others give way; arguments as in `legal_starts`.

    A burn needs a cycle of its own after the burn or the window before it: a sun-pointing leg, then
    delta-V mode. Before observation mode there is a sun-pointing leg alone.

    Args:
        window_s: edges.
        duration_s: from the first burn to the last.
        before: burns between the first one and the window.
        after: burns after the window, at least one.
        rules: durations.
        starts_s: when the first burn may be; `legal_starts` if not given, (0, 0) at the epoch.

    Returns:
        An interval for each burn, the first one's included.
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
    """Where one more burn may be with all others kept; those that are empty are left out.

    Args:
        times_s: of burns that keep the rules.
        window_s: edges.
        rules: durations.
    """
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
    """Epoch shifts by which a window falls legally into a gap between burns that stay as they are.

    Returns:
        Index of the burn before the gap, and the shortest and longest shift of the epoch; gaps that are
        too short are left out.
    """
    found = []
    for index, (time, following) in enumerate(itertools.pairwise(times_s)):
        latest = window_s[0] - rules.attitude_s - sun_leg_s(rules) - time
        earliest = window_s[1] + sun_leg_s(rules) + before_burn_s(rules) - following
        if earliest <= latest:
            found.append((index, (earliest, latest)))
    return found
