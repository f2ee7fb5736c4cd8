"""Flights: their draws, what happens between nodes, time observed, and intervals."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import beta, binom

from formulations.arrays import Array
from scp_recon.certification.flights import with_nodes_at
from scp_recon.mission.constraints import SAFETY
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import CONFIDENCE, binomial_quantile, proportion
from scp_recon.monte_carlo.flights import window_samples
from scp_recon.monte_carlo.limits import ALL, SCIENCE, joint_margins, time_held
from scp_recon.monte_carlo.sampling import BLOCK, Flyer, draw
from scp_recon.monte_carlo.whole_flight import (
    PARTS,
    SAMPLE_STEP_S,
    SampledFlights,
    every_second,
    kept_flights,
    may_dip,
    sample_times,
)
from scp_recon.physics import geometry
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from tests.helpers import share_of_examples
from tests.scp_recon.support import integrate, mission_of

LOOK = np.array([0.0, 8000.0, 13_140.5, 25_000.0, 34_842.0])


@pytest.fixture(scope="module")
def burns(solution) -> Array:
    return solution.burns_m_s


def test_flights_are_distinct_and_independent_of_their_number(mission, burns):
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    few = Flyer(mission, burns).first_positions(LOOK, 500)
    many = Flyer(mission, burns).first_positions(LOOK, 1500)
    assert few.shape == (len(LOOK), 500, 3)
    assert many.shape == (len(LOOK), 1500, 3)
    np.testing.assert_array_equal(few, many[:, :500])
    # Blocks and seeds draw different numbers, and none of NumPy's global ones.
    other = Flyer(mission, burns, seed=1).first_positions(LOOK[:1], 500)[0]
    assert BLOCK < 1500
    assert len(np.unique(np.vstack([many[0], other]), axis=0)) == 2000
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002


def test_each_flight_is_that_of_an_adaptive_integration(mission, burns):
    times = np.array(mission.scenario.burns.times_s)
    flights = Flyer(mission, burns).fly_block(times, 0, flights=4)
    for flight in range(4):
        for leg in range(len(times) - 1):
            end = integrate(mission.forces, flights.states[leg, flight], times[leg : leg + 2])[-1]
            end[3:] += flights.burns_m_s[flight, leg + 1]
            arrived = flights.states[leg + 1, flight]
            np.testing.assert_allclose(arrived[:3], end[:3], rtol=0.0, atol=5e-3)
            np.testing.assert_allclose(arrived[3:], end[3:], rtol=0.0, atol=1e-6)


@given(
    speed=st.floats(0.01, 1e4),
    closest=st.floats(1.0, 1e4),
    share=st.floats(0.0, 1.0),
    radius=st.floats(0.0, 1e4),
)
def test_dip_past_ball_is_found_at_any_speed(speed, closest, share, radius):
    """Straight past a centre: where a limit is broken between two samples, the dip allows for it.

    Two samples tell nothing of what is between them.
    """
    samples = SAMPLE_STEP_S * np.arange(-4.0, 5.0)
    passed = share * SAMPLE_STEP_S
    fine = np.linspace(0.0, SAMPLE_STEP_S, 301)

    def margin(time: Array) -> Array:
        return np.hypot(closest, speed * (time - passed)) - radius

    ends = margin(samples)[4:6]
    if margin(fine).min() < 0.0:
        assert ends.min() < may_dip(samples, margin(samples))[4] + 1e-9 * (radius + closest)
    assert np.isinf(may_dip(samples[:2], margin(samples[:2])[:, None])).all()


FLIGHTS, SEED = 1000, 5


@pytest.mark.slow
def test_path_before_a_burn_is_unchanged(solution):
    """Between the last sample and a burn at the next one: with the velocity before it."""
    burn_s = solution.scenario.burns.times_s[1]
    burns = solution.burns_m_s.copy()
    burns[1] = [0.0, 0.0, 0.19]
    mission = Mission.from_scenario(solution.scenario)
    samples = sample_times(mission)
    arc = int(np.searchsorted(samples, burn_s)) - 1
    seconds = every_second(samples[arc : arc + 2])[1:-1]
    distance = np.linalg.norm(
        Flyer(mission, burns, seed=SEED).first_positions(seconds, FLIGHTS), axis=2
    )
    limit = float(np.median(distance[2 * PARTS // 3]))
    at_limit = solution.scenario.replace({"safety.radius_min_m": limit})
    tight = dataclasses.replace(mission, scenario=at_limit)  # a limit in the flight's own way
    draws = draw(SEED, 0, Flyer(tight, burns).sources)
    _, holds = SampledFlights(tight, burns).judged(draws).kept[SAFETY]
    found = holds.sum(axis=1)[PARTS * arc + 1 : PARTS * (arc + 1)]
    np.testing.assert_allclose(found, np.sum(distance >= limit, axis=1), atol=1)


@pytest.mark.slow
def test_nodes_added_at_violations_close_the_gap(burns):
    mission = mission_of("observation.emission_max_deg=36", "grid.step_max_s=3500")
    kept = kept_flights(SampledFlights(mission, burns, seed=SEED), FLIGHTS)
    finer = with_nodes_at(mission, kept.touched_s)
    again = kept_flights(SampledFlights(finer, burns, seed=SEED), FLIGHTS)
    assert again.throughout == kept.throughout
    lost = [found.at_nodes - found.throughout for found in (kept, again)]
    assert lost[0] > 100
    assert lost[1] <= 0.3 * lost[0]


SCANNED = 60


def test_holding_time_matches_a_fine_scan(mission, burns):
    """With burns that make many flights cross limits."""
    bold_burns = burns * np.array([1.03, 0.97, 1.0, 1.0])[:, None]
    sampled_s = window_samples(mission)
    coarse = Flyer(mission, bold_burns).fly_block(sampled_s, 0, flights=SCANNED)
    found = time_held(mission, sampled_s, coarse.states)
    step, length = 0.5, sampled_s[-1] - sampled_s[0]
    fine = np.arange(sampled_s[0] + 0.5 * step, sampled_s[-1], step)
    states = Flyer(mission, bold_burns).fly_block(fine, 0, flights=SCANNED).states
    joint = joint_margins(mission, fine, states[..., :3])
    for name in (*SCIENCE, ALL):
        held = found[name]
        wanted = SCIENCE if name == ALL else (name,)
        holds = np.logical_and.reduce([joint[n] >= 0.0 for n in wanted])
        scanned = holds.sum(axis=0) * length / len(fine)
        assert np.abs(held.duration - scanned).max() < 1.0
        ever = holds.any(axis=0)
        np.testing.assert_array_equal(np.isfinite(held.entry), ever)
        first = fine[np.argmax(holds, axis=0)]
        last = fine[len(fine) - 1 - np.argmax(holds[::-1], axis=0)]
        assert np.abs(held.entry - first)[ever].max() < 1.0
        assert np.abs(held.exit - last)[ever].max() < 1.0
    partly = (found[ALL].duration > 1.0) & (found[ALL].duration < length - 1.0)
    assert partly.sum() >= 5, "or constants were compared"


def test_dip_between_two_samples_is_counted(mission):
    """A flight straight through the upper distance limit and back within one spacing."""
    sampled_s = np.linspace(*mission.schedule.window_s, 58)
    spacing = sampled_s[1] - sampled_s[0]
    limit = mission.scenario.observation.site_distance_max_m
    middle = sampled_s[20] + 0.45 * spacing
    curvature, peak = 2e-3, 0.4

    def flight(time: np.ndarray) -> np.ndarray:
        track = geometry.track(mission.site, mission.rotation, time)
        across = np.cross(track.normal, mission.sun_direction(time))
        across /= np.linalg.norm(across, axis=-1, keepdims=True)
        tilt = np.deg2rad(30.0)
        sight = np.cos(tilt) * track.normal + np.sin(tilt) * across
        distance = limit + peak - curvature * (time - middle) ** 2
        return track.position + np.maximum(distance, 600.0)[:, None] * sight

    step = 1e-2
    velocity = (flight(sampled_s + step) - flight(sampled_s - step)) / (2 * step)
    states = np.concatenate([flight(sampled_s), velocity], axis=1)[:, None]
    margin = joint_margins(mission, sampled_s, states[..., :3])["site_distance"]
    above = 2.0 * np.sqrt(peak / curvature)
    assert above < spacing
    assert (margin >= 0.0).sum() >= len(sampled_s) - 1
    held = time_held(mission, sampled_s, states)["site_distance"].duration[0]
    assert sampled_s[-1] - sampled_s[0] - held == pytest.approx(above, abs=1.0)


@given(samples=st.integers(1, 20_000), share=st.floats(0.0, 1.0))
def test_interval_is_clopper_and_pearsons(samples, share):
    successes = round(share * samples)
    tail = 0.5 * (1.0 - CONFIDENCE)
    low = beta.ppf(tail, successes, samples - successes + 1) if successes else 0.0
    high = beta.ppf(1 - tail, successes + 1, samples - successes) if successes < samples else 1.0
    estimate = proportion(successes, samples)
    assert estimate.value == successes / samples
    assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=1e-9)
    assert 0.0 <= estimate.low <= estimate.value <= estimate.high <= 1.0


@settings(max_examples=share_of_examples(3))
@given(
    level=st.floats(1e-9, 1.0 - 1e-9), samples=st.integers(1, 20_000), share=st.floats(1e-3, 0.999)
)
def test_quantile_is_the_binomial_law_s(level, samples, share):
    """But for rounding where the law steps at the very level."""
    ours, theirs = binomial_quantile(level, samples, share), binom.ppf(level, samples, share)
    least = min(ours, theirs)
    assert ours == theirs or binom.cdf(least, samples, share) == pytest.approx(level, rel=1e-9)


@pytest.mark.slow
def test_violations_between_nodes_are_found():
    """Against the same flights sampled every second of the window.

    Emission is largest in the middle of the window, whose edges alone are nodes.
    """
    risk = "risk.p_chance=0.9", "risk.allocation=exact", "risk.scope=node"
    changes = "observation.emission_max_deg=40", "observation.window_s=[13300, 18000]"
    mission = mission_of(*risk, *changes, "grid.step_max_s=9000")
    burns = plan(mission, initial_guess.cold(mission)).burns_m_s
    told: list[int] = []
    whole = Mission.from_scenario(mission.scenario.replace({"risk.scope": "flight"}))
    kept = kept_flights(SampledFlights(whole, burns, seed=3), 200, told.append)
    assert told == [200]
    flights = SampledFlights(mission, burns, seed=3)
    judged = flights.judged(flights.draws(0)[:200]).kept
    worst = kept_flights(SampledFlights(mission, burns, seed=3), 200)
    assert mission.observed_s is not None
    first, last = mission.observed_s
    nodes = mission.times_s[mission.window_nodes]
    seconds = np.union1d(np.arange(np.ceil(first), last), nodes)
    flown = Flyer(mission, burns, seed=3).fly_block(seconds, 0, flights=200)
    holds = {
        name: margin >= 0.0
        for name, margin in joint_margins(mission, seconds, flown.states[..., :3]).items()
    }
    at = np.isin(seconds, nodes)
    every = np.logical_and.reduce(list(holds.values()))
    at_nodes, throughout = every[at].all(axis=0).sum(), every.all(axis=0).sum()
    assert throughout < at_nodes - 3
    assert judged[SAFETY][1].all()  # so that the window alone decides
    # A flight may touch a limit for less than a second.
    assert kept[:2] == pytest.approx((at_nodes, throughout), abs=1)
    for name, held in holds.items():
        counts = judged[name][1].sum(axis=1)
        np.testing.assert_array_equal(counts[np.isin(judged[name][0], nodes)], held[at].sum(axis=1))
        assert counts.min() == pytest.approx(held.sum(axis=1).min(), abs=1)
    seen = [judged[name] for name in holds]
    assert worst[:2] == (
        min(those[np.isin(times, nodes)].sum(axis=1).min() for times, those in seen),
        min(those.sum(axis=1).min() for _, those in seen),
    )
    lost = every[at].all(axis=0) & ~every.all(axis=0)
    broken = seconds[~every[:, lost].all(axis=1)]
    assert np.abs(kept.touched_s[:, None] - broken).min(axis=1).max() <= 1.0
    assert np.abs(broken[:, None] - kept.touched_s).min(axis=1).max() <= 0.5 * SAMPLE_STEP_S
