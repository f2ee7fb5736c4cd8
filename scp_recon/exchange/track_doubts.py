"""What is strange about a trajectory from elsewhere and cannot be refused; it goes with the plan."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import numpy as np

from scp_recon.draft.flown import Track
from scp_recon.environment.kernels import read_states
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.physics.flow import propagate
from scp_recon.scenario.warning import ScenarioWarning

STATES, SUBSTEPS = 60, 20
"""Of a trajectory, carried from each to the next; and steps of RK4 between two."""
PULL_OFF_MAX = 0.3
"""Of the change of velocity, in the middle of all: how far the planner's may be from it."""
GAP_MAX = 10.0
"""Of the usual step, what is no gap."""
SPREAD_MAX, APART_MAX = 0.5, 1e-3
"""Of the way, and of the distance from the centre: how far off velocities may lead."""
LATE_MAX_S = 1.0
"""From the asked ends of a trajectory to those that it has."""
BESIDE_S, JUMP_MAX_M_S = 1.0, 1e-3
"""How near an end a burn is looked for, and what is none."""


def pull_doubts(mission: Mission, track: Track) -> Iterator[ScenarioWarning]:
    """Whether the body pulls as the trajectory bends: not so another body's, or axes that turn.

    States are carried to later ones by the planner's forces; half of them have to arrive with about the
    change of velocity that the trajectory has. Axes that stand still and are turned look the same.
    """
    chosen = np.unique(np.linspace(0, len(track.times_s) - 1, STATES + 1).astype(int))
    times, states = track.times_s[chosen], track.states[chosen]
    took = np.diff(times)
    later = took > 0.0
    arrived = propagate(states[:-1][later], took[later], mission.forces, SUBSTEPS)
    gained = np.linalg.norm((states[1:] - states[:-1])[later, 3:], axis=1)
    off = np.linalg.norm(arrived[:, 3:] - states[1:][later, 3:], axis=1)
    share = float(np.median(off) / max(float(np.median(gained)), 1e-12))
    if not share <= PULL_OFF_MAX:
        yield ScenarioWarning.of(
            "trajectory",
            f"{track.source}, whose velocity changes by {100.0 * share:.3g} % of itself otherwise than "
            f"{mission.scenario.body.name} and sunlight would change it",
            f"below {100.0 * PULL_OFF_MAX:g} % would be no surprise: body, inertial axes, m and s?",
        )


def step_doubts(track: Track) -> Iterator[ScenarioWarning]:
    """Whether there is a gap, or a state that is not where its neighbours' velocities lead."""
    times, position, velocity = track.times_s, track.states[:, :3], track.states[:, 3:]
    took = np.diff(times)
    usual, k = float(np.median(took[took > 0.0])), int(np.argmax(took))
    if took[k] > GAP_MAX * usual:
        yield ScenarioWarning.of(
            "trajectory",
            f"{track.source}, without a state from {times[k]:g} to {times[k + 1]:g} s",
            f"states are usually {usual:.3g} s apart",
        )
    way = 0.5 * (velocity[1:] + velocity[:-1]) * took[:, None]
    off = np.linalg.norm(np.diff(position, axis=0) - way, axis=1)
    speed = np.linalg.norm(velocity, axis=1)
    allowed = SPREAD_MAX * np.maximum(speed[1:], speed[:-1]) * took
    off -= allowed + APART_MAX * np.linalg.norm(position[1:], axis=1)
    off[took > GAP_MAX * usual] = 0.0
    if off.max() > 0.0:
        k = int(np.argmax(off))
        yield ScenarioWarning.of(
            "trajectory",
            f"{track.source}, whose positions jump between {times[k]:g} and {times[k + 1]:g} s",
            "they are usually where the velocities lead",
        )


def late_doubts(
    begin: datetime | None, end: datetime | None, got: tuple[datetime, datetime]
) -> Iterator[ScenarioWarning]:
    """Whether a trajectory begins and ends where it was asked to (TDB)."""
    for entry, asked, found in (("--from", begin, got[0]), ("--to", end, got[1])):
        off = 0.0 if asked is None else (found - asked).total_seconds()
        if abs(off) > LATE_MAX_S:
            yield ScenarioWarning.of(
                entry,
                f"a time {abs(off):.3f} s {'before' if off > 0.0 else 'after'} the nearest state",
                "the trajectory is taken from state to state: the plan "
                f"{'begins' if entry == '--from' else 'ends'} at that one",
            )


def jump_doubts(
    meta: Path, spacecraft: int, body: int, ends: tuple[float, float], entry: str
) -> Iterator[ScenarioWarning]:
    """Whether kernels have a burn just outside of a trajectory's ends, TDB seconds past J2000."""
    for flag, at, out in (("--from", ends[0], -BESIDE_S), ("--to", ends[1], BESIDE_S)):
        beside = at + out * np.array([1.0, 0.5, 0.0])
        try:
            outside, between, here = read_states([meta], spacecraft, body, beside, entry)[:, 3:]
        except InputError:  # they have nothing there
            continue
        jump = float(np.linalg.norm(2.0 * between - outside - here))
        if jump > JUMP_MAX_M_S:
            side, beyond = ("before", "earlier") if out < 0.0 else ("after", "later")
            yield ScenarioWarning.of(
                flag,
                f"a time with a jump of {jump:.4f} m/s within {BESIDE_S:g} s {side} it",
                f"the boundary state is without it: {BESIDE_S:g} s {beyond} if that is a burn of the "
                "plan",
            )
