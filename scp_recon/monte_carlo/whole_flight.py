"""Which flights keep all limits on the position, at the nodes and between them.

Limits of the observation count in the window, that of safety everywhere. Between looks a flight is
known to the second where it comes near a limit: farther off, none bends enough in half a minute to
reach one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.observation_time import joint_margins
from scp_recon.monte_carlo.sampling import BLOCK, fly_block
from scp_recon.physics.flow import interpolate

Array = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]

SAFETY = "safety_radius"
LOOK_S = 30.0
PARTS = 30
"""Of the time between looks: a second each."""
NEAR = {SAFETY: 0.5, "site_distance": 0.5}
NEAR_RAD = 1e-3
"""Margin, m and rad, below which a flight is looked at between looks. In half a minute it bends by a
few millimetres."""


@dataclass(frozen=True)
class KeptFlights:
    """How many of some flights keep what.

    Attributes:
        samples: flights.
        at_nodes: of each joint constraint at each of its nodes, shape (n,).
        throughout: of each joint constraint the least at any second.
        whole_at_nodes: flights that keep everything at all nodes.
        whole: flights that keep everything at all times.
        touched_s: times between nodes at which flights break something that keep everything at nodes.
    """

    samples: int
    at_nodes: dict[str, Counts]
    throughout: dict[str, int]
    whole_at_nodes: int
    whole: int
    touched_s: Array


def kept_flights(mission: Mission, burns_m_s: Array, samples: int, seed: int) -> KeptFlights:
    """Fly a plan with the planner's dynamics and see what holds.

    Args:
        mission: limits, dynamics and uncertainty.
        burns_m_s: planned burns, shape (m, 3).
        samples: flights.
        seed: of all draws.
    """
    nodes = mission.times_s
    looks = np.union1d(np.arange(nodes[0], nodes[-1], LOOK_S), nodes)
    blocks = [
        _block(mission, burns_m_s, looks, number, min(BLOCK, samples - number * BLOCK), seed)
        for number in range(-(-samples // BLOCK))
    ]
    names = blocks[0].at_looks
    looked = {name: _times(mission, looks, name) for name in names}
    at_looks = {name: np.sum([b.at_looks[name] for b in blocks], axis=0) for name in names}
    between = {name: np.sum([b.between[name] for b in blocks], axis=0) for name in names}
    return KeptFlights(
        samples,
        {name: at_looks[name][np.isin(looked[name], nodes)] for name in names},
        {name: int(min(at_looks[name].min(), between[name].min())) for name in names},
        sum(b.whole_at_nodes for b in blocks),
        sum(b.whole for b in blocks),
        np.concatenate([b.touched_s for b in blocks]),
    )


@dataclass(frozen=True)
class _Block:
    at_looks: dict[str, Counts]
    between: dict[str, Counts]
    whole_at_nodes: int
    whole: int
    touched_s: Array


def _times(mission: Mission, looks: Array, name: str) -> Array:
    """The looks at which a constraint counts."""
    first, last = mission.observed_s or (np.inf, np.inf)
    return looks if name == SAFETY else looks[(looks >= first) & (looks <= last)]


def _margins(mission: Mission, times: Array, position: Array, names: list[str]) -> dict[str, Array]:
    """Margins of some joint constraints for positions (n, ..., 3) at times (n,)."""
    found: dict[str, Array] = {}
    if names != [SAFETY]:
        found = joint_margins(mission, times, position)
    if SAFETY in names:
        found[SAFETY] = np.linalg.norm(position, axis=-1) - mission.scenario.safety.radius_min_m
    return {name: found[name] for name in names}


def _block(
    mission: Mission, burns: Array, looks: Array, number: int, flights: int, seed: int
) -> _Block:
    states = fly_block(mission, burns, looks, number, flights=flights, seed=seed).states
    window = np.isin(looks, _times(mission, looks, ""))
    margins = _margins(mission, looks, states[..., :3], [SAFETY])
    if window.any():
        margins |= joint_margins(mission, looks[window], states[window, :, :3])
    kept_at_nodes, kept = np.ones(flights, dtype=bool), np.ones(flights, dtype=bool)
    at_looks, between, touches = {}, {}, []
    for name, margin in margins.items():
        times = _times(mission, looks, name)
        holds = margin >= 0.0
        at_looks[name] = holds.sum(axis=1)
        kept_at_nodes &= holds[np.isin(times, mission.times_s)].all(axis=0)
        at = states if name == SAFETY else states[window]
        counts, broken, time, flight = _between(mission, name, times, at, margin)
        between[name] = counts
        kept &= holds.all(axis=0) & ~broken
        touches.append(
            (
                np.concatenate([times[np.nonzero(~holds)[0]], time]),
                np.concatenate([np.nonzero(~holds)[1], flight]),
            )
        )
    lost = kept_at_nodes & ~kept
    touched = np.concatenate([time[lost[flight]] for time, flight in touches])
    return _Block(at_looks, between, int(kept_at_nodes.sum()), int(kept.sum()), touched)


def _between(
    mission: Mission, name: str, times: Array, states: Array, margin: Array
) -> tuple[Counts, npt.NDArray[np.bool_], Array, npt.NDArray[np.intp]]:
    """What holds at the seconds between looks.

    Returns:
        Flights that hold at each second, those that break it at any; and when which flight does.
    """
    low, high = np.minimum(margin[1:], margin[:-1]), np.maximum(margin[1:], margin[:-1])
    near = NEAR.get(name, NEAR_RAD)
    unclear = (low < near) & (high > -near)
    counts = np.repeat(((low >= 0.0) & ~unclear).sum(axis=1)[:, None], PARTS - 1, axis=1)
    k, flight = np.nonzero(unclear)
    step = (times[k + 1] - times[k])[:, None]
    ends = [(s[:, :3], s[:, 3:]) for s in (states[k, flight], states[k + 1, flight])]
    broken = np.zeros(margin.shape[1], dtype=bool)
    when, who = [np.zeros(0)], [np.zeros(0, dtype=np.intp)]
    for part in range(1, PARTS):
        share = part / PARTS
        position, _ = interpolate(ends[0], ends[1], step, share)
        time = times[k] + share * step[:, 0]
        holds = _margins(mission, time, position, [name])[name] >= 0.0
        np.add.at(counts[:, part - 1], k[holds], 1)
        broken[flight[~holds]] = True
        when.append(time[~holds])
        who.append(flight[~holds])
    return counts, broken, np.concatenate(when), np.concatenate(who)
