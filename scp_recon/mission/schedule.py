"""Observation window and attitude-mode schedule."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from scp_recon.errors import InputError
from scp_recon.mission.advice import legal_times, other_windows
from scp_recon.mission.legal_burns import before_burn_s, burns_before, sun_leg_s
from scp_recon.mission.lighting import lighting_slack
from scp_recon.mission.windows import SCAN_STEP_S, each_window, is_whole
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.sections import ScheduleRules

Array = npt.NDArray[np.float64]


def find_window(
    scenario: Scenario,
    incidence: Callable[[Array], Array],
    local_solar_time: Callable[[Array], Array],
    step_s: float = SCAN_STEP_S,
) -> tuple[float, float]:
    """First complete interval of the flight in which the site is lit well enough; s.

    Args:
        scenario: gives the limits, or the window itself.
        incidence: solar incidence at the site in rad, of times in s.
        local_solar_time: at the site in h, of times in s.
        step_s: of the scan for windows.

    Raises:
        InputError: if the given window is not inside the flight, or there is none; it names the
            windows near the flight and the epoch shifts that would bring them into it.
    """
    limits, end = scenario.observation, scenario.duration_s
    if limits.window_s is not None:
        first, last = limits.window_s
        if not 0.0 < first < last < end:
            raise InputError(
                "observation.window_s",
                f"[{first:g}, {last:g}] s",
                f"must be ascending and inside the flight, 0 to {end:g} s",
            )
        return first, last

    slack = lighting_slack(limits, incidence, local_solar_time)
    flight = 0.0, end
    windows = each_window(slack, flight, step_s)
    first_whole = next((window for window in windows if is_whole(window, flight)), None)
    if first_whole is not None:
        return first_whole
    raise InputError(
        "observation",
        f"incidence at most {limits.incidence_max_deg:g} deg and local solar time "
        f"{limits.local_solar_time_min_h:g} to {limits.local_solar_time_max_h:g} h",
        f"the flight of {end:g} s must contain a whole window in which both hold; "
        + other_windows(scenario, slack, incidence, step_s),
    )


class Mode(StrEnum):
    """What the attitude serves."""

    DELTA_V = "delta-V"
    SUN_POINTING = "sun-pointing"
    OBSERVATION = "observation"


@dataclass(frozen=True)
class Leg:
    """A mode and when it holds, s."""

    mode: Mode
    start_s: float
    end_s: float


@dataclass(frozen=True)
class Schedule:
    """Attitude-mode profile and where each burn may be moved with the others kept.

    Attributes:
        window_s: observation window.
        legs: contiguous from the epoch, or a state in flight, to the last burn; the attitude of the
            first burn is acquired before.
        firing_intervals_s: earliest and latest time of each burn to be planned; both 0 for the flight's
            first, and the last has no latest time (infinity).
    """

    window_s: tuple[float, float]
    legs: tuple[Leg, ...]
    firing_intervals_s: tuple[tuple[float, float], ...]


def make_schedule(
    times_s: tuple[float, ...], window_s: tuple[float, float], rules: ScheduleRules
) -> Schedule:
    """Lay out the modes: Echigo et al., section V.A.

    Delta-V mode starts one slew and one heating before a burn; observation mode one slew before the
    window; sun-pointing fills the rest and lasts at least one slew and one recharge each time.

    Raises:
        InputError: if a firing time breaks one of these rules, naming the rule.
    """
    before_burn, sun_leg = before_burn_s(rules), sun_leg_s(rules)
    observation = Leg(Mode.OBSERVATION, window_s[0] - rules.attitude_s, window_s[1])
    burns = [Leg(Mode.DELTA_V, time - before_burn, time) for time in times_s[1:]]
    before = burns_before(times_s, window_s)
    # Everything that is not sun-pointing, in order, with the first burn as an instant at zero.
    busy = [Leg(Mode.DELTA_V, 0.0, 0.0)]
    busy += [*burns[:before], observation, *burns[before:]]
    observation_at = before + 1

    intervals = [(0.0, 0.0)]
    for index in range(1, len(busy)):
        if index == observation_at:
            continue
        earliest = busy[index - 1].end_s + sun_leg + before_burn
        latest = busy[index + 1].start_s - sun_leg if index + 1 < len(busy) else np.inf
        intervals.append((earliest, latest))

    legs: list[Leg] = []
    for index, (previous, leg) in enumerate(itertools.pairwise(busy), start=1):
        if leg.start_s - previous.end_s < sun_leg - 1e-6:
            # The burn that ends the short leg; before the observation, the one that starts it.
            burn = index if index < observation_at else index - 1
            legal = legal_times(times_s, window_s, rules)
            raise _too_short(burn, times_s, window_s, intervals, previous, leg, sun_leg, legal)
        if leg.start_s > previous.end_s:
            legs.append(Leg(Mode.SUN_POINTING, previous.end_s, leg.start_s))
        legs.append(leg)
    return Schedule(window_s, tuple(legs), tuple(intervals))


def _too_short(
    burn: int,
    times_s: tuple[float, ...],
    window_s: tuple[float, float],
    intervals: list[tuple[float, float]],
    previous: Leg,
    leg: Leg,
    sun_leg: float,
    legal: str,
) -> InputError:
    rule = (
        f"rule 'a sun-pointing leg lasts at least one slew and one recharge, {sun_leg:g} s' is "
        f"broken: {previous.mode} mode ends at {previous.end_s:g} s and {leg.mode} mode must start "
        f"at {leg.start_s:g} s"
    )
    if burn == 0:  # which cannot move: the window has to
        given = f"[{window_s[0]:g}, {window_s[1]:g}] s"
        return InputError("observation.window_s", given, f"{rule}; {legal}")
    early, late = intervals[burn]
    if early > late:
        moved = "nowhere"
    elif late < np.inf:
        moved = f"between {early:g} s and {late:g} s"
    else:
        moved = f"from {early:g} s on"
    return InputError(
        f"burns.times_s.{burn}",
        f"{times_s[burn]:g} s",
        f"{rule}; with the others kept this burn may be {moved}; {legal}",
    )
