"""Time held agrees with a fine scan of the same flights."""

from __future__ import annotations

import numpy as np
import pytest

from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightConfig
from scp_recon.monte_carlo.observation_time import (
    ALL,
    SCIENCE,
    joint_margins,
    observation_margins,
    time_held,
)
from scp_recon.monte_carlo.sampling import fly_block
from scp_recon.results.solution import Solution

FLIGHTS = 60


@pytest.fixture(scope="module")
def bold_burns(solution: Solution) -> np.ndarray:
    """Burns that make many flights cross limits."""
    return solution.burns_m_s * np.array([1.03, 0.97, 1.0, 1.0])[:, None]


def test_time_held_matches_a_scan_at_half_a_second(
    mission: Mission, bold_burns: np.ndarray
) -> None:
    looks = FlightConfig(mission, bold_burns).looks_s
    coarse = fly_block(mission, bold_burns, looks, 0, flights=FLIGHTS)
    found = time_held(mission, looks, coarse.states)
    step, length = 0.5, looks[-1] - looks[0]
    fine = np.arange(looks[0] + 0.5 * step, looks[-1], step)
    states = fly_block(mission, bold_burns, fine, 0, flights=FLIGHTS).states
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


def test_a_dip_between_two_looks_is_counted(mission: Mission) -> None:
    """A flight straight through the upper distance limit and back within one spacing."""
    looks = np.linspace(*mission.schedule.window_s, 58)
    spacing = looks[1] - looks[0]
    limit = mission.scenario.observation.site_distance_max_m
    middle = looks[20] + 0.45 * spacing
    curvature, peak = 2e-3, 0.4

    def flight(time: np.ndarray) -> np.ndarray:
        from scp_recon.physics import geometry

        track = geometry.track(mission.site, mission.rotation, time)
        across = np.cross(track.normal, mission.sun_direction(time))
        across /= np.linalg.norm(across, axis=-1, keepdims=True)
        tilt = np.deg2rad(30.0)
        sight = np.cos(tilt) * track.normal + np.sin(tilt) * across
        distance = limit + peak - curvature * (time - middle) ** 2
        return track.position + np.maximum(distance, 600.0)[:, None] * sight

    step = 1e-2
    velocity = (flight(looks + step) - flight(looks - step)) / (2 * step)
    states = np.concatenate([flight(looks), velocity], axis=1)[:, None]
    margin = joint_margins(mission, looks, states[..., :3])["site_distance"]
    above = 2.0 * np.sqrt(peak / curvature)
    assert above < spacing
    assert (margin >= 0.0).sum() >= len(looks) - 1
    held = time_held(mission, looks, states)["site_distance"].duration[0]
    assert looks[-1] - looks[0] - held == pytest.approx(above, abs=1.0)


def test_margins_vanish_on_the_limits(mission: Mission) -> None:
    from scp_recon.physics import geometry

    time = np.array([mission.schedule.window_s[0]])
    track = geometry.track(mission.site, mission.rotation, time)
    limits = mission.scenario.observation
    overhead = track.position + limits.site_distance_max_m * track.normal
    margins = observation_margins(mission, time, overhead)
    assert margins["site_distance_max"][1] == pytest.approx([0.0], abs=1e-9)
    assert margins["emission_min"][1] == pytest.approx([-np.deg2rad(limits.emission_min_deg)])
    incidence = geometry.incidence(track, mission.sun_direction(time))
    assert margins["phase_min"][1] == pytest.approx(incidence - np.deg2rad(limits.phase_min_deg))
