"""Flights chosen by the law's margin reach what all flights reach, however wrong the law is.

Of all limits together, and then of each limit at each second by itself.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from formulations.arrays import Array
from formulations.problem.regions import Ball
from formulations.risk.strata import Allocation, allocate
from formulations.rows.flight_probability import Limit, Limits
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import of_strata, proportion
from scp_recon.monte_carlo.law import CountedFlights, Law, fly_strata, survey
from scp_recon.monte_carlo.law_in_time import LawInTime, fly_in_time, survey_in_time
from scp_recon.monte_carlo.sampling import Flyer, draw
from scp_recon.monte_carlo.whole_flight import (
    PARTS,
    BlockLimits,
    LimitHistory,
    SampledFlights,
    sample_times,
    seconds_of,
)
from scp_recon.planning.initial_guess import from_burns

SOURCES, NODES, SEED = 5, 4, 11
rng = np.random.default_rng(1)
MEAN = np.array([[3.0, 0.0, 0.0]]) * np.arange(1, NODES + 1)[:, None]
FACTOR = 0.3 * rng.normal(size=(NODES, 3, SOURCES))
BALLS = Limit(Ball(MEAN, 1.6), np.arange(NODES))
LAW = Law(MEAN, FACTOR, Limits((BALLS,), ()), 10.0)
"""Of five sources, whatever they are: positions at four nodes are to be within 16 m of their mean."""


@dataclass(frozen=True)
class Toy:
    """Flights that follow the law, bent by so many metres times the square of the first number."""

    bend_m: float

    def positions(self, draws: Array) -> Array:
        moved = MEAN[:, None] + np.einsum("nic,fc->nfi", FACTOR, draws)
        moved[..., 0] += self.bend_m / LAW.length_m * draws[:, 0] ** 2
        return moved * LAW.length_m

    def count(self, draws: Array) -> BlockLimits:
        off = self.positions(draws) / LAW.length_m - MEAN[:, None]
        kept = np.all(np.linalg.norm(off, axis=2) <= 1.6, axis=0)
        return BlockLimits({}, kept, kept, np.zeros(0))


def plain(toy: Toy, blocks: int) -> float:
    """Share that keeps the limits of a thousand flights a block."""
    return float(np.mean([toy.count(draw(7, block, SOURCES)).kept for block in range(blocks)]))


def allocated(toy: Toy, flights: int = 20_000) -> Allocation:
    known = survey(LAW, toy, SEED)
    p = proportion(round((1.0 - known.failed) * flights), flights, 0.975)
    found = allocate(known, flights, (p.value - p.low, p.high - p.value), 0.0125)
    assert found is not None
    return found


@pytest.mark.slow
@pytest.mark.parametrize("bend_m", [0.0, 0.1, -0.2])
def test_few_flights_reach_what_all_reach(bend_m):
    toy = Toy(bend_m)
    found = fly_strata(LAW, toy, allocated(toy), SEED)
    reached = of_strata(found.throughout, 0.975)
    assert sum(found.throughout.flown) < 3_000
    assert found.throughout == found.at_nodes
    assert reached.low <= plain(toy, 100) <= reached.high
    as_plain = proportion(round(20_000 * reached.value), 20_000, 0.975)
    assert reached.high - reached.low < 1.03 * (as_plain.high - as_plain.low)


def test_law_wrong_where_sure_widens_the_interval():
    """Allocated for flights that follow the law, which others do not."""
    toy = Toy(-4.0)
    found = fly_strata(LAW, toy, allocated(Toy(0.1)), SEED).throughout
    assert found.unlike[-1] > 10
    reached, truth = of_strata(found, 0.975), plain(toy, 100)
    assert abs(plain(Toy(0.0), 100) - truth) > 0.05
    assert reached.low <= truth <= reached.high


def test_flights_are_told_as_they_are_flown():
    toy, told = Toy(0.1), []
    found = fly_strata(LAW, toy, allocated(toy), SEED, lambda *numbers: told.append(numbers))
    assert told[-1] == (sum(found.throughout.flown),) * 2
    assert [flown for _, flown in told] == sorted({flown for _, flown in told})


def test_no_limit_within_reach_is_kept_for_sure():
    free, toy = replace(LAW, limits=Limits((), ())), Toy(0.0)
    assert np.all(np.isinf(free.margin(draw(0, 0, SOURCES))))
    assert survey(free, toy, SEED).share.tolist() == [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]


@pytest.fixture(scope="module")
def law(solution) -> tuple[Mission, Law]:
    mission = Mission.from_scenario(solution.scenario)
    guess = from_burns(mission, solution.burns_m_s)
    lin = mission.dynamics.linearise(mission.problem, guess)
    return mission, Law.of(lin, mission.units.length_m)


def test_law_has_the_draws_of_flights_in_order(solution, law):
    mission, its = law
    assert its.sources == Flyer(mission, solution.burns_m_s).sources
    draws = 0.01 * draw(3, 0, its.sources)[:50]
    flown = Flyer(mission, solution.burns_m_s).fly(mission.times_s, draws).states[..., :3]
    expected = its.mean[:, None] + np.einsum("nic,fc->nfi", its.factor, draws)
    off = np.linalg.norm(flown / its.length_m - expected, axis=2) * its.length_m
    moved = np.linalg.norm(expected - its.mean[:, None], axis=2) * its.length_m
    assert off.max() < 0.02
    assert moved.max() > 1.0
    assert its.margin(draws) == pytest.approx(its.margins_at(flown, draws).min(axis=0), abs=0.02)


NODES_S = 90.0 * np.arange(NODES)
SAMPLES_S = np.arange(0.0, NODES_S[-1] + 1.0, 30.0)
TIMES_S = np.linspace(0.0, NODES_S[-1], PARTS * (len(SAMPLES_S) - 1) + 1)
TAIL = 0.0125


@dataclass(frozen=True)
class ToyInTime:
    """Flights that keep the law's margin less so much, on a line between the nodes."""

    less_m: float

    def positions(self, draws: Array) -> Array:
        moved = Toy(0.0).positions(draws)
        moved[..., 0] += self.less_m * np.sign(draws[:, 0])
        return moved

    def margins(self, draws: Array) -> Array:
        at_nodes = LAW.margins_at(self.positions(draws), draws)
        lines = [np.interp(TIMES_S, NODES_S, margin) for margin in at_nodes.T]
        return np.column_stack(lines)

    def histories(self, draws: Array) -> Iterator[LimitHistory]:
        margins = self.margins(draws)
        arc, flight = (index.ravel() for index in np.indices((len(SAMPLES_S) - 1, len(draws))))
        seconds = PARTS * arc[:, None] + np.arange(1, PARTS)
        between = margins[seconds, flight[:, None]] >= 0.0
        yield LimitHistory("ball", SAMPLES_S, margins[::PARTS] >= 0.0, arc, flight, between)


def flown(toy: ToyInTime, draws: float, share: float | None) -> CountedFlights:
    """So many draws, of which a share is flown; what is allotted for so many plain flights if none."""
    law, known = survey_in_time({"ball": LAW}, NODES_S, toy, SEED)
    if share is None:
        p = proportion(round((1.0 - known.failed) * draws), int(draws), 1.0 - 2.0 * TAIL)
        widths = p.value - p.low, p.high - p.value
        allocation = allocate(known, int(draws), widths, TAIL, mirrored=True)
        assert allocation is not None
    else:
        allocation = Allocation(draws, known.near, (share,) * 6, (0.5, 0.5))
    assert allocation.share == allocation.share[::-1]
    return fly_in_time(law, toy, {"ball": TIMES_S}, allocation, SEED, TAIL)


@pytest.mark.parametrize("less_m", [0.0, 1.0, -3.0])
def test_flying_all_draws_equals_plain_flights(less_m):
    toy = ToyInTime(less_m)
    found = flown(toy, 3_000.0, 1.0)
    number = sum(found.throughout.drawn)
    draws = np.concatenate([draw(SEED, block, SOURCES) for block in range(4)])[:number]
    failed = np.mean(toy.margins(draws) < 0.0, axis=1)
    assert found.throughout.drawn == found.throughout.flown
    assert found.throughout.failed == pytest.approx(failed.max(), abs=1e-12)
    assert found.at_nodes.failed == pytest.approx(failed[:: 3 * PARTS].max(), abs=1e-12)
    assert (sum(found.throughout.unlike) > 0) == (less_m != 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("less_m", [0.3, -1.0])
def test_few_strata_flights_agree_with_all(less_m):
    toy, n = ToyInTime(less_m), 20_000
    found = flown(toy, n, None).throughout
    draws = np.concatenate([draw(7, block, SOURCES) for block in range(20)])
    truth = float(np.mean(toy.margins(draws) < 0.0, axis=1).max())
    reached = of_strata(found, 1.0 - 2.0 * TAIL)
    assert sum(found.flown) < 0.2 * n
    assert reached.low - 0.01 <= 1.0 - truth <= reached.high + 0.01
    plain = proportion(round(n * reached.value), n, 1.0 - 2.0 * TAIL)
    assert reached.high - reached.low < 1.03 * (plain.high - plain.low)


def test_draws_crossing_between_nodes_are_nearest():
    law = LawInTime({"ball": LAW}, NODES_S, {"ball": np.array([False, True, False, False])})
    margins = np.array([[5.0, 5.0, 5.0], [3.0, 3.0, -4.0], [-1.0, 1.0, -1.0], [-9.0, -9.0, 9.0]])
    assert law.nearest({"ball": margins}).tolist() == [0.0, 3.0, 0.0]


def test_history_counts_flights_at_each_second(mission, default_plan):
    burns = 0.9 * default_plan.burns_m_s
    draws = draw(3, 0, Flyer(mission, burns).sources)[:40]
    histories = SampledFlights(mission, burns).histories(draws)
    its = next(one for one in histories if one.name == "emission")
    some = np.arange(40)[::3]
    fails = its.fails(some)
    every = its.fails(np.arange(40))
    assert np.array_equal(every[:, some], fails)
    assert 0 < every.sum() < every.size
    assert np.array_equal(~every[::PARTS], its.holds)
    assert np.array_equal(its.counts, (~every).sum(axis=1))
    assert np.array_equal(its.kept, ~every.any(axis=0))
    when, who = its.broken
    assert len(when) == len(who) <= every.sum()
    assert set(who) == set(np.flatnonzero(~its.kept))
    assert len(seconds_of(mission)["emission"]) == len(every)
    assert set(its.times_s) <= set(sample_times(mission))
