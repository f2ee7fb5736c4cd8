"""What of a mission is left for a flight that is under way: its schedule, and whether that is legal."""

from __future__ import annotations

from dataclasses import replace

from scp_recon.errors import InputError
from scp_recon.mission.schedule import Schedule
from scp_recon.scenario.schema import Scenario

BURNS_TO_MEET = 2
"""Burns that meet a final state: it has six components, and a burn three."""

MISS_WEIGHT = 10.0
"""Price of each component of the final state's miss where fewer are left, in units of length and speed.

A speed that is missed takes a later burn as large, and a distance one of its size over a unit of time:
a weight of one would leave it open whether to burn or to miss. With ten the burn goes as near to the
final state as its limits let it, whatever that costs, as the program weighs a miss in any case.
"""


def check_in_flight(scenario: Scenario) -> None:
    """Refuse a state that leaves nothing to plan, or no time for it.

    Raises:
        InputError: if no burn is left, the next one is nearer than the decision lead time, or as many
            burns are not given as have been flown.
    """
    flight = scenario.in_flight
    if flight is None:
        return
    entry, at, times = "in_flight.at_s", flight.at_s, scenario.burns.times_s
    lead = scenario.schedule.decision_lead_s
    latest = f"{times[-1] - lead:g} s"
    if not scenario.burn_times_s:
        raise InputError(
            entry,
            f"{at:g} s, at or after the last burn at {times[-1]:g} s",
            f"must leave a burn to plan: at most {latest}",
        )
    following = scenario.burn_times_s[0]
    if following - at < lead:
        number = scenario.burns_flown + 1
        later = "" if number == len(times) else f", or {following:g} s and more, once it is flown"
        raise InputError(
            entry,
            f"{at:g} s, {following - at:g} s before burn {number} at {following:g} s",
            f"must leave the decision lead time, schedule.decision_lead_s = {lead:g} s, before the "
            f"next burn: at most {following - lead:g} s{later}",
        )
    if len(flight.flown_m_s) != scenario.burns_flown:
        raise InputError(
            "in_flight.flown_m_s",
            f"{len(flight.flown_m_s)} burns",
            f"must be the {scenario.burns_flown} burns at or before in_flight.at_s, {at:g} s",
        )


def what_is_left(schedule: Schedule, scenario: Scenario) -> Schedule:
    """The schedule from the state in flight on; the window stays whole, as the light has it."""
    if scenario.in_flight is None:
        return schedule
    at, flown = scenario.start_s, scenario.burns_flown
    earliest = at + scenario.schedule.decision_lead_s
    return Schedule(
        schedule.window_s,
        tuple(
            replace(leg, start_s=max(leg.start_s, at)) for leg in schedule.legs if leg.end_s > at
        ),
        tuple((max(low, earliest), high) for low, high in schedule.firing_intervals_s[flown:]),
    )
