"""Sample flights, and decide at which times they keep the limits on their position.

Observation limits count in the window, safety distances throughout the flight. Flights are sampled
at nodes and every half minute, and every second between two samples if a margin may fall below zero
there. Second differences bound how far a margin falls below the line between the samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from formulations.arrays import Array, Booleans
from formulations.risk.strata import Counted
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.limits import (
    EVERYWHERE,
    PARTS,
    Counts,
    LimitHistory,
    every_second,
    limit_margins,
    limits_kept,
)
from scp_recon.monte_carlo.sampling import FlightLog, Flyer
from scp_recon.physics.flow import interpolate
from scp_recon.results.policy import Policy

SAMPLE_STEP_S = 30.0
"""Longest time between two samples of a flight."""
BENDS = 4.0
"""Times the dip h^2 |m''| / 8 of a parabola that a margin may dip between two samples h apart. With
two, a margin that falls and rises at one speed would be missed where it turns between them."""
FALL = 0.5
"""Share of the largest fall of a probability between nodes from which on a second counts as touched."""


class KeptCounts(NamedTuple):
    """Numbers of flights that keep the limits of the required scope.

    With the scope `flight` they are flights that keep all limits, with `node` those that keep the joint
    constraint that fewest keep, at the time when fewest do. Flights in strata count as the number of
    plain flights with the same standard error.

    Attributes:
        at_nodes: at the nodes.
        throughout: at every second.
        samples: flights.
        touched_s: times between nodes with more violations than at nodes. With the scope `flight`:
            times at which flights that keep all limits at nodes break one. With `node`: seconds at
            which a constraint is less likely than every constraint at a node, by more than half of
            the largest fall.
        strata: counts of flights in strata; None for plain flights.
    """

    at_nodes: float
    throughout: float
    samples: int
    touched_s: Array = np.zeros(0)
    strata: Counted | None = None


def kept_flights(
    mission: Mission,
    burns_m_s: Array,
    samples: int,
    seed: int,
    progress: Callable[[int], None] | None = None,
    policy: Policy = (),
) -> KeptCounts:
    """Fly a plan's burns, J2000, m/s, shape (m, 3), with the planner's dynamics and count limits kept.

    A policy corrects the burns. `progress` is called with the number flown so far after each block.
    """
    sampled, blocks = SampledFlights(mission, burns_m_s, policy), []
    for draws in sampled.blocks_of_draws(samples, seed):
        blocks.append(sampled.count(draws))
        if progress:
            progress(sum(len(block.kept) for block in blocks))
    if mission.scenario.risk.scope == "flight":
        at_nodes = sum(int(block.kept_at_nodes.sum()) for block in blocks)
        kept = sum(int(block.kept.sum()) for block in blocks)
        return KeptCounts(at_nodes, kept, samples, np.concatenate([b.touched_s for b in blocks]))
    seconds, names = seconds_of(mission), blocks[0].counts
    times = np.concatenate([seconds[name] for name in names])
    counts = np.concatenate([np.sum([b.counts[name] for b in blocks], axis=0) for name in names])
    least = int(counts[np.isin(times, mission.times_s)].min())
    return KeptCounts(least, int(counts.min()), samples, less_likely(times, least - counts))


def less_likely(times: Array, fall: Array) -> Array:
    """Times at which the probability falls below the worst node by half of the largest fall or more."""
    return times[fall > max(0.0, FALL * fall.max())]


@dataclass(frozen=True)
class BlockLimits:
    """Limits that some flights keep.

    Attributes:
        counts: flights that keep each joint constraint at the times of `seconds_of`.
        kept_at_nodes: flights that keep everything at all nodes, shape (flights,).
        kept: flights that keep everything at all times, shape (flights,).
        touched_s: times at which flights that keep all limits at nodes break one.
    """

    counts: dict[str, Counts]
    kept_at_nodes: Booleans
    kept: Booleans
    touched_s: Array


def sample_times(mission: Mission) -> Array:
    """Times at which flights are sampled, s: nodes, and others at most `SAMPLE_STEP_S` apart."""
    nodes = mission.times_s
    even = np.union1d(np.arange(nodes[0], nodes[-1], SAMPLE_STEP_S), nodes)
    return np.union1d(even, mission.edges.samples_s)


def seconds_of(mission: Mission) -> dict[str, Array]:
    """Times at which each joint constraint counts, ascending, s: samples and the seconds between."""
    samples, seconds = sample_times(mission), {}
    for name in dict.fromkeys(constraint.event for constraint in mission.problem.constraints):
        times = samples if name in EVERYWHERE else samples[_in_window(mission, samples)]
        if len(times):
            seconds[name] = every_second(times)
    return seconds


def _in_window(mission: Mission, times: Array) -> Booleans:
    first, last = mission.edges.watched_s or (np.inf, np.inf)
    return (times >= first) & (times <= last)


def may_dip(times: Array, margin: Array) -> Array:
    """Bound on how far margins dip below, or rise above, the line between two samples, (n - 1, ...).

    From times (n,) and margins (n, ...) of the samples, by second differences about both: see `BENDS`.
    """
    if len(times) < 3:
        return np.full((len(times) - 1, *margin.shape[1:]), np.inf)
    step = np.diff(times).reshape(-1, *[1] * (margin.ndim - 1))
    slope = np.diff(margin, axis=0) / step
    bend = np.abs(np.diff(slope, axis=0)) / (0.5 * (step[1:] + step[:-1]))
    padded = np.concatenate([bend[:1], bend, bend[-1:]])
    return np.asarray(BENDS * step**2 / 8.0 * np.maximum(padded[1:], padded[:-1]))


@dataclass(frozen=True, eq=False)
class SampledFlights(Flyer):
    """Flies draws of the errors, and decides which limits the flights keep.

    Attributes:
        times_s: at which observation limits count, while safety distances count at nodes. If None, all
            limits count at every second.
    """

    times_s: Array | None = None

    def positions(self, draws: Array) -> Array:
        """Positions at the nodes, J2000, m, shape (n, flights, 3)."""
        return self.fly(self.mission.times_s, draws).states[..., :3]

    def count(self, draws: Array) -> BlockLimits:
        """Limits that the flights keep, at the nodes and between them."""
        histories = list(self.histories(draws))
        kept_at_nodes, kept = np.ones((2, len(draws)), dtype=bool)
        for history in histories:
            at_nodes = np.isin(history.times_s, self.mission.times_s)
            kept_at_nodes &= history.holds[at_nodes].all(axis=0)
            kept &= history.kept
        lost = kept_at_nodes & ~kept
        broken = [history.broken for history in histories] if lost.any() else []
        touched = np.concatenate([np.zeros(0), *(time[lost[flight]] for time, flight in broken)])
        counts = {history.name: history.counts for history in histories}
        return BlockLimits(counts, kept_at_nodes, kept, touched)

    def histories(self, draws: Array) -> Iterator[LimitHistory]:
        """How they keep each joint constraint; at given times the observation's together too."""
        mission, nodes = self.mission, self.mission.times_s
        if self.times_s is not None:
            times = np.union1d(self.times_s, nodes)
            observed, everywhere = (np.searchsorted(times, at) for at in (self.times_s, nodes))
            flown = self.fly(times, draws)
            position = flown.states[..., :3]
            margins = limit_margins(
                flown.mission, times, position, observed, everywhere, certain=self.certain
            )
            kept = limits_kept(margins)
            for name, holds in kept.items():
                yield LimitHistory(name, nodes if name in EVERYWHERE else self.times_s, holds)
            return
        times = sample_times(mission)
        flown, window = self.fly(times, draws), _in_window(mission, times)
        position, certain = flown.states[..., :3], self.certain
        margins = limit_margins(flown.mission, times, position, window, certain=certain)
        for name, (_, margin) in margins.items():
            own = slice(None) if name in EVERYWHERE else window
            yield self._follow(name, times[own], flown, flown.states[own], margin)

    def _follow(
        self, name: str, times: Array, flown: FlightLog, states: Array, margin: Array
    ) -> LimitHistory:
        """Follow flights by the second between samples whose margins leave a violation possible.

        Samples are times (n,), states after burns (n, flights, 6), and margins (n, flights).
        """
        burns = flown.burns_m_s
        low, high = np.minimum(margin[1:], margin[:-1]), np.maximum(margin[1:], margin[:-1])
        near = may_dip(times, margin)
        k, flight = np.nonzero((low < near) & (high > -near))
        step = (times[k + 1] - times[k])[:, None]
        start, end = states[k, flight], states[k + 1, flight]
        mission = flown.mission.some_flights(flight)
        for number, time in enumerate(mission.scenario.burn_times_s):
            burning = times[k + 1] == time  # the next sample's velocity is that after its burn
            end[burning, 3:] -= burns[flight[burning], number]
        observed = slice(0) if name in EVERYWHERE else slice(None)
        between = np.empty((len(k), PARTS - 1), dtype=bool)
        for part in range(1, PARTS) if len(k) else ():
            share = part / PARTS
            position, _ = interpolate(
                (start[:, :3], start[:, 3:]), (end[:, :3], end[:, 3:]), step, share
            )
            seconds = times[k] + share * step[:, 0]
            found = limit_margins(mission, seconds, position, observed, certain=self.certain)
            _, there = found[name]
            between[:, part - 1] = there >= 0.0
        return LimitHistory(name, times, margin >= 0.0, k, flight, between)
