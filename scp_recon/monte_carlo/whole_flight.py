"""Count flights that keep all limits on the position, at the nodes and between them.

Observation limits count in the window, safety distances throughout the flight. Flights are sampled
at times called looks. Between two looks they are sampled every second if a margin may fall below
zero there. Second differences bound how far a margin falls below the line between the looks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array, Booleans, Indices
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.limits import (
    EVERYWHERE,
    PARTS,
    Counts,
    LimitHistory,
    limit_margins,
)
from scp_recon.monte_carlo.sampling import BLOCK, FlightLog, draw_flights, fly_draws
from scp_recon.physics.flow import interpolate
from scp_recon.results.policy import Policy

State = tuple[Array, Array]

LOOK_S = 30.0
BENDS = 4.0
"""Times the dip h^2 |m''| / 8 of a parabola that a margin may dip between two looks h apart. With two,
a margin that falls and rises at one speed would be missed where it turns between them."""
FALL = 0.5
"""Share of the largest fall of a probability between nodes from which on a second counts as touched."""


@dataclass(frozen=True)
class KeptFlights:
    """Numbers of flights that keep the limits.

    Attributes:
        samples: flights.
        at_nodes: of each joint constraint at each of its nodes, shape (n,).
        throughout: least number at any second, of each joint constraint.
        whole_at_nodes: flights that keep everything at all nodes.
        whole: flights that keep everything at all times.
        touched_s: times between nodes with more violations than at nodes. With the scope `flight`:
            times at which flights that keep all limits at nodes break one. With `node`: seconds at
            which a constraint is less likely than every constraint at a node, by more than half of
            the largest fall.
    """

    samples: int
    at_nodes: dict[str, Counts]
    throughout: dict[str, int]
    whole_at_nodes: int
    whole: int
    touched_s: Array


def kept_flights(
    mission: Mission,
    burns_m_s: Array,
    samples: int,
    seed: int,
    progress: Callable[[int], None] | None = None,
    policy: Policy = (),
) -> KeptFlights:
    """Fly a plan's burns, J2000, m/s, shape (m, 3), with the planner's dynamics and count limits kept.

    A policy corrects the burns. `progress` is called with the number flown so far after each block.
    """
    nodes, looks = mission.times_s, looks_of(mission)
    fly, blocks = WholeFlights(mission, burns_m_s, policy), []
    for begun in range(0, samples, BLOCK):
        flights = min(BLOCK, samples - begun)
        draws = draw_flights(mission, burns_m_s, seed, begun // BLOCK, policy=policy)[:flights]
        blocks.append(fly.count(draws))
        if progress:
            progress(begun + flights)
    names = blocks[0].at_looks
    looked = {name: _times(mission, looks, name) for name in names}
    at_looks = {name: np.sum([b.at_looks[name] for b in blocks], axis=0) for name in names}
    between = {name: np.sum([b.between[name] for b in blocks], axis=0) for name in names}
    at_nodes = {name: at_looks[name][np.isin(looked[name], nodes)] for name in names}
    touched = np.concatenate([b.touched_s for b in blocks])
    if mission.scenario.risk.scope == "node":
        least = min(int(counts.min()) for counts in at_nodes.values())
        touched = less_likely(
            np.concatenate([_seconds(looked[name]) for name in names]),
            least - np.concatenate([_every(at_looks[name], between[name]) for name in names]),
        )
    return KeptFlights(
        samples,
        at_nodes,
        {name: int(_every(at_looks[name], between[name]).min()) for name in names},
        sum(int(b.kept_at_nodes.sum()) for b in blocks),
        sum(int(b.kept.sum()) for b in blocks),
        touched,
    )


def _seconds(looks: Array) -> Array:
    """Looks and the times between them, in the order of `_every`."""
    share = np.arange(1, PARTS) / PARTS
    return np.concatenate([looks, (looks[:-1, None] + np.diff(looks)[:, None] * share).ravel()])


def _every(at_looks: Counts, between: Counts) -> Counts:
    """Counts at the looks, then those between them."""
    return np.concatenate([at_looks, between.ravel()])


def less_likely(times: Array, fall: Array) -> Array:
    """Times at which the probability falls below the worst node by half of the largest fall or more."""
    return times[fall > max(0.0, FALL * fall.max())]


@dataclass(frozen=True)
class BlockLimits:
    """Limits that some flights keep: counts at looks and between, and flights that keep everything.

    Attributes:
        at_looks: flights that keep each joint constraint at its looks, shape (n,).
        between: the same of seconds between looks, shape (n - 1, PARTS - 1).
        kept_at_nodes: flights that keep everything at all nodes, shape (flights,).
        kept: flights that keep everything at all times, shape (flights,).
        touched_s: times at which flights that keep all limits at nodes break one.
    """

    at_looks: dict[str, Counts]
    between: dict[str, Counts]
    kept_at_nodes: Booleans
    kept: Booleans
    touched_s: Array


def looks_of(mission: Mission) -> Array:
    """Times at which flights are sampled, s: nodes, and others at most `LOOK_S` apart."""
    nodes = mission.times_s
    return np.union1d(np.arange(nodes[0], nodes[-1], LOOK_S), nodes)


def seconds_of(mission: Mission) -> dict[str, Array]:
    """Times at which each joint constraint counts, ascending, s: looks and the seconds between."""
    constraints = mission.problem.constraints
    names = dict.fromkeys(constraint.event for constraint in constraints)
    looks = {name: _times(mission, looks_of(mission), name) for name in names}
    return {name: np.sort(_seconds(times)) for name, times in looks.items() if len(times)}


def _times(mission: Mission, looks: Array, name: str) -> Array:
    """The looks at which a constraint counts."""
    first, last = mission.observed_s or (np.inf, np.inf)
    return looks if name in EVERYWHERE else looks[(looks >= first) & (looks <= last)]


def _margin(mission: Mission, times: Array, position: Array, name: str) -> Array:
    """Margin of a joint constraint for positions (n, ..., 3) at times (n,)."""
    observed = slice(0) if name in EVERYWHERE else slice(None)
    return limit_margins(mission, times, position, observed)[name][1]


@dataclass(frozen=True)
class _Arcs:
    """Flights between looks: times (n,), states after burns (n, flights, 6), burns as flown."""

    times: Array
    states: Array
    burns: Array

    def ends(self, mission: Mission, k: Indices, flight: Indices) -> tuple[State, State]:
        """Positions and velocities, (n, 3), after looks k and at the next ones, before a burn there."""
        start, end = self.states[k, flight], self.states[k + 1, flight]
        velocity = end[:, 3:].copy()
        for number, time in enumerate(mission.scenario.burn_times_s):
            burning = self.times[k + 1] == time
            velocity[burning] -= self.burns[flight[burning], number]
        return (start[:, :3], start[:, 3:]), (end[:, :3], velocity)


def may_dip(times: Array, margin: Array) -> Array:
    """Bound on how far margins dip below, or rise above, the line between two looks, (n - 1, ...).

    From the looks' times (n,) and margins (n, ...), by second differences about both: see `BENDS`.
    """
    if len(times) < 3:
        return np.full((len(times) - 1, *margin.shape[1:]), np.inf)
    step = np.diff(times).reshape(-1, *[1] * (margin.ndim - 1))
    slope = np.diff(margin, axis=0) / step
    bend = np.abs(np.diff(slope, axis=0)) / (0.5 * (step[1:] + step[:-1]))
    padded = np.concatenate([bend[:1], bend, bend[-1:]])
    return np.asarray(BENDS * step**2 / 8.0 * np.maximum(padded[1:], padded[:-1]))


def _follow(mission: Mission, name: str, arcs: _Arcs, margin: Array) -> LimitHistory:
    """Follow flights by the second between looks whose margins leave a violation possible."""
    times = arcs.times
    low, high = np.minimum(margin[1:], margin[:-1]), np.maximum(margin[1:], margin[:-1])
    near = may_dip(times, margin)
    k, flight = np.nonzero((low < near) & (high > -near))
    step = (times[k + 1] - times[k])[:, None]
    ends = arcs.ends(mission, k, flight)
    between = np.empty((len(k), PARTS - 1), dtype=bool)
    for part in range(1, PARTS) if len(k) else ():
        share = part / PARTS
        position, _ = interpolate(ends[0], ends[1], step, share)
        time = times[k] + share * step[:, 0]
        between[:, part - 1] = _margin(mission, time, position, name) >= 0.0
    return LimitHistory(name, times, margin >= 0.0, k, flight, between)


@dataclass(frozen=True)
class WholeFlights:
    """Flies draws of the errors with a plan's burns, J2000, m/s, shape (m, 3), and its policy."""

    mission: Mission
    burns_m_s: Array
    policy: Policy = ()

    def positions(self, draws: Array) -> Array:
        """Positions at the nodes, J2000, m, shape (n, flights, 3)."""
        return self._fly(self.mission.times_s, draws).states[..., :3]

    def count(self, draws: Array) -> BlockLimits:
        """Limits that the flights keep, at the nodes and between them."""
        histories = list(self.histories(draws))
        kept_at_nodes, kept = np.ones((2, len(draws)), dtype=bool)
        for history in histories:
            kept_at_nodes &= history.holds[np.isin(history.times_s, self.mission.times_s)].all(
                axis=0
            )
            kept &= history.kept
        lost = kept_at_nodes & ~kept
        broken = [history.broken for history in histories] if lost.any() else []
        return BlockLimits(
            {history.name: history.holds.sum(axis=1) for history in histories},
            {history.name: history.counts_between for history in histories},
            kept_at_nodes,
            kept,
            np.concatenate([np.zeros(0), *(time[lost[flight]] for time, flight in broken)]),
        )

    def histories(self, draws: Array) -> Iterator[LimitHistory]:
        """How they keep each joint constraint."""
        mission, looks = self.mission, looks_of(self.mission)
        flown = self._fly(looks, draws)
        states, window = flown.states, np.isin(looks, _times(mission, looks, ""))
        everywhere = _Arcs(looks, states, flown.burns_m_s)
        observing = _Arcs(looks[window], states[window], flown.burns_m_s)
        for name, (_, margin) in limit_margins(mission, looks, states[..., :3], window).items():
            yield _follow(mission, name, everywhere if name in EVERYWHERE else observing, margin)

    def _fly(self, times_s: Array, draws: Array) -> FlightLog:
        return fly_draws(self.mission, self.burns_m_s, times_s, draws, policy=self.policy)
