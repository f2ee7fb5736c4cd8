"""Observation window and attitude-mode schedule."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

from scp_recon.errors import InputError
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.sections import ScheduleRules

Array = npt.NDArray[np.float64]
SCAN_STEP_S = 20.0


def find_window(
    scenario: Scenario,
    incidence: Callable[[Array], Array],
    local_solar_time: Callable[[Array], Array],
) -> tuple[float, float]:
    """First complete interval of the flight in which the site is lit well enough; s.

    Args:
        scenario: gives the limits, or the window itself.
        incidence: solar incidence at the site in rad, of times in s.
        local_solar_time: at the site in h, of times in s.

    Raises:
        InputError: if the given window is not inside the flight, or there is none.
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

    def slack(time: Array) -> Array:
        """Smallest distance from a limit, hours and degrees alike: only its sign matters."""
        hour = local_solar_time(time)
        return np.minimum.reduce(
            [
                limits.incidence_max_deg - np.rad2deg(incidence(time)),
                hour - limits.local_solar_time_min_h,
                limits.local_solar_time_max_h - hour,
            ]
        )

    times = np.linspace(0.0, end, int(np.ceil(end / SCAN_STEP_S)) + 1)
    lit = slack(times) >= 0.0
    edges = np.flatnonzero(lit[1:] != lit[:-1])
    opening = [k for k in edges if lit[k + 1]]
    for k in opening:
        closing = [j for j in edges if j > k]
        if closing:
            first, last = (
                brentq(lambda t: float(slack(np.array(t))), times[j], times[j + 1], xtol=1e-6)
                for j in (k, closing[0])
            )
            return first, last
    raise InputError(
        "observation",
        f"incidence at most {limits.incidence_max_deg:g} deg and local solar time "
        f"{limits.local_solar_time_min_h:g} to {limits.local_solar_time_max_h:g} h",
        f"the flight of {end:g} s must contain a whole window in which both hold",
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
        legs: contiguous from 0 to the last burn; the attitude of the first burn is acquired before.
        firing_intervals_s: earliest and latest time of each burn; both 0 for the first, and the last
            has no latest time (infinity).
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
    before_burn = rules.attitude_s + rules.heating_s
    sun_leg = rules.attitude_s + rules.recharge_s
    middle = 0.5 * (window_s[0] + window_s[1])
    observation = Leg(Mode.OBSERVATION, window_s[0] - rules.attitude_s, window_s[1])
    burns = [Leg(Mode.DELTA_V, time - before_burn, time) for time in times_s[1:]]
    # Everything that is not sun-pointing, in order, with the first burn as an instant at zero.
    busy = [Leg(Mode.DELTA_V, 0.0, 0.0)]
    busy += [leg for leg in burns if leg.end_s <= middle]
    observation_at = len(busy)
    busy += [observation] + [leg for leg in burns if leg.end_s > middle]

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
            raise _too_short(burn, times_s, window_s, intervals, previous, leg, sun_leg)
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
) -> InputError:
    rule = (
        f"rule 'a sun-pointing leg lasts at least one slew and one recharge, {sun_leg:g} s' is "
        f"broken: {previous.mode} mode ends at {previous.end_s:g} s and {leg.mode} mode must start "
        f"at {leg.start_s:g} s"
    )
    if burn == 0:  # which cannot move: the window has to
        given = f"[{window_s[0]:g}, {window_s[1]:g}] s"
        return InputError("observation.window_s", given, f"{rule}; it must open later")
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
        f"{rule}; with the others kept this burn may be {moved}",
    )
