"""Fly few of many draws of the errors: mainly those whose outcome the normal law leaves uncertain.

The law approximates a flight's positions at the nodes by mean + factor w, with the random numbers w
of the flight. It gives every draw's margin to the nearest limit, a hundred times as fast as a
flight. `risk.strata` has the statistics.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from formulations.arrays import Array, Booleans, Indices
from formulations.linearisation.linearisation import Linearisation
from formulations.problem.motion import with_parameters
from formulations.risk.strata import COUNT, FAILS, Allocation, Counted, Survey, strata_of
from formulations.rows.flight_probability import Limit, Limits, limits_within
from formulations.rows.node_probability import joint_events
from scp_recon.jobs.cores import each
from scp_recon.jobs.job import generator
from scp_recon.monte_carlo.sampling import BLOCK, draw
from scp_recon.monte_carlo.whole_flight import SampledFlights

REACH = 5.0
"""Standard deviations from a limit beyond which the law leaves it out: a draw in three million."""

FAR = 1e6
"""Margin where no limit is within reach, m."""

SURVEY_DRAWS, SURVEY_FLIGHTS = 10_000, 200
"""Draws of a survey, which allocates the others, and the number of them flown: the nearest to a
limit."""

BEYOND = 1.5
"""Times the largest difference of margins in a survey from which on a verdict is sure. Of 10,000
flights of a plan for 0.90, and of one for 0.99, none beyond it ended unlike the law."""

COINS, NUMBER, SURVEY = 1, 2, 3
"""Streams of random numbers besides the draws' own."""


@dataclass(frozen=True)
class Law:
    """Normal law of a flight's positions at the nodes, and the limits on them.

    Attributes:
        mean: positions, shape (n, 3).
        factor: of the covariance of positions and of p uncertain parameters, a column for each number
            that a flight draws, shape (n, 3 + p, sources).
        limits: that flights may break.
        length_m: of the unit of length.
    """

    mean: Array
    factor: Array
    limits: Limits
    length_m: float

    @classmethod
    def of(cls, lin: Linearisation, length_m: float) -> Law:
        """The law at an iterate, with a column for each number that its flights draw.

        Errors of executing a correction are products of two numbers, and have no column.
        """
        mean, factor = lin.iterate.mean[:, :3], with_parameters(drawn_factor(lin))
        events = joint_events(lin.problem.constraints)
        return cls(mean, factor, limits_within(events, mean, REACH * factor), length_m)

    @classmethod
    def of_events(
        cls,
        lin: Linearisation,
        length_m: float,
        together: Mapping[str, Sequence[str]] | None = None,
    ) -> dict[str, Law]:
        """Laws with the limits of each joint constraint alone, where some are within reach.

        Args:
            lin: an iterate.
            length_m: of the unit of length.
            together: further names, of some constraints together.
        """
        whole = cls.of(lin, length_m)
        events = joint_events(lin.problem.constraints)
        names = {e.name: (e.name,) for e in events} | dict(together or {})
        laws = {}
        for name, those in names.items():
            own = tuple(event for event in events if event.name in those)
            limits = limits_within(own, whole.mean, REACH * whole.factor)
            if limits.inner or limits.outer:
                laws[name] = replace(whole, limits=limits)
        return laws

    @cached_property
    def span(self) -> slice:
        """Nodes within `REACH` sigma of a limit, and their neighbours."""
        nodes = np.concatenate([limit.nodes for _, limit in self._signed_limits])
        return slice(max(0, int(nodes.min()) - 1), int(nodes.max()) + 2)

    @property
    def sources(self) -> int:
        """Number of standard normal numbers that a flight draws."""
        return self.factor.shape[2]

    def margin(self, draws: Array) -> Array:
        """Distance to the nearest limit, m, negative where one is broken; of draws (m, sources).

        Infinite where no limit is within reach.
        """
        if not self._signed_limits:
            return np.full(len(draws), np.inf)
        return np.asarray(self.margins(draws).min(axis=0))

    def margins(self, draws: Array) -> Array:
        """Distance to the nearest limit at each node of the span, m, (nodes, m), at most `FAR`."""

        def positions(nodes: Indices) -> Array:
            factor = self.factor[nodes, :3].swapaxes(0, 1)  # components first: one matrix product
            moved = factor.reshape(-1, self.sources) @ draws.T
            at = self.mean[nodes].T[:, :, None] + moved.reshape(3, len(nodes), -1)
            return np.moveaxis(at, 0, -1)

        return self._least(positions, draws)

    def margins_at(self, positions: Array, draws: Array) -> Array:
        """As `margins`, for draws with positions at all nodes, m, shape (n, flights, 3)."""
        return self._least(lambda nodes: positions[nodes] / self.length_m, draws)

    @property
    def _signed_limits(self) -> list[tuple[float, Limit]]:
        """Limits with the sign of the margin inside their region."""
        inner, outer = self.limits
        return [*((1.0, limit) for limit in inner), *((-1.0, limit) for limit in outer)]

    def _least(self, positions: Callable[[Indices], Array], draws: Array) -> Array:
        least = np.full((len(self.mean[self.span]), len(draws)), FAR)
        parameters = draws @ self.factor[0, 3:].T
        for sign, limit in self._signed_limits:
            rows, point = limit.nodes - self.span.start, positions(limit.nodes)
            if limit.motion is not None:
                point = limit.motion.of_draws(point, parameters)
            margin = sign * self.length_m * limit.region.inside(point)
            least[rows] = np.minimum(least[rows], margin)
        return least


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


class CountedFlights(NamedTuple):
    """Result of flights in strata.

    Attributes:
        throughout: of verdicts at all times.
        at_nodes: of verdicts at the nodes alone.
        touched_s: as `KeptCounts.touched_s`.
    """

    throughout: Counted
    at_nodes: Counted
    touched_s: Array


def survey(law: Law, flights: SampledFlights, seed: int) -> Survey:
    """Learn from a few draws how reliable the law's verdicts are."""
    draws = survey_draws(law, seed)
    margin = law.margin(draws)
    nearest = np.argsort(np.abs(margin), kind="stable")[:SURVEY_FLIGHTS]
    if np.isinf(margin).all():
        return Survey(0.0, np.eye(COUNT)[-1], np.zeros(COUNT))
    flown = law.margins_at(flights.positions(draws[nearest]), draws[nearest])
    off = flown.min(axis=0) - margin[nearest]
    near = BEYOND * float(np.abs(off).max())
    stratum = strata_of(margin, near)
    share = np.bincount(stratum, minlength=COUNT) / len(margin)
    return Survey(near, share, ending_unlike(stratum, margin, off))


def ending_unlike(stratum: Indices, margin: Array, off: Array) -> Array:
    """Share of each stratum's draws that end unlike the law if margins are so far off, shape (6,)."""
    unlike = np.zeros(COUNT)
    for number in range(1, COUNT - 1):
        mine = margin[stratum == number]
        if len(mine):
            unlike[number] = np.mean((mine[:, None] + off < 0.0) != FAILS[number])
    return unlike


def fly_strata(
    law: Law,
    flights: SampledFlights,
    allocation: Allocation,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> CountedFlights:
    """Draw, sort draws by the law, and fly the allotted share of each stratum.

    `progress` is called at times with the total number and the number flown so far.
    """
    share = np.array(allocation.share)

    def drawn_of(one: tuple[int, int]) -> tuple[Indices, Array, Indices]:
        some, coins = tossed(seed, law.sources, *one)
        own = allocation.strata(law.margin(some))
        flown = coins < share[own]
        return np.bincount(own, minlength=COUNT), some[flown], own[flown]

    none = np.zeros(COUNT, np.intp), np.zeros((0, law.sources)), np.zeros(0, np.intp)
    counts, draws, strata = zip(none, *each(drawn_of, blocks_of(allocation, seed)), strict=True)
    drawn, chosen, stratum = np.sum(counts, axis=0), np.concatenate(draws), np.concatenate(strata)

    blocks = [chosen[first : first + BLOCK] for first in range(0, len(chosen), BLOCK)]

    def report(done: int) -> None:
        if progress:
            progress(len(chosen), min(done * BLOCK, len(chosen)))

    seen = each(flights.count, blocks, report)

    def counted(kept: list[Booleans]) -> Counted:
        unlike = np.concatenate([np.zeros(0, dtype=bool), *kept]) == FAILS[stratum]
        flown = np.bincount(stratum, minlength=COUNT), np.bincount(stratum[unlike], minlength=COUNT)
        return Counted(allocation, *(tuple(counts.tolist()) for counts in (drawn, *flown)))

    return CountedFlights(
        counted([one.kept for one in seen]),
        counted([one.kept_at_nodes for one in seen]),
        np.concatenate([np.zeros(0), *(one.touched_s for one in seen)]),
    )


def survey_draws(law: Law, seed: int) -> Array:
    """The draws of a survey, shape (SURVEY_DRAWS, sources)."""
    blocks = range(SURVEY_DRAWS // BLOCK)
    return np.concatenate([draw(seed, block, law.sources, SURVEY) for block in blocks])


def blocks_of(allocation: Allocation, seed: int, first: int = 0) -> list[tuple[int, int]]:
    """Blocks from the first one, with their draws; the total number follows a Poisson law."""
    number = int(generator(seed, first, NUMBER).poisson(allocation.draws))
    begun = range(0, number, BLOCK)
    return [(first + k, min(BLOCK, number - draws)) for k, draws in enumerate(begun)]


def tossed(seed: int, sources: int, block: int, size: int) -> tuple[Array, Array]:
    """The draws of a block, shape (size, sources), with a number from 0 to 1 each, shape (size,).

    A draw is flown if its number is below its share.
    """
    coins = generator(seed, block, COINS).random(BLOCK)
    return draw(seed, block, sources)[:size], coins[:size]
