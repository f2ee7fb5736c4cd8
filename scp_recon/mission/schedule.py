"""Find the observation window and lay out the attitude modes, of a whole flight or its rest."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from scp_recon.errors import InputError
from scp_recon.mission.legal_burns import (
    before_burn_s,
    burns_before,
    legal_times,
    other_windows,
    sun_leg_s,
)
from scp_recon.mission.windows import SCAN_STEP_S, Lighting, each_window, is_whole
from scp_recon.scenario.schema import Scenario, ScheduleRules


def find_window(
    scenario: Scenario, lighting: Lighting, step_s: float = SCAN_STEP_S
) -> tuple[float, float]:
    """The given window, or the first one wholly in the flight with the lighting required; s.

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

    slack = lighting.slack(limits)
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
        + other_windows(scenario, slack, lighting.incidence, step_s),
    )


class Mode(StrEnum):
    """Purpose of the attitude."""

    DELTA_V = "delta-V"
    SUN_POINTING = "sun-pointing"
    OBSERVATION = "observation"


@dataclass(frozen=True)
class Leg:
    """A mode and when it holds, s.

    Attributes:
        mode: of the attitude.
        start_s: past the epoch.
        end_s: past the epoch.
    """

    mode: Mode
    start_s: float
    end_s: float


@dataclass(frozen=True)
class Schedule:
    """Attitude modes, and the times to which each burn may move with the others kept."""

    window_s: tuple[float, float]
    """Observation window."""
    legs: tuple[Leg, ...]
    """Contiguous from the epoch, or a state in flight, to the last burn; the attitude of the first
    burn is acquired before."""
    firing_intervals_s: tuple[tuple[float, float], ...]
    """Earliest and latest time of each burn to be planned; both 0 for the flight's first, and the
    last has no latest time (infinity)."""


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
            broken = (
                f"rule 'a sun-pointing leg lasts at least one slew and one recharge, {sun_leg:g} s' "
                f"is broken: {previous.mode} mode ends at {previous.end_s:g} s and {leg.mode} mode "
                f"must start at {leg.start_s:g} s"
            )
            legal = legal_times(times_s, window_s, rules)
            if burn == 0:  # which cannot move: the window has to
                given = f"[{window_s[0]:g}, {window_s[1]:g}] s"
                raise InputError("observation.window_s", given, f"{broken}; {legal}")
            moved = _between(*intervals[burn])
            raise InputError(
                f"burns.times_s.{burn}",
                f"{times_s[burn]:g} s",
                f"{broken}; with the others kept this burn may be {moved}; {legal}",
            )
        if leg.start_s > previous.end_s:
            legs.append(Leg(Mode.SUN_POINTING, previous.end_s, leg.start_s))
        legs.append(leg)
    return Schedule(window_s, tuple(legs), tuple(intervals))


def _between(early: float, late: float) -> str:
    if early > late:
        return "nowhere"
    return f"between {early:g} s and {late:g} s" if late < np.inf else f"from {early:g} s on"


SAME_S = 1e-6
"""Times that are differences of others are the same within it."""

BURNS_TO_MEET = 2
"""Burns that meet a final state: it has six components, and a burn three."""

MISS_WEIGHT = 10.0
"""Price of each component of the final state's miss where fewer are left, in units of length and speed.

A speed that is missed takes a later burn as large, and a distance one of its size over a unit of time:
a weight of one would leave it open whether to burn or to miss. With ten the burn goes as near to the
final state as its limits let it, whatever that costs, as the program weighs a miss in any case.
"""


def check_in_flight(scenario: Scenario) -> None:
    """Refuse a state in flight after which no burn, or no time, is left to plan.

    Raises:
        InputError: if no burn is left, the next one is nearer than the lead time, or the
            number of burns given is not that of the burns flown.
    """
    flight = scenario.in_flight
    if flight is None:
        return
    entry, at, times = "in_flight.at_s", flight.at_s, scenario.burns.times_s
    lead = scenario.navigation.lead_s
    latest = f"{times[-1] - lead:g} s"
    if not scenario.burn_times_s:
        raise InputError(
            entry,
            f"{at:g} s, at or after the last burn at {times[-1]:g} s",
            f"must leave a burn to plan: at most {latest}",
        )
    following = scenario.burn_times_s[0]
    if following - at < lead - SAME_S:
        number = scenario.burns_flown + 1
        later = "" if number == len(times) else f", or {following:g} s and more, once it is flown"
        raise InputError(
            entry,
            f"{at:g} s, {following - at:g} s before burn {number} at {following:g} s",
            f"must leave the lead time, navigation.lead_s = {lead:g} s, before the next burn: "
            f"at most {following - lead:g} s{later}",
        )
    if len(flight.flown_m_s) != scenario.burns_flown:
        raise InputError(
            "in_flight.flown_m_s",
            f"{len(flight.flown_m_s)} burns",
            f"must be the {scenario.burns_flown} burns at or before in_flight.at_s, {at:g} s",
        )


def what_is_left(schedule: Schedule, scenario: Scenario) -> Schedule:
    """The schedule after the state in flight; the window is kept whole."""
    if scenario.in_flight is None:
        return schedule
    at, flown = scenario.start_s, scenario.burns_flown
    earliest = at + scenario.navigation.lead_s
    return Schedule(
        schedule.window_s,
        tuple(
            replace(leg, start_s=max(leg.start_s, at)) for leg in schedule.legs if leg.end_s > at
        ),
        tuple((max(low, earliest), high) for low, high in schedule.firing_intervals_s[flown:]),
    )
