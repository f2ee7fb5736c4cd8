"""Sample flights, and decide at which times they keep the limits on their position.

Observation limits count in the window, safety distances throughout the flight. Flights are sampled
at nodes and every half minute, and every second between two samples if a margin may fall below zero
there. Second differences bound how far a margin falls below the line between the samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from formulations.arrays import Array, Booleans
from formulations.risk.strata import Counted
from formulations.rows.exact_flight import FLIGHT
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.limits import ALL, EVERYWHERE, Kept, kept_limits, limit_margins
from scp_recon.monte_carlo.sampling import FlightLog, Flyer
from scp_recon.physics.flow import interpolate

SAMPLE_STEP_S = 30.0
"""Longest time between two samples of a flight."""
PARTS = 30
"""Parts of the time between two samples, a second each."""
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
    flights: SampledFlights, samples: int, progress: Callable[[int], None] | None = None
) -> KeptCounts:
    """Fly so many flights, and count those that keep the limits.

    `progress` is called with the number flown so far after each block.
    """
    counts, touched, flown = np.zeros(1, dtype=np.intp), [np.zeros(0)], 0
    for draws in flights.blocks_of_draws(samples):
        seen = flights.judged(draws)
        parts = [holds.sum(axis=1) for _, holds in seen.kept.values()]
        counts, flown = counts + np.concatenate(parts), flown + len(draws)
        touched.append(seen.touched_s)
        if progress:
            progress(flown)
    times = np.concatenate([at for at, _ in seen.kept.values()])
    at_nodes, throughout = (
        int(counts[np.isin(times, flights.mission.times_s)].min()),
        int(counts.min()),
    )
    touched.append(less_likely(times, np.asarray(at_nodes - counts, dtype=float)))
    return KeptCounts(at_nodes, throughout, samples, np.concatenate(touched))


def less_likely(times: Array, fall: Array) -> Array:
    """Times at which the probability falls below the worst node by half of the largest fall or more."""
    return times[(fall > max(0.0, FALL * fall.max())) & np.isfinite(times)]


def sample_times(mission: Mission) -> Array:
    """Times at which flights are sampled, s: nodes, and others at most `SAMPLE_STEP_S` apart."""
    nodes = mission.times_s
    even = np.union1d(np.arange(nodes[0], nodes[-1], SAMPLE_STEP_S), nodes)
    return np.union1d(even, mission.edges.samples_s)


def every_second(times_s: Array) -> Array:
    """Sampled times (n,) and the seconds between, ascending, s, shape (PARTS (n - 1) + 1,)."""
    parts = times_s[:-1, None] + np.diff(times_s)[:, None] * (np.arange(PARTS) / PARTS)
    return np.append(parts.ravel(), times_s[-1])


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


class Judged(NamedTuple):
    """Limits that flights keep, and the times at which flights that keep all at nodes break one.

    Where flights are judged as a whole, `kept` has one entry: whether they keep all limits at all
    times, whose time is infinite, and at the nodes. Otherwise no times are told.
    """

    kept: Kept
    touched_s: Array = np.zeros(0)


@dataclass(frozen=True, eq=False)
class SampledFlights(Flyer):
    """Flies draws of the errors, and decides which limits the flights keep.

    Attributes:
        times_s: at which observation limits count, while safety distances count at nodes. If None, all
            limits count at every second, and together if the scope of risk is the flight.
    """

    times_s: Array | None = None

    @property
    def is_whole(self) -> bool:
        """Whether flights are judged as a whole."""
        return self.times_s is None and self.mission.scenario.risk.scope == "flight"

    @cached_property
    def counted_s(self) -> dict[str, Array]:
        """Times at which each joint constraint counts, ascending, s."""
        mission, samples = self.mission, sample_times(self.mission)
        names = dict.fromkeys(constraint.event for constraint in mission.problem.constraints)
        if self.is_whole:
            return {FLIGHT: np.array([np.inf, mission.times_s[0]])}
        if self.times_s is not None:
            always, observed = mission.times_s, self.times_s
            names |= {ALL: None}
        else:
            always, window = every_second(samples), samples[_in_window(mission, samples)]
            observed = every_second(window) if len(window) else window
        times = {name: always if name in EVERYWHERE else observed for name in names}
        return {name: at for name, at in times.items() if len(at)}

    def positions(self, draws: Array) -> Array:
        """Positions at the nodes, J2000, m, shape (n, flights, 3)."""
        return self.fly(self.mission.times_s, draws).states[..., :3]

    def judged(self, draws: Array) -> Judged:
        """The limits that flights keep at `counted_s`."""
        mission, nodes, certain = self.mission, self.mission.times_s, self.certain
        if self.times_s is not None:
            times = np.union1d(self.times_s, nodes)
            counted = (np.searchsorted(times, at) for at in (self.times_s, nodes))
            flown = self.fly(times, draws)
            position = flown.states[..., :3]
            margins = limit_margins(flown.mission, times, position, *counted, certain=certain)
            return Judged(kept_limits(margins, at_once=True))
        times = sample_times(mission)
        flown, window = self.fly(times, draws), _in_window(mission, times)
        position = flown.states[..., :3]
        margins = limit_margins(flown.mission, times, position, window, certain=certain)
        kept = {}
        for name, (at, margin) in margins.items():
            own = slice(None) if name in EVERYWHERE else window
            kept[name] = every_second(at), self._by_second(name, at, flown, own, margin)
        if not self.is_whole:
            return Judged(kept)
        all_kept, at_nodes = np.ones((2, len(draws)), dtype=bool)
        for at, holds in kept.values():
            all_kept &= holds.all(axis=0)
            at_nodes &= holds[np.isin(at, nodes)].all(axis=0)
        lost = at_nodes & ~all_kept
        touched = [at[np.nonzero(~holds[:, lost])[0]] for at, holds in kept.values()]
        whole = {FLIGHT: (self.counted_s[FLIGHT], np.stack([all_kept, at_nodes]))}
        return Judged(whole, np.concatenate(touched))

    def _by_second(
        self, name: str, times: Array, flown: FlightLog, own: Booleans | slice, margin: Array
    ) -> Booleans:
        """Whether flights with margins (n, flights) at sampled times keep a limit at every second.

        They are followed between samples whose margins leave a violation possible.
        """
        states, holds = flown.states[own], margin >= 0.0
        low, high = np.minimum(margin[1:], margin[:-1]), np.maximum(margin[1:], margin[:-1])
        near = may_dip(times, margin)
        k, flight = np.nonzero((low < near) & (high > -near))
        step = (times[k + 1] - times[k])[:, None]
        start, end = states[k, flight], states[k + 1, flight]
        mission = flown.mission.some_flights(flight)
        for number, time in enumerate(mission.scenario.burn_times_s):
            burning = times[k + 1] == time  # the next sample's velocity is that after its burn
            end[burning, 3:] -= flown.burns_m_s[flight[burning], number]
        observed = slice(0) if name in EVERYWHERE else slice(None)
        every = np.repeat((holds[1:] & holds[:-1])[:, None], PARTS, axis=1)
        every[:, 0] = holds[:-1]
        for part in range(1, PARTS) if len(k) else ():
            share = part / PARTS
            position, _ = interpolate(
                (start[:, :3], start[:, 3:]), (end[:, :3], end[:, 3:]), step, share
            )
            seconds = times[k] + share * step[:, 0]
            found = limit_margins(mission, seconds, position, observed, certain=self.certain)
            every[k, part, flight] = found[name][1] >= 0.0
        return np.concatenate([every.reshape(-1, holds.shape[1]), holds[-1:]])


def _in_window(mission: Mission, times: Array) -> Booleans:
    first, last = mission.edges.watched_s or (np.inf, np.inf)
    return (times >= first) & (times <= last)
