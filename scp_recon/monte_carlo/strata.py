"""Fly few of many draws: mainly those whose outcome the normal law leaves uncertain.

The statistics are those of `formulations.risk.strata`. All events are estimated from the same flights.
An event is a joint constraint at a second, or that a whole flight keeps all limits. The law
predicts whether a draw keeps a constraint at the nodes and, by linear interpolation of the margin,
between them. Draws are sorted by their distance to a limit at the nodes where the limit is broken
most often, whatever the verdict. Where there are several events, strata of one margin therefore
have one share, and the counts of an event are those of its own verdicts. The limits of each event
are exact. If the largest upper limit of all events is below the allowed risk, so is the risk of the
event that fails most often, whichever event that is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
import numpy.typing as npt

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
from scp_recon.jobs.cores import each
from scp_recon.jobs.job import generator
from scp_recon.monte_carlo.law import FAR, Law
from scp_recon.monte_carlo.sampling import BLOCK, draw
from scp_recon.monte_carlo.whole_flight import KeptCounts, SampledFlights, less_likely

Counts = npt.NDArray[np.int64]

SURVEY_DRAWS, SURVEY_FLIGHTS = 10_000, 200
"""Draws of a survey, which allocates the others, and the number of them flown: the nearest to a
limit."""

BEYOND = 1.5
"""Times the largest difference of margins in a survey from which on a verdict is sure. Of 10,000
flights of a plan for 0.90, and of one for 0.99, none beyond it ended unlike the law."""

COINS, NUMBER, SURVEY = 1, 2, 3
"""Streams of random numbers besides the draws' own."""

CONTENDS = 0.3
"""Share of the largest probability of failing, from which on a node has a part in sorting."""

LEVELS = COUNT // 2
"""Of how near a draw comes: next to a limit, near, and surely not."""

BLOCKS = 20
"""Of draws in a job."""


@dataclass(frozen=True)
class Laws:
    """Normal laws of events at the nodes, and where these contend for the largest failure.

    Attributes:
        laws: with the limits of each joint constraint; of those that may be broken.
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

    def times_s(self, name: str) -> Array:
        """Times of the nodes of a law's span, s; of all nodes if no limit is within reach."""
        return self.nodes_s[self.laws[name].span] if name in self.laws else self.nodes_s

    def nearest(self, margins: Mapping[str, Array]) -> Array:
        """How near draws come to a limit that contends, m, shape (m,); zero if they cross it."""
        near = []
        for name, margin in margins.items():
            contends = self.contends[name]
            either = contends[1:] | contends[:-1]
            crosses = ((margin[1:] < 0.0) != (margin[:-1] < 0.0))[either].any(axis=0)
            near.append(np.where(crosses, 0.0, np.abs(margin[contends]).min(axis=0, initial=FAR)))
        return np.asarray(np.minimum.reduce(near))


def surveyed(laws: Mapping[str, Law], flights: SampledFlights, seed: int) -> tuple[Laws, Survey]:
    """Learn from a few draws which nodes may be the worst, and the law's least reliability there."""
    sources, blocks = next(iter(laws.values())).sources, range(SURVEY_DRAWS // BLOCK)
    draws = np.concatenate([draw(seed, block, sources, SURVEY) for block in blocks])
    margins = {name: law.margins(draws) for name, law in laws.items()}
    failed = {name: np.mean(margin < 0.0, axis=1) for name, margin in margins.items()}
    most = max(share.max() for share in failed.values())
    contends = {name: share >= CONTENDS * most for name, share in failed.items()}
    known = Laws(laws, flights.mission.times_s, contends)
    nearest = known.nearest(margins)
    chosen = np.argsort(nearest, kind="stable")[:SURVEY_FLIGHTS]
    flown = flights.positions(draws[chosen]), draws[chosen]
    off = {name: law.margins_at(*flown) - margins[name][:, chosen] for name, law in laws.items()}
    near = BEYOND * max(np.abs(off[name][contends[name]]).max(initial=0.0) for name in laws)
    level = levels_of(nearest, near)
    worst = max(failed, key=lambda name: float(failed[name].max()))
    stratum = _strata(margins[worst][np.argmax(failed[worst])] < 0.0, level)
    share = np.bincount(stratum, minlength=COUNT) / len(level)
    unlike = [
        _ending_unlike(margins[name][node], off[name][node], level)
        for name in laws
        for node in np.flatnonzero(contends[name])
    ]
    return known, Survey(near, share, np.max(unlike, axis=0))


def _ending_unlike(margin: Array, off: Array, level: Indices) -> Array:
    """Share of each stratum's draws that end unlike the law if margins are so far off, shape (6,)."""
    stratum, unlike = _strata(margin < 0.0, level), np.zeros(COUNT)
    for number in range(1, COUNT - 1):
        mine = margin[stratum == number]
        if len(mine):
            unlike[number] = np.mean((mine[:, None] + off < 0.0) != FAILS[number])
    return unlike


def levels_of(nearest: Array, near: float) -> Indices:
    """Level of draws that come so near to a limit, by the margin up to which a verdict is not sure."""
    return np.searchsorted(near * EDGES[LEVELS:], nearest, side="right")


def _strata(fails: Booleans | bool, level: Indices) -> Indices:
    """Stratum of a verdict and a level."""
    return np.where(fails, LEVELS - 1 - level, LEVELS + level)


@dataclass(frozen=True, eq=False)
class StrataCounts:
    """Counts of draws and flights, which add up.

    Attributes:
        total: draws of each level, and of them flights, shape (2, 3).
        failing: by constraint those of them that fail by the law, as changes from one time at which it
            counts to the next, shape (2, n_times + 1, 3).
        unlike: by constraint flights unlike the law, by time and stratum, shape (n_times, 6).
        touched_s: see `Judged`.
    """

    total: Counts
    failing: dict[str, Counts]
    unlike: dict[str, Counts]
    touched_s: Array

    def __add__(self, other: StrataCounts) -> StrataCounts:
        """Add the counts of more draws."""
        return StrataCounts(
            self.total + other.total,
            {name: own + other.failing[name] for name, own in self.failing.items()},
            {name: own + other.unlike[name] for name, own in self.unlike.items()},
            np.concatenate([self.touched_s, other.touched_s]),
        )

    @property
    def flown(self) -> int:
        """Number of flights."""
        return int(self.total[1].sum())

    def of(self, name: str) -> Counts:
        """Draws, flights, and flights unlike the law of a constraint, shape (3, n_times, 6)."""
        failing = np.cumsum(self.failing[name], axis=1)[:, :-1]
        both = np.concatenate([failing[..., ::-1], self.total[:, None] - failing], axis=2)
        return np.concatenate([both, self.unlike[name][None]])


@dataclass(frozen=True)
class DrawsInStrata:
    """Work of a process: draw, sort draws, fly the allotted share of each stratum, and count.

    Attributes:
        laws: of the draws.
        flights: fly them.
        allocation: of the draws; its shares are mirrored if there is more than one event.
        seed: of the draws.
    """

    laws: Laws
    flights: SampledFlights
    allocation: Allocation
    seed: int

    def jobs(self, first: int = 0) -> list[list[tuple[int, int]]]:
        """Blocks from the first one, with their draws; the total number follows a Poisson law."""
        number = int(generator(self.seed, first, NUMBER).poisson(self.allocation.draws))
        sizes = [min(BLOCK, number - begun) for begun in range(0, number, BLOCK)]
        blocks = list(enumerate(sizes, start=first))
        return [blocks[k : k + BLOCKS] for k in range(0, len(blocks), BLOCKS)]

    def count(self, blocks: Sequence[tuple[int, int]]) -> StrataCounts:
        """Count the flights of blocks, each with its number of draws."""
        laws, share, times = self.laws, np.array(self.allocation.share), self.flights.counted_s
        total = np.zeros((2, LEVELS), np.int64)
        failing = {name: np.zeros((2, len(at) + 1, LEVELS), np.int64) for name, at in times.items()}
        unlike = {name: np.zeros((len(at), COUNT), np.int64) for name, at in times.items()}
        chosen, levels = [np.zeros((0, laws.sources))], [np.zeros(0, dtype=np.intp)]
        for block, size in blocks:
            some = draw(self.seed, block, laws.sources)[:size]
            coins = generator(self.seed, block, COINS).random(BLOCK)[:size]
            margins = laws.margins(some)
            level = levels_of(laws.nearest(margins), self.allocation.near)
            least = np.minimum.reduce([margin.min(axis=0) for margin in margins.values()])
            flown = coins < share[_strata(least < 0.0, level)]
            for row, those in enumerate((np.ones_like(flown), flown)):
                own = level[those]
                total[row] += np.bincount(own, minlength=LEVELS)
                for name, margin in margins.items():
                    at, which, sign = self._changes(name, margin[:, those])
                    np.add.at(failing[name][row], (at, own[which]), sign)
            chosen.append(some[flown])
            levels.append(level[flown])
        draws, level, touched = np.concatenate(chosen), np.concatenate(levels), [np.zeros(0)]
        for first in range(0, len(draws), BLOCK):
            now = slice(first, first + BLOCK)
            margins, seen = laws.margins(draws[now]), self.flights.judged(draws[now])
            for name, (_, holds) in seen.kept.items():
                margin = margins.get(name, np.full((1, holds.shape[1]), FAR))
                unlike[name] += self._unlike(name, ~holds, margin, level[now])
            touched.append(seen.touched_s)
        return StrataCounts(total, failing, unlike, np.concatenate(touched))

    def _unlike(self, name: str, fails: Booleans, margin: Array, level: Indices) -> Counts:
        """Flights (n_times, m) that end unlike the law, by time and stratum, shape (n_times, 6)."""
        some = np.flatnonzero((margin < 0.0).any(axis=0) | fails.any(axis=0))
        fails, changes = fails[:, some], np.zeros((len(fails) + 1, len(some)), dtype=np.int8)
        at, which, sign = self._changes(name, margin[:, some])
        np.add.at(changes, (at, which), sign)
        by_law, unlike = np.cumsum(changes, axis=0)[:-1] > 0, np.zeros((len(fails), COUNT), int)
        for number in range(COUNT):
            mine = _strata(FAILS[number], level[some]) == number
            other = (by_law & ~fails) if FAILS[number] else (fails & ~by_law)
            unlike[:, number] = other[:, mine].sum(axis=1)
        return unlike

    def _changes(self, name: str, margin: Array) -> tuple[Indices, Indices, Indices]:
        """Where verdicts of margins (nodes, m) change: first times of new ones, draws, 1 if failing."""
        fails, (arc, which) = margin < 0.0, np.nonzero((margin[1:] < 0.0) != (margin[:-1] < 0.0))
        begun, nodes_s = np.flatnonzero(fails[0]), self.laws.times_s(name)
        before, after = margin[arc, which], margin[arc + 1, which]
        time = nodes_s[arc] + (nodes_s[arc + 1] - nodes_s[arc]) * before / (before - after)
        at = np.searchsorted(self.flights.counted_s[name], time)
        sign = np.where(fails[arc + 1, which], 1, -1)
        return np.r_[0 * begun, at], np.r_[begun, which], np.r_[0 * begun + 1, sign]


def worst_event(allocation: Allocation, counts: Counts, tail: float) -> tuple[int, Counted]:
    """The event that may fail most often, of counts (3, events, 6): its number, and its counts."""
    event = int(np.argmax(most_at(allocation, counts[0], counts[2], tail)))
    return event, Counted(allocation, *(tuple(part[event].tolist()) for part in counts))


def fly_strata(
    draws: DrawsInStrata, tail: float, progress: Callable[[float], None] | None = None
) -> KeptCounts:
    """Fly strata, and count what the event keeps that may fail most often.

    Args:
        draws: that are flown.
        tail: probability with which either limit of that event may be missed.
        progress: called at times with the share of the work that is done.
    """
    jobs, times = draws.jobs(), draws.flights.counted_s

    def report(done: int) -> None:
        if progress:
            progress(done / len(jobs))

    total = reduce(add, each(draws.count, jobs, report))
    counts = np.concatenate([total.of(name) for name in times], axis=1)
    times_s = np.concatenate([*times.values()])
    at_nodes = np.isin(times_s, draws.laws.nodes_s)
    failed = failed_at(draws.allocation, counts[0], counts[2])
    touched = less_likely(times_s, failed - failed[at_nodes].max())
    _, worst = worst_event(draws.allocation, counts, tail)
    _, nodes = worst_event(draws.allocation, counts[:, at_nodes], tail)
    worth, reached = worst.equivalent, 1.0 - worst.failed
    kept = max(1.0 - nodes.failed, reached) * worth, reached * worth
    return KeptCounts(*kept, worth, np.append(total.touched_s, touched), worst)
