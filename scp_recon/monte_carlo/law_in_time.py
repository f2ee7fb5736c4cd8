"""Fly few of many draws to estimate each joint constraint at each second separately.

A joint constraint at a second is an event. All events are estimated from the same flights. The law
predicts whether a draw keeps a constraint at the nodes and, by linear interpolation of the margin,
between them. Draws are sorted by their distance to a limit at the nodes where the limit is broken
most often, whatever the verdict. Strata of one margin therefore have one share, and the counts of
an event are those of `risk.strata` with its own verdicts. The limits of each event are exact. If
the largest upper limit of all events is below the allowed risk, so is the risk of the event that
fails most often, whichever event that is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array, Booleans, Indices
from formulations.risk.strata import (
    COUNT,
    EDGES,
    FAILS,
    Allocation,
    Counted,
    Survey,
    failed_at,
    most_at,
)
from scp_recon.monte_carlo.law import (
    BEYOND,
    FAR,
    SURVEY_FLIGHTS,
    CountedFlights,
    Law,
    blocks_of,
    ending_unlike,
    survey_draws,
    tossed,
)
from scp_recon.monte_carlo.limits import Counts, LimitHistory
from scp_recon.monte_carlo.sampling import BLOCK
from scp_recon.monte_carlo.whole_flight import SampledFlights, less_likely

CONTENDS = 0.3
"""Share of the largest probability of failing, from which on a node has a part in sorting."""

LEVELS = COUNT // 2
"""Of how near a draw comes: next to a limit, near, and surely not."""


@dataclass(frozen=True)
class LawInTime:
    """Normal laws of joint constraints at the nodes, and where these contend for the largest failure.

    Attributes:
        laws: with the limits of each constraint; of those that may be broken.
        nodes_s: times of all nodes, shape (n,).
        contends: nodes of a law's span that have a part in sorting, by constraint, shape (nodes,).
    """

    laws: Mapping[str, Law]
    nodes_s: Array
    contends: Mapping[str, Booleans]

    @property
    def sources(self) -> int:
        """Number of standard normal numbers that a flight draws."""
        return next(iter(self.laws.values())).sources

    def margins(self, draws: Array) -> dict[str, Array]:
        """Margins of each constraint at the nodes of its span, m, shape (nodes, m)."""
        return {name: law.margins(draws) for name, law in self.laws.items()}

    def nearest(self, margins: Mapping[str, Array]) -> Array:
        """How near draws come to a limit that contends, m, shape (m,); zero if they cross it."""
        near = []
        for name, margin in margins.items():
            contends = self.contends[name]
            either = contends[1:] | contends[:-1]
            crosses = ((margin[1:] < 0.0) != (margin[:-1] < 0.0))[either].any(axis=0)
            near.append(np.where(crosses, 0.0, np.abs(margin[contends]).min(axis=0, initial=FAR)))
        return np.asarray(np.minimum.reduce(near))


def survey_in_time(
    laws: Mapping[str, Law], nodes_s: Array, flights: SampledFlights, seed: int
) -> tuple[LawInTime, Survey]:
    """Learn from a few draws which nodes may be the worst, and the law's least reliability there."""
    draws = survey_draws(next(iter(laws.values())), seed)
    margins = {name: law.margins(draws) for name, law in laws.items()}
    failed = {name: np.mean(margin < 0.0, axis=1) for name, margin in margins.items()}
    most = max(share.max() for share in failed.values())
    law = LawInTime(laws, nodes_s, {n: share >= CONTENDS * most for n, share in failed.items()})
    nearest = law.nearest(margins)
    chosen = np.argsort(nearest, kind="stable")[:SURVEY_FLIGHTS]
    flown = flights.positions(draws[chosen]), draws[chosen]
    off = {name: own.margins_at(*flown) - margins[name][:, chosen] for name, own in laws.items()}
    near = BEYOND * max(np.abs(off[name][law.contends[name]]).max(initial=0.0) for name in laws)
    level = levels_of(nearest, near)
    worst = max(failed, key=lambda name: float(failed[name].max()))
    stratum = _strata(margins[worst][np.argmax(failed[worst])] < 0.0, level)
    share = np.bincount(stratum, minlength=COUNT) / len(level)
    unlike = [
        ending_unlike(
            _strata(margins[name][node] < 0.0, level), margins[name][node], off[name][node]
        )
        for name, contends in law.contends.items()
        for node in np.flatnonzero(contends)
    ]
    return law, Survey(near, share, np.max(unlike, axis=0))


def levels_of(nearest: Array, near: float) -> Indices:
    """Level of draws that come so near to a limit, by the margin up to which a verdict is not sure."""
    return np.searchsorted(near * EDGES[LEVELS:], nearest, side="right")


def _strata(fails: Booleans | bool, level: Indices) -> Indices:
    """Stratum of a verdict and a level."""
    return np.where(fails, LEVELS - 1 - level, LEVELS + level)


def fly_in_time(
    law: LawInTime,
    flights: SampledFlights,
    times_s: Mapping[str, Array],
    allocation: Allocation,
    seed: int,
    tail: float,
    progress: Callable[[int, int], None] | None = None,
) -> CountedFlights:
    """Draw, sort draws, and fly the allotted share of each stratum.

    Args:
        law: of the draws.
        flights: fly them.
        times_s: at which each constraint counts, ascending.
        allocation: of the draws, whose shares are mirrored.
        seed: of the draws.
        tail: probability with which the limits may be missed by which the worst event is chosen.
        progress: called with the number of all, and that flown so far, after each block.
    """
    work = DrawsInTime(law, flights, times_s, allocation, seed)
    every = Events.all_of(work.count(blocks_of(allocation, seed), progress), allocation)
    at_nodes = every.at(np.isin(every.times_s, law.nodes_s))
    fall = every.failed - at_nodes.failed.max()
    return CountedFlights(
        every.worst(tail)[1], at_nodes.worst(tail)[1], less_likely(every.times_s, fall)
    )


@dataclass(frozen=True)
class Events:
    """Counts of events by stratum, shape (events, 6) each: draws, flights, and those unlike the law."""

    allocation: Allocation
    times_s: Array
    drawn: Counts
    flown: Counts
    unlike: Counts

    @classmethod
    def all_of(cls, counts: Mapping[str, CountsInTime], allocation: Allocation) -> Events:
        """The events of several constraints together."""
        parts = zip(*(count.by_stratum() for count in counts.values()), strict=True)
        times_s = np.concatenate([count.times_s for count in counts.values()])
        return cls(allocation, times_s, *(np.concatenate(part) for part in parts))

    def at(self, those: Booleans) -> Events:
        """Some of the events."""
        counts = (part[those] for part in (self.drawn, self.flown, self.unlike))
        return Events(self.allocation, self.times_s[those], *counts)

    @property
    def failed(self) -> Array:
        """Estimated probabilities of failing, shape (events,)."""
        return failed_at(self.allocation, self.drawn, self.unlike)

    def worst(self, tail: float) -> tuple[float, Counted]:
        """The event that may fail most often: its time, s, and its counts."""
        event = int(np.argmax(most_at(self.allocation, self.drawn, self.unlike, tail)))
        own = (tuple(part[event].tolist()) for part in (self.drawn, self.flown, self.unlike))
        return float(self.times_s[event]), Counted(self.allocation, *own)


@dataclass(frozen=True)
class DrawsInTime:
    """Work of a process: draw, fly and count. For its attributes see `fly_in_time`."""

    law: LawInTime
    flights: SampledFlights
    times_s: Mapping[str, Array]
    allocation: Allocation
    seed: int

    def count(
        self,
        blocks: Sequence[tuple[int, int]],
        progress: Callable[[int, int], None] | None = None,
    ) -> dict[str, CountsInTime]:
        """Count the flights of each constraint in blocks, each with its number of draws."""
        law = self.law
        spans = {name: law.nodes_s[own.span] for name, own in law.laws.items()}
        counts = {
            name: CountsInTime.none(spans.get(name, NEVER), times)
            for name, times in self.times_s.items()
        }
        share = np.array(self.allocation.share)[LEVELS:]
        chosen, levels = [np.zeros((0, law.sources))], [np.zeros(0, dtype=np.intp)]
        for block, size in blocks:
            some, coins = tossed(self.seed, law.sources, block, size)
            margins = law.margins(some)
            level = levels_of(law.nearest(margins), self.allocation.near)
            flown = coins < share[level]
            for name, count in counts.items():
                count.take_draws(margins.get(name), level, flown)
            chosen.append(some[flown])
            levels.append(level[flown])
        draws, level = np.concatenate(chosen), np.concatenate(levels)
        for first in range(0, len(draws), BLOCK):
            now = slice(first, first + BLOCK)
            margins = law.margins(draws[now])
            for seen in self.flights.histories(draws[now]):
                counts[seen.name].take_flights(seen, margins.get(seen.name), level[now])
            if progress:
                progress(len(draws), min(first + BLOCK, len(draws)))
        return counts


NEVER = np.zeros(1)
"""Nodes of a constraint without a limit within reach."""


@dataclass(frozen=True, eq=False)
class CountsInTime:
    """Counts of a joint constraint at its times, stored as changes in time.

    Attributes:
        nodes_s: times of the nodes of its law's span, shape (nodes,).
        times_s: at which the constraint counts, shape (n_times,).
        total: draws of each level, and of them flights, shape (2, 3).
        failing: changes of those of them that fail by the law, shape (2, n_times + 1, 3).
        unlike: flights unlike the law, by stratum, shape (n_times, 6).
    """

    nodes_s: Array
    times_s: Array
    total: Counts
    failing: Counts
    unlike: Counts

    @classmethod
    def none(cls, nodes_s: Array, times_s: Array) -> CountsInTime:
        """Before any draw."""
        count = len(times_s)
        shapes = (2, LEVELS), (2, count + 1, LEVELS), (count, COUNT)
        return cls(nodes_s, times_s, *(np.zeros(shape, dtype=np.int64) for shape in shapes))

    def __add__(self, other: CountsInTime) -> CountsInTime:
        """Add the counts of more draws."""
        names = ("total", "failing", "unlike")
        parts = (getattr(self, name) + getattr(other, name) for name in names)
        return CountsInTime(self.nodes_s, self.times_s, *parts)

    def take_draws(self, margin: Array | None, level: Indices, flown: Booleans) -> None:
        """Count draws with margins at the nodes, shape (nodes, m), and those of them that are flown."""
        for row, those in enumerate((np.arange(len(level)), np.flatnonzero(flown))):
            own = level[those]
            self.total[row] += np.bincount(own, minlength=LEVELS)
            if margin is not None:
                at, draw, sign = self._changes(margin[:, those])
                np.add.at(self.failing[row], (at, own[draw]), sign)

    def take_flights(self, seen: LimitHistory, margin: Array | None, level: Indices) -> None:
        """Count flights that end unlike the law."""
        if margin is None:
            margin = np.full((1, len(level)), FAR)
        some = np.flatnonzero((margin < 0.0).any(axis=0) | ~seen.kept)
        if not len(some):
            return
        at, draw, sign = self._changes(margin[:, some])
        changes = np.zeros((len(self.times_s) + 1, len(some)), dtype=np.int8)
        np.add.at(changes, (at, draw), sign)
        by_law, fails = np.cumsum(changes, axis=0)[:-1] > 0, seen.fails(some)
        stratum = _strata(True, level[some]), _strata(False, level[some])
        for number in range(COUNT):
            mine = stratum[0 if FAILS[number] else 1] == number
            other = by_law & ~fails if FAILS[number] else fails & ~by_law
            self.unlike[:, number] += other[:, mine].sum(axis=1)

    def by_stratum(self) -> tuple[Counts, Counts, Counts]:
        """Draws, flights, and flights unlike the law at each time, shape (n_times, 6) each."""
        failing = np.cumsum(self.failing, axis=1)[:, :-1]
        both = np.concatenate([failing[..., ::-1], self.total[:, None] - failing], axis=2)
        return both[0], both[1], self.unlike

    def _changes(self, margin: Array) -> tuple[Indices, Indices, Indices]:
        """Where the law's verdicts change: first times of the new ones, draws, and 1 where it fails."""
        fails = margin < 0.0
        begun = np.flatnonzero(fails[0])
        arc, draw = np.nonzero(fails[1:] != fails[:-1])
        before, after = margin[arc, draw], margin[arc + 1, draw]
        step = self.nodes_s[arc + 1] - self.nodes_s[arc]
        time = self.nodes_s[arc] + step * before / (before - after)
        at = np.concatenate([np.zeros(len(begun), np.intp), np.searchsorted(self.times_s, time)])
        sign = np.concatenate([np.ones(len(begun), np.intp), np.where(fails[arc + 1, draw], 1, -1)])
        return at, np.concatenate([begun, draw]), sign
