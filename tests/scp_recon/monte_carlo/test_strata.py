"""Flights chosen by the law's margin reach what all flights reach, however wrong the law is.

Of all limits together, and then of each limit at each second by itself.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from formulations.arrays import Array
from formulations.problem.regions import Ball
from formulations.risk.strata import Allocation, allocate
from formulations.rows.exact_flight import FLIGHT
from formulations.rows.flight_probability import Limit, Limits
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import of_strata, proportion
from scp_recon.monte_carlo.sampling import Flyer, draw
from scp_recon.monte_carlo.strata import FAR, DrawsInStrata, Law, fly_strata, surveyed
from scp_recon.monte_carlo.whole_flight import (
    PARTS,
    Judged,
    KeptCounts,
    SampledFlights,
    every_second,
    sample_times,
)
from scp_recon.planning.initial_guess import from_burns

SOURCES, NODES, SEED = 5, 4, 11
rng = np.random.default_rng(1)
MEAN = np.array([[3.0, 0.0, 0.0]]) * np.arange(1, NODES + 1)[:, None]
FACTOR = 0.3 * rng.normal(size=(NODES, 3, SOURCES))
BALLS = Limit(Ball(MEAN, 1.6), np.arange(NODES))
NODES_S = 90.0 * np.arange(NODES)
LAW = Law(MEAN, FACTOR, {"ball": Limits((BALLS,), ())}, 10.0, NODES_S)
"""Of five sources, whatever they are: positions at four nodes are to be within 16 m of their mean."""
WHOLE = replace(LAW, limits={FLIGHT: LAW.limits["ball"]}, is_whole=True)
SAMPLES_S = np.arange(0.0, NODES_S[-1] + 1.0, 30.0)
TIMES_S = every_second(SAMPLES_S)
TAIL = 0.0125


@dataclass(frozen=True)
class Toy:
    """Flights that follow the law, bent by so many metres times the square of the first number."""

    bend_m: float
    seed = SEED
    counted_s = {FLIGHT: np.array([np.inf, 0.0])}  # noqa: RUF012

    def positions(self, draws: Array) -> Array:
        moved = MEAN[:, None] + np.einsum("nic,fc->nfi", FACTOR, draws)
        moved[..., 0] += self.bend_m / LAW.length_m * draws[:, 0] ** 2
        return moved * LAW.length_m

    def judged(self, draws: Array) -> Judged:
        off = self.positions(draws) / LAW.length_m - MEAN[:, None]
        kept = np.all(np.linalg.norm(off, axis=2) <= 1.6, axis=0)
        return Judged({FLIGHT: (self.counted_s[FLIGHT], np.stack([kept, kept]))})


@dataclass(frozen=True)
class ToyInTime:
    """Flights that keep the law's margin less so much, on a line between the nodes."""

    less_m: float
    seed = SEED
    counted_s = {"ball": TIMES_S}  # noqa: RUF012

    def positions(self, draws: Array) -> Array:
        moved = Toy(0.0).positions(draws)
        moved[..., 0] += self.less_m * np.sign(draws[:, 0])
        return moved

    def margins(self, draws: Array) -> Array:
        at_nodes = LAW.margins(draws, self.positions(draws))["ball"]
        lines = [np.interp(TIMES_S, NODES_S, margin) for margin in at_nodes.T]
        return np.column_stack(lines)

    def judged(self, draws: Array) -> Judged:
        return Judged({"ball": (TIMES_S, self.margins(draws) >= 0.0)})


def plain(toy: Toy, blocks: int) -> float:
    """Share that keeps the limits of a thousand flights a block."""
    blocks_kept = [toy.judged(draw(7, block, SOURCES)).kept for block in range(blocks)]
    return float(np.mean([kept[FLIGHT][1][0] for kept in blocks_kept]))


def in_strata(toy: Toy | ToyInTime, draws: float = 20_000, share: float = 0.0) -> DrawsInStrata:
    """What is allotted for so many plain flights; or so many draws, of which a share is flown."""
    known, survey = surveyed(WHOLE if isinstance(toy, Toy) else LAW, toy)
    p = proportion(round((1.0 - survey.failed) * draws), int(draws), 1.0 - 2.0 * TAIL)
    widths, mirrored = (p.value - p.low, p.high - p.value), isinstance(toy, ToyInTime)
    found = allocate(survey, int(draws), widths, TAIL, mirrored=mirrored)
    if share:
        found = Allocation(draws, survey.near, (share,) * 6, (0.5, 0.5))
    assert found is not None
    assert not mirrored or found.share == found.share[::-1]
    return DrawsInStrata(known, toy, found)


def flown(toy: Toy | ToyInTime, *how: float) -> KeptCounts:
    return fly_strata(in_strata(toy, *how), TAIL)


@pytest.mark.slow
@pytest.mark.parametrize("bend_m", [0.0, 0.1, -0.2])
def test_few_flights_reach_what_all_reach(bend_m):
    found = flown(toy := Toy(bend_m))
    reached = of_strata(found.strata, 0.975)
    assert sum(found.strata.flown) < 3_000
    assert found.throughout == pytest.approx(found.at_nodes)
    assert reached.low <= plain(toy, 100) <= reached.high
    as_plain = proportion(round(20_000 * reached.value), 20_000, 0.975)
    assert reached.high - reached.low < 1.03 * (as_plain.high - as_plain.low)


def test_law_wrong_where_sure_widens_the_interval():
    """Allocated for flights that follow the law, which others do not."""
    toy = Toy(-4.0)
    found = fly_strata(replace(in_strata(Toy(0.1)), flights=toy), TAIL).strata
    assert found.unlike[-1] > 10
    reached, truth = of_strata(found, 0.975), plain(toy, 100)
    assert abs(plain(Toy(0.0), 100) - truth) > 0.05
    assert reached.low <= truth <= reached.high


def test_flights_are_told_as_they_are_flown():
    told: list[float] = []
    fly_strata(in_strata(Toy(0.1)), TAIL, told.append)
    assert told == sorted(set(told))
    assert told[-1] == 1.0


def test_no_limit_within_reach_is_kept_for_sure():
    free, toy = replace(WHOLE, limits={FLIGHT: Limits((), ())}), Toy(0.0)
    assert np.all(free.margins(draw(0, 0, SOURCES))[FLIGHT] == FAR)
    _, survey = surveyed(free, toy)
    assert survey.share.tolist() == [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]


@pytest.fixture(scope="module")
def law(solution) -> tuple[Mission, Law]:
    mission = Mission.from_scenario(solution.scenario)
    guess = from_burns(mission, solution.burns_m_s)
    lin = mission.dynamics.linearise(mission.problem, guess)
    return mission, Law.of(mission, lin, is_whole=True)


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
    by_law, exact = its.margins(draws)[FLIGHT], its.margins(draws, flown)[FLIGHT]
    assert by_law == pytest.approx(exact, abs=0.02)


@pytest.mark.parametrize("less_m", [0.0, 1.0, -3.0])
def test_flying_all_draws_equals_plain_flights(less_m):
    found = flown(toy := ToyInTime(less_m), 3_000.0, 1.0)
    number = sum(found.strata.drawn)
    draws = np.concatenate([draw(SEED, block, SOURCES) for block in range(4)])[:number]
    failed = np.mean(toy.margins(draws) < 0.0, axis=1)
    assert found.strata.drawn == found.strata.flown
    assert found.strata.failed == pytest.approx(failed.max(), abs=1e-12)
    at_nodes = 1.0 - failed[:: 3 * PARTS].max()
    assert found.at_nodes / found.samples == pytest.approx(at_nodes, abs=1e-12)
    assert (sum(found.strata.unlike) > 0) == (less_m != 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("less_m", [0.3, -1.0])
def test_few_strata_flights_agree_with_all(less_m):
    toy, n = ToyInTime(less_m), 20_000
    found = flown(toy, n).strata
    draws = np.concatenate([draw(7, block, SOURCES) for block in range(20)])
    truth = float(np.mean(toy.margins(draws) < 0.0, axis=1).max())
    reached = of_strata(found, 1.0 - 2.0 * TAIL)
    assert sum(found.flown) < 0.2 * n
    assert reached.low - 0.01 <= 1.0 - truth <= reached.high + 0.01
    plain = proportion(round(n * reached.value), n, 1.0 - 2.0 * TAIL)
    assert reached.high - reached.low < 1.03 * (plain.high - plain.low)


def test_draws_crossing_between_nodes_are_nearest():
    law = replace(LAW, contends={"ball": np.array([False, True, False, False])})
    margins = np.array([[5.0, 5.0, 5.0], [3.0, 3.0, -4.0], [-1.0, 1.0, -1.0], [-9.0, -9.0, 9.0]])
    assert law.nearest({"ball": margins}).tolist() == [0.0, 3.0, 0.0]


def test_flights_are_judged_alike_by_second_and_whole(mission, default_plan):
    burns = 0.9 * default_plan.burns_m_s
    draws = draw(3, 0, Flyer(mission, burns).sources)[:40]
    flights = SampledFlights(mission.changed({"risk.scope": "node"}), burns)
    kept, touched = flights.judged(draws)
    assert len(touched) == 0
    assert [*kept] == [*flights.counted_s]
    assert all(np.array_equal(at, flights.counted_s[name]) for name, (at, _) in kept.items())
    times, holds = kept["emission"]
    assert 0 < holds.sum() < holds.size
    assert set(times[::PARTS]) <= set(sample_times(mission))
    whole = SampledFlights(
        mission.changed({"risk.scope": "flight", "risk.allocation": "exact"}), burns
    )
    (throughout, at_nodes), touched = whole.judged(draws).kept[FLIGHT][1], whole.judged(draws)[1]
    every = [those.all(axis=0) for _, those in kept.values()]
    assert np.array_equal(throughout, np.logical_and.reduce(every))
    lost = at_nodes & ~throughout
    broken = [at[(~those[:, lost]).any(axis=1)] for at, those in kept.values()]
    assert set(touched) == set(np.concatenate(broken))
