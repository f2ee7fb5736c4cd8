"""Each limit at each second by itself: flights chosen by the law reach what all flights reach."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from formulations.arrays import Array
from formulations.risk.strata import Allocation, allocate
from scp_recon.monte_carlo.estimates import of_strata, proportion
from scp_recon.monte_carlo.law import Law
from scp_recon.monte_carlo.law_in_time import FlightsInTime, LawInTime, fly_in_time, survey_in_time
from scp_recon.monte_carlo.sampling import draw, number_of_sources
from scp_recon.monte_carlo.whole_flight import (
    PARTS,
    Course,
    WholeFlights,
    kept_flights,
    looks_of,
    seconds_of,
)
from tests.scp_recon.monte_carlo.test_law import LAW, NODES, SEED, SOURCES

NODES_S = 90.0 * np.arange(NODES)
LOOKS_S = np.arange(0.0, NODES_S[-1] + 1.0, 30.0)
TIMES_S = np.linspace(0.0, NODES_S[-1], PARTS * (len(LOOKS_S) - 1) + 1)
TAIL = 0.0125


@dataclass(frozen=True)
class Toy:
    """Flights that keep the law's margin less so much, on a line between the nodes."""

    less_m: float

    def positions(self, draws: Array) -> Array:
        out = draws[:, 0] / np.abs(draws[:, 0])
        moved = LAW.mean[:, None] + np.einsum("nic,fc->nfi", LAW.factor, draws)
        moved[..., 0] += out[None] * self.less_m / LAW.length_m
        return moved * LAW.length_m

    def margins(self, draws: Array) -> Array:
        at_nodes = LAW.margins_at(self.positions(draws))
        lines = [np.interp(TIMES_S, NODES_S, margin) for margin in at_nodes.T]
        return np.column_stack(lines)

    def courses(self, draws: Array) -> Iterator[Course]:
        margins = self.margins(draws)
        arc, flight = (index.ravel() for index in np.indices((len(LOOKS_S) - 1, len(draws))))
        seconds = PARTS * arc[:, None] + np.arange(1, PARTS)
        between = margins[seconds, flight[:, None]] >= 0.0
        yield Course("ball", LOOKS_S, margins[::PARTS] >= 0.0, arc, flight, between)


def flown(toy: Toy, draws: float, share: float | None) -> FlightsInTime:
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
def test_all_draws_flown_are_plain_flights_whatever_the_law_says(less_m):
    toy = Toy(less_m)
    found = flown(toy, 3_000.0, 1.0)
    number = sum(found.throughout.drawn)
    draws = np.concatenate([draw(SEED, block, SOURCES) for block in range(4)])[:number]
    failed = np.mean(toy.margins(draws) < 0.0, axis=1)
    assert found.throughout.drawn == found.throughout.flown
    assert found.throughout.failed == pytest.approx(failed.max(), abs=1e-12)
    assert found.at_nodes.failed == pytest.approx(failed[:: 3 * PARTS].max(), abs=1e-12)
    assert (sum(found.throughout.unlike) > 0) == (less_m != 0.0)


@pytest.mark.parametrize("less_m", [0.3, -1.0])
def test_few_flights_reach_what_all_reach(less_m):
    toy, n = Toy(less_m), 20_000
    found = flown(toy, n, None).throughout
    draws = np.concatenate([draw(7, block, SOURCES) for block in range(20)])
    truth = float(np.mean(toy.margins(draws) < 0.0, axis=1).max())
    reached = of_strata(found, 1.0 - 2.0 * TAIL)
    assert sum(found.flown) < 0.2 * n
    assert reached.low - 0.01 <= 1.0 - truth <= reached.high + 0.01
    plain = proportion(round(n * reached.value), n, 1.0 - 2.0 * TAIL)
    assert reached.high - reached.low < 1.03 * (plain.high - plain.low)


def test_draws_that_cross_a_limit_between_nodes_are_next_to_it():
    law = LawInTime({"ball": LAW}, NODES_S, {"ball": np.array([False, True, False, False])})
    margins = np.array([[5.0, 5.0, 5.0], [3.0, 3.0, -4.0], [-1.0, 1.0, -1.0], [-9.0, -9.0, 9.0]])
    assert law.nearest({"ball": margins}).tolist() == [0.0, 3.0, 0.0]


def test_a_course_counts_what_flights_do_at_each_second(mission, default_plan):
    burns = 0.9 * default_plan.burns_m_s
    draws = draw(3, 0, number_of_sources(mission, burns))[:40]
    courses = WholeFlights(mission, burns).courses(draws)
    its = next(course for course in courses if course.name == "emission")
    some = np.arange(40)[::3]
    fails = its.fails(some)
    every = its.fails(np.arange(40))
    assert np.array_equal(every[:, some], fails)
    assert 0 < every.sum() < every.size
    assert np.array_equal(~every[::PARTS], its.holds)
    between = every[:-1].reshape(-1, PARTS, 40)[:, 1:]
    assert np.array_equal(its.counts_between, (~between).sum(axis=2))
    assert np.array_equal(its.kept, ~every.any(axis=0))
    when, who = its.broken
    assert len(when) == len(who) <= every.sum()
    assert set(who) == set(np.flatnonzero(~its.kept))
    assert len(seconds_of(mission)["emission"]) == len(every)
    assert set(its.looks) <= set(looks_of(mission))


def test_a_mission_s_flights_in_strata_reach_what_plain_ones_reach(mission, default_plan):
    burns = default_plan.burns_m_s
    laws = Law.of_events(default_plan.final.result.lin, mission.units.length_m)
    flights = WholeFlights(mission, burns)
    law, known = survey_in_time(laws, mission.times_s, flights, SEED)
    assert 1.0 < known.near < 30.0
    allocation = allocate(known, 10_000, (0.01, 0.01), 0.025, mirrored=True)
    assert allocation is not None
    found = fly_in_time(law, flights, seconds_of(mission), allocation, SEED, TAIL)
    other = kept_flights(mission, burns, 1_000, seed=12)
    plain = min(other.throughout.values()), min(int(c.min()) for c in other.at_nodes.values())
    for strata, kept in zip((found.throughout, found.at_nodes), plain, strict=True):
        one, two = of_strata(strata, 0.99), proportion(kept, 1_000, 0.99)
        assert max(one.low, two.low) <= min(one.high, two.high)
    assert sum(found.throughout.flown) < 1_500
