"""Move burns that are left of a flight, within the rules, to where the rest is cheapest."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scp_recon.errors import InputError, option
from scp_recon.mission.mission import Mission
from scp_recon.passes.space import Pass, Space
from scp_recon.passes.timing import Effort, Timing
from scp_recon.replanning.flown import FlownPlan
from scp_recon.replanning.remainder import path_planned

EFFORT = Effort(rounds=6, worth=1e-3, iterations=40)
DIGITS = 1
"""Times are given to tenths of a second."""


@dataclass(frozen=True)
class Rest(Space):
    """The rest of a flight with its burns at other times; those of burns flown stay."""

    @property
    def has_home(self) -> bool:
        """A state in flight is no phase, and so the arrival's is given too."""
        return False

    def mission_of(self, one: Pass) -> Mission:
        """The mission with other times of its burns, which keep the rules."""
        return self.mission.changed({"burns.times_s": one.times_s})


def with_free_times(flown: FlownPlan, mission: Mission) -> Mission:
    """The rest of a flight with the times at which it is cheapest; the last burn stays.

    Cut-offs of corrected burns move along. Where no plan is found, times stay.

    Args:
        flown: the plan in flight.
        mission: the rest, from `mission_left`.

    Raises:
        InputError: if no burn is left that may move.
    """
    scenario = mission.scenario
    times, done = scenario.burns.times_s, scenario.burns_flown
    if len(times) - done < 2:
        left = f"only burn {len(times)} at {times[-1]:g} s left, whose time is the arrival's"
        raise InputError(option("free_times"), left, "needs another burn that is left")
    earliest = scenario.start_s + scenario.navigation.lead_s
    inner = [(earliest, times[-1])] * (len(times) - done - 1)
    spans = [*((time, time) for time in times[:done]), *inner, (times[-1],) * 2]
    state = mission.initial_state
    space = Rest(
        mission,
        lambda _: state,
        mission.schedule.window_s,
        ((0.0, 0.0), (1.0, 1.0)),
        tuple((low, high) for low, high in spans),
    )
    certain = flown.problem == "P3"
    burns = path_planned(flown, mission).burns * mission.units.speed_m_s
    timing = Timing(space, 0, certain)
    best = timing.descend(Pass((0.0, 1.0), times), burns, lambda _: None, EFFORT)
    if not best.converged:
        return mission
    rounded = tuple(np.round(best.at.times_s[done:-1], DIGITS).tolist())
    found = space.mission_of(replace(best.at, times_s=(*times[:done], *rounded, times[-1])))
    return replace(found, warnings=mission.warnings)
