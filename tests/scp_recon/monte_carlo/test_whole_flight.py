"""Limits that flights keep, between looks too: at any speed, and at the moment of a burn."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from formulations.arrays import Array
from scp_recon.certification.flights import with_nodes_at
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.observation_time import joint_margins
from scp_recon.monte_carlo.sampling import draw, number_of_sources, sample_positions
from scp_recon.monte_carlo.whole_flight import (
    LOOK_S,
    PARTS,
    SAFETY,
    KeptFlights,
    kept_flights,
    looked_at,
    may_dip,
)
from scp_recon.results.solution import Solution
from tests.scp_recon.support import mission_of

# --- how far a margin dips between looks --------------------------------------------------------


@given(
    speed=st.floats(0.01, 1e4),
    closest=st.floats(1.0, 1e4),
    share=st.floats(0.0, 1.0),
    radius=st.floats(0.0, 1e4),
)
def test_a_flight_past_a_ball_is_seen_at_any_speed(
    speed: float, closest: float, share: float, radius: float
) -> None:
    """Straight past a centre: where a limit is broken between two looks, the dip allows for it."""
    looks = LOOK_S * np.arange(-4.0, 5.0)
    passed = share * LOOK_S
    fine = np.linspace(0.0, LOOK_S, 301)

    def margin(time: Array) -> Array:
        return np.hypot(closest, speed * (time - passed)) - radius

    ends = margin(looks)[4:6]
    if margin(fine).min() < 0.0:
        assert ends.min() < may_dip(looks, margin(looks))[4] + 1e-9 * (radius + closest)


def test_a_slow_flight_is_not_looked_at_far_from_a_limit() -> None:
    """At Bennu's speeds margins dip by centimetres in half a minute."""
    looks = LOOK_S * np.arange(100.0)
    margin = np.hypot(600.0, 0.15 * (looks - 1500.0)) - 500.0
    assert may_dip(looks, margin).max() < 0.05


def test_two_looks_tell_nothing_of_what_is_between_them() -> None:
    assert np.isinf(may_dip(np.array([0.0, 30.0]), np.array([[5.0], [5.0]]))).all()


# --- flights ------------------------------------------------------------------------------------

FLIGHTS, SEED = 1000, 5


def test_until_a_burn_the_path_goes_on_as_it_did(solution: Solution) -> None:
    """Between the last look and a burn at the next one: with the velocity before it, not after it."""
    burn_s = solution.scenario.burns.times_s[1]
    burns = solution.burns_m_s.copy()
    burns[1] = [0.0, 0.0, 0.19]
    mission = Mission.from_scenario(solution.scenario)
    looks = np.union1d(np.arange(0.0, mission.times_s[-1], LOOK_S), mission.times_s)
    arc = int(np.searchsorted(looks, burn_s)) - 1
    seconds = looks[arc] + (looks[arc + 1] - looks[arc]) * np.arange(1, PARTS) / PARTS
    distance = np.linalg.norm(sample_positions(mission, burns, seconds, FLIGHTS, SEED), axis=2)
    limit = float(np.median(distance[2 * PARTS // 3]))
    at_limit = solution.scenario.replace({"safety.radius_min_m": limit})
    tight = dataclasses.replace(mission, scenario=at_limit)  # a limit in the flight's own way
    draws = draw(SEED, 0, number_of_sources(tight, burns))
    found = looked_at(tight, burns, looks, draws).between[SAFETY][arc]
    np.testing.assert_allclose(found, np.sum(distance >= limit, axis=1), atol=1)


@pytest.fixture(scope="module")
def sparse(solution: Solution) -> tuple[Mission, Array, KeptFlights]:
    """A plan that breaks a limit between the edges of the window, which has no other nodes."""
    mission = mission_of("observation.emission_max_deg=36", "grid.step_max_s=3500")
    return mission, solution.burns_m_s, kept_flights(mission, solution.burns_m_s, FLIGHTS, SEED)


def test_seconds_between_nodes_that_are_touched_are_less_likely_than_every_node(
    sparse: tuple[Mission, Array, KeptFlights],
) -> None:
    mission, burns, kept = sparse
    least = min(int(counts.min()) for counts in kept.at_nodes.values())
    lowest = min(kept.throughout.values())
    assert lowest < least - 100
    assert len(kept.touched_s) > 0
    some = np.unique(kept.touched_s)[:: max(1, len(kept.touched_s) // 20)]
    positions = sample_positions(mission, burns, some, FLIGHTS, SEED)
    margins = joint_margins(mission, some, positions)
    margins[SAFETY] = np.linalg.norm(positions, axis=2) - mission.scenario.safety.radius_min_m
    counts = np.min([np.sum(margin >= 0.0, axis=1) for margin in margins.values()], axis=0)
    assert np.all(counts <= least - 0.5 * (least - lowest) + 1)


def test_nodes_there_close_the_gap(sparse: tuple[Mission, Array, KeptFlights]) -> None:
    mission, burns, kept = sparse
    finer = with_nodes_at(mission, kept.touched_s)
    again = kept_flights(finer, burns, FLIGHTS, SEED)
    assert min(again.throughout.values()) == min(kept.throughout.values())
    lost = [
        min(int(counts.min()) for counts in of.at_nodes.values()) - min(of.throughout.values())
        for of in (kept, again)
    ]
    assert lost[0] > 100
    assert lost[1] <= 0.3 * lost[0]
