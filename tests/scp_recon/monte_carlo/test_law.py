"""Flights chosen by the law's margin reach what all flights reach, however wrong the law is."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from formulations.arrays import Array
from formulations.problem.regions import Ball
from formulations.risk.strata import Allocation, allocate
from formulations.rows.flight_probability import Limit, Limits
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import of_strata, proportion
from scp_recon.monte_carlo.law import Law, fly_strata, survey
from scp_recon.monte_carlo.sampling import draw, fly_draws, number_of_sources
from scp_recon.monte_carlo.whole_flight import LookedAt, WholeFlights, kept_flights
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

    def looked_at(self, draws: Array) -> LookedAt:
        off = self.positions(draws) / LAW.length_m - MEAN[:, None]
        kept = np.all(np.linalg.norm(off, axis=2) <= 1.6, axis=0)
        return LookedAt({}, {}, kept, kept, np.zeros(0))


def plain(toy: Toy, blocks: int) -> float:
    """Share that keeps the limits of a thousand flights a block."""
    return float(np.mean([toy.looked_at(draw(7, block, SOURCES)).kept for block in range(blocks)]))


def allocated(toy: Toy, flights: int = 20_000) -> Allocation:
    known = survey(LAW, toy, SEED)
    p = proportion(round((1.0 - known.failed) * flights), flights, 0.975)
    found = allocate(known, flights, (p.value - p.low, p.high - p.value), 0.0125)
    assert found is not None
    return found


@pytest.mark.parametrize("bend_m", [0.0, 0.1, -0.2])
def test_few_flights_reach_what_all_reach(bend_m):
    toy = Toy(bend_m)
    found = fly_strata(LAW, toy, allocated(toy), SEED)
    reached = of_strata(found.whole, 0.975)
    assert sum(found.whole.flown) < 3_000
    assert found.whole == found.at_nodes
    assert reached.low <= plain(toy, 100) <= reached.high
    as_plain = proportion(round(20_000 * reached.value), 20_000, 0.975)
    assert reached.high - reached.low < 1.03 * (as_plain.high - as_plain.low)


def test_a_law_that_is_wrong_where_it_was_sure_widens_the_interval():
    """Allocated for flights that follow the law, which others do not."""
    toy = Toy(-4.0)
    found = fly_strata(LAW, toy, allocated(Toy(0.1)), SEED).whole
    assert found.unlike[-1] > 10
    reached, truth = of_strata(found, 0.975), plain(toy, 100)
    assert abs(plain(Toy(0.0), 100) - truth) > 0.05
    assert reached.low <= truth <= reached.high


def test_flights_are_told_as_they_are_flown():
    toy, told = Toy(0.1), []
    found = fly_strata(LAW, toy, allocated(toy), SEED, lambda *numbers: told.append(numbers))
    assert told[-1] == (sum(found.whole.flown),) * 2
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


def test_the_law_has_the_numbers_that_a_flight_draws_in_their_order(solution, law):
    mission, its = law
    assert its.sources == number_of_sources(mission, solution.burns_m_s)
    draws = 0.01 * draw(3, 0, its.sources)[:50]
    flown = fly_draws(mission, solution.burns_m_s, mission.times_s, draws).states[..., :3]
    expected = its.mean[:, None] + np.einsum("nic,fc->nfi", its.factor, draws)
    off = np.linalg.norm(flown / its.length_m - expected, axis=2) * its.length_m
    moved = np.linalg.norm(expected - its.mean[:, None], axis=2) * its.length_m
    assert off.max() < 0.02
    assert moved.max() > 1.0
    assert its.margin(draws) == pytest.approx(its.margin_at(flown), abs=0.02)


def test_a_mission_s_flights_in_strata_reach_what_plain_ones_reach(solution, law):
    mission, its = law
    flights = WholeFlights(mission, solution.burns_m_s)
    known = survey(its, flights, SEED)
    assert 1.0 < known.near < 30.0
    allocation = allocate(known, 10_000, (0.02, 0.02), 0.025)
    assert allocation is not None
    found = fly_strata(its, flights, allocation, SEED)
    other = kept_flights(mission, solution.burns_m_s, 1_000, seed=12)
    for strata, kept in ((found.whole, other.whole), (found.at_nodes, other.whole_at_nodes)):
        one, two = of_strata(strata, 0.99), proportion(kept, 1_000, 0.99)
        assert max(one.low, two.low) <= min(one.high, two.high)
    assert sum(found.whole.flown) < 1_500
