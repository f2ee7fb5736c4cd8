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
from dataclasses import dataclass, field, replace
from functools import reduce
from operator import add

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array, Booleans, Indices
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.regions import with_parameters
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
from formulations.rows.exact_flight import FLIGHT
from formulations.rows.flight_probability import Limits, limits_within
from formulations.rows.node_probability import joint_events
from scp_recon.jobs.cores import cores, each
from scp_recon.jobs.job import generator
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.sampling import BLOCK, draw
from scp_recon.monte_carlo.whole_flight import KeptCounts, SampledFlights, less_likely

REACH = 5.0
"""Standard deviations from a limit beyond which the law leaves it out: a draw in three million."""

FAR = 1e6
"""Margin where no limit is within reach, m."""


@dataclass(frozen=True)
class Law:
    """Normal law of a flight's positions at the nodes, and the limits of each event.

    Attributes:
        mean: positions, shape (n, 3).
        factor: of the covariance of positions and of p uncertain parameters, a column for each number
            that a flight draws, shape (n, 3 + p, sources).
        limits: that flights may break, by event.
        length_m: of the unit of length.
        times_s: of the nodes, shape (n,).
        is_whole: whether a flight has one margin, the least of all nodes.
        contends: nodes of an event's span that have a part in sorting, shape (nodes,).
    """

    mean: Array
    factor: Array
    limits: Mapping[str, Limits]
    length_m: float
    times_s: Array
    is_whole: bool = False
    contends: Mapping[str, Booleans] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        mission: Mission,
        lin: Linearisation,
        together: Mapping[str, Sequence[str]] | None = None,
        *,
        is_whole: bool = False,
    ) -> Law:
        """The law at an iterate, with a column for each number that its flights draw.

        Errors of executing a correction are products of two numbers, and have no column.

        Events are the joint constraints with a limit within reach, and of those in `together` some at
        once, by name; or, `is_whole`, all of them at once.
        """
        mean, factor = lin.iterate.mean[:, :3], with_parameters(drawn_factor(lin))
        alone, limits = joint_events(lin.problem.constraints), {}
        names = {event.name: (event.name,) for event in alone} | dict(together or {})
        for name, those in {FLIGHT: [*names]}.items() if is_whole else names.items():
            own = tuple(event for event in alone if event.name in those)
            found = limits_within(own, mean, REACH * factor)
            if is_whole or found.inner or found.outer:
                limits[name] = found
        return cls(mean, factor, limits, mission.units.length_m, mission.times_s, is_whole)

    @property
    def sources(self) -> int:
        """Number of standard normal numbers that a flight draws."""
        return self.factor.shape[2]

    def span(self, name: str) -> slice:
        """Nodes within `REACH` sigma of a limit of an event, and their neighbours; all without one."""
        if name not in self.limits or not len(nodes := self.limits[name].nodes):
            return slice(0, len(self.mean))
        return slice(max(0, int(nodes.min()) - 1), min(int(nodes.max()) + 2, len(self.mean)))

    def margins(self, draws: Array, positions: Array | None = None) -> dict[str, Array]:
        """Distances to the nearest limit of each event at the nodes of its span, m, (nodes, m).

        Negative where the limit is broken, and at most `FAR`; of draws (m, sources), by the law or with
        positions at all nodes, m, shape (n, m, 3).
        """
        parameters, found = draws @ self.factor[0, 3:].T, {}
        for name, (inner, outer) in self.limits.items():
            span = self.span(name)
            least = np.full((span.stop - span.start, len(draws)), FAR)
            for sign, limit in [*((1.0, one) for one in inner), *((-1.0, one) for one in outer)]:
                if positions is None:
                    point = self._positions(limit.nodes, draws)
                else:
                    point = positions[limit.nodes] / self.length_m
                if limit.motion is not None:
                    point = limit.motion.of_draws(point, parameters)
                rows, margin = limit.nodes - span.start, self.length_m * limit.region.inside(point)
                least[rows] = np.minimum(least[rows], sign * margin)
            found[name] = least.min(axis=0, keepdims=True) if self.is_whole else least
        return found

    def _positions(self, nodes: Indices, draws: Array) -> Array:
        factor = self.factor[nodes, :3].swapaxes(0, 1)  # components first: one matrix product
        moved = factor.reshape(-1, self.sources) @ draws.T
        at = self.mean[nodes].T[:, :, None] + moved.reshape(3, len(nodes), -1)
        return np.moveaxis(at, 0, -1)

    def nearest(self, margins: Mapping[str, Array]) -> Array:
        """How near draws come to a limit that contends, m, shape (m,); zero if they cross it."""
        near = []
        for name, margin in margins.items():
            contends = self.contends[name]
            either = contends[1:] | contends[:-1]
            crosses = ((margin[1:] < 0.0) != (margin[:-1] < 0.0))[either].any(axis=0)
            near.append(np.where(crosses, 0.0, np.abs(margin[contends]).min(axis=0, initial=FAR)))
        return np.asarray(np.minimum.reduce(near))


def drawn_factor(lin: Linearisation) -> Array:
    """Columns of the factor for the flights' random numbers, in order, (n_nodes, 6 + p, sources)."""
    problem, factor = lin.problem, lin.spread.factor
    if problem.feedback is None:
        return factor
    drawn = [factor[..., : problem.shared_columns.stop]]
    drawn += [factor[..., problem.columns_of_burn(burn)] for burn in range(problem.n_burns)]
    for j, measurement in enumerate(problem.feedback.measurement):
        # Flights draw with the triangular root of the measurement's covariance.
        turned = np.linalg.solve(np.linalg.cholesky(measurement @ measurement.T), measurement)
        drawn.append(factor[..., problem.columns_of_correction(j)[1]] @ turned.T)
    return np.concatenate(drawn, axis=2)


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
"""Classes of how near a draw comes: next to a limit, near, and surely not."""


def surveyed(law: Law, flights: SampledFlights) -> tuple[Law, Survey]:
    """Learn from a few draws which nodes may be the worst, and the law's least reliability there."""
    blocks = range(SURVEY_DRAWS // BLOCK)
    draws = np.concatenate([draw(flights.seed, block, law.sources, SURVEY) for block in blocks])
    margins = law.margins(draws)
    failed = {name: np.mean(margin < 0.0, axis=1) for name, margin in margins.items()}
    most = max(share.max() for share in failed.values())
    law = replace(law, contends={name: each >= CONTENDS * most for name, each in failed.items()})
    nearest = law.nearest(margins)
    chosen = np.argsort(nearest, kind="stable")[:SURVEY_FLIGHTS]
    flown = law.margins(draws[chosen], flights.positions(draws[chosen]))
    contending = [(n, node) for n, those in law.contends.items() for node in np.flatnonzero(those)]
    off = {(n, node): flown[n][node] - margins[n][node, chosen] for n, node in contending}
    near = BEYOND * max(float(np.abs(one).max()) for one in off.values())
    level = levels_of(nearest, near)
    worst = max(failed, key=lambda name: float(failed[name].max()))
    stratum = _strata(margins[worst][np.argmax(failed[worst])] < 0.0, level)
    share = np.bincount(stratum, minlength=COUNT) / len(level)
    unlike = [_ending_unlike(margins[n][node], off[n, node], level) for n, node in contending]
    return law, Survey(near, share, np.max(unlike, axis=0))


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
        law: of the draws, surveyed.
        flights: fly them.
        allocation: of the draws; its shares are mirrored if there is more than one event.
    """

    law: Law
    flights: SampledFlights
    allocation: Allocation

    def blocks(self, first: int = 0) -> list[tuple[int, int]]:
        """Blocks from the first one, with their draws; the total number follows a Poisson law."""
        number = int(generator(self.flights.seed, first, NUMBER).poisson(self.allocation.draws))
        sizes = [min(BLOCK, number - begun) for begun in range(0, number, BLOCK)]
        return list(enumerate(sizes, start=first))

    def count(
        self,
        blocks: Sequence[tuple[int, int]],
        progress: Callable[[float], None] | None = None,
    ) -> StrataCounts:
        """Count the flights of blocks, each with its number of draws."""
        law, share, times = self.law, np.array(self.allocation.share), self.flights.counted_s
        total = np.zeros((2, LEVELS), np.int64)
        failing = {name: np.zeros((2, len(at) + 1, LEVELS), np.int64) for name, at in times.items()}
        unlike = {name: np.zeros((len(at), COUNT), np.int64) for name, at in times.items()}
        chosen, levels = [np.zeros((0, law.sources))], [np.zeros(0, dtype=np.intp)]
        for block, size in blocks:
            some = draw(self.flights.seed, block, law.sources)[:size]
            coins = generator(self.flights.seed, block, COINS).random(BLOCK)[:size]
            margins = law.margins(some)
            level = levels_of(law.nearest(margins), self.allocation.near)
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
            margins, seen = law.margins(draws[now]), self.flights.judged(draws[now])
            for name, (_, holds) in seen.kept.items():
                margin = margins.get(name, np.full((1, holds.shape[1]), FAR))
                unlike[name] += self._unlike(name, ~holds, margin, level[now])
            touched.append(seen.touched_s)
            if progress:
                progress(min(first + BLOCK, len(draws)) / len(draws))
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
        begun, nodes_s = np.flatnonzero(fails[0]), self.law.times_s[self.law.span(name)]
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

    Either limit of that event may be missed with the probability `tail`. `progress` is called at times
    with the share of the work that is done.
    """
    blocks, times = draws.blocks(), draws.flights.counted_s
    shares = max(1, min(cores(), len(blocks)))

    def counted(share: int) -> StrataCounts:
        return draws.count(blocks[share::shares], None if share else progress)

    total = reduce(add, each(counted, range(shares)))
    counts = np.concatenate([total.of(name) for name in times], axis=1)
    times_s = np.concatenate([*times.values()])
    at_nodes = np.isin(times_s, draws.law.times_s)
    failed = failed_at(draws.allocation, counts[0], counts[2])
    touched = less_likely(times_s, failed - failed[at_nodes].max())
    _, worst = worst_event(draws.allocation, counts, tail)
    _, nodes = worst_event(draws.allocation, counts[:, at_nodes], tail)
    worth, reached = worst.equivalent, 1.0 - worst.failed
    kept = max(1.0 - nodes.failed, reached) * worth, reached * worth
    return KeptCounts(*kept, worth, np.append(total.touched_s, touched), worst)
