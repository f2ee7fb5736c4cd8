"""The grid, the units, and the nondimensional problem that stands for the scenario."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from formulations.problem.execution_errors import ComponentwiseErrors
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import make_grid
from scp_recon.physics import geometry
from tests.helpers import unit_vectors
from tests.scp_recon.support import mission_of, sigma_of


@given(
    fixed=st.lists(st.floats(0.0, 1e5), min_size=2, max_size=8, unique=True),
    step=st.floats(1.0, 5e4),
)
def test_grid_holds_fixed_times_within_the_step(fixed, step):
    assume(np.diff(np.sort(fixed)).min() > 1e-3)
    assume(np.ptp(fixed) / step < 1e4)
    grid = make_grid(tuple(fixed), step)
    spacing = np.diff(grid)
    assert np.all(spacing > 0.0)
    assert spacing.max() <= step * (1.0 + 1e-8)
    assert set(fixed) <= set(grid.tolist())
    assert grid[0] == min(fixed)
    assert grid[-1] == max(fixed)
    for length in np.diff(np.sort(fixed)):
        arcs = len(make_grid((0.0, length), step)) - 1
        assert arcs == 1 or length / (arcs - 1) > step * (1.0 - 1e-8)


def test_burns_and_window_are_nodes_of_any_grid(mission):
    assert len(mission.times_s) - 1 == 153  # the grid of the independent prototype
    for one in (mission, mission_of("grid.step_max_s=50")):
        times, (first, last) = one.times_s, one.schedule.window_s
        assert np.diff(times).max() <= one.scenario.grid.step_max_s
        assert (first, last) == mission.schedule.window_s
        np.testing.assert_array_equal(times[one.burn_nodes], one.scenario.burns.times_s)
        window = times[one.window_nodes]
        assert (window[0], window[-1]) == (first, last)
        np.testing.assert_array_equal(window, times[(times >= first) & (times <= last)])


def test_problem_is_the_nondimensional_scenario(mission):
    problem, units, scenario = mission.problem, mission.units, mission.scenario
    assert mission.forces.in_units(units.length_m, units.time_s).gm == pytest.approx(1.0)
    assert np.linalg.norm(problem.initial_state[:3]) == pytest.approx(1.0)
    assert units.speed_m_s == pytest.approx(units.length_m / units.time_s)
    np.testing.assert_allclose(problem.initial_state * units.state, mission.initial_state)
    np.testing.assert_allclose(problem.final_state * units.state, mission.final_state)
    assert problem.dv_max * units.speed_m_s == pytest.approx(scenario.burns.dv_max_m_s)
    assert np.rad2deg(problem.dv_cone) == pytest.approx(23.3)
    assert problem.execution_errors == ComponentwiseErrors(0.08)
    np.testing.assert_allclose(problem.sun, mission.sun_direction(scenario.burns.times_s))
    durations = mission.flow.durations * units.time_s
    np.testing.assert_allclose(durations, np.diff(mission.times_s), rtol=1e-12)
    # Sigma_t0 = 1e-4 diag(x0 o x0), x0 in J2000.
    factor, x0 = problem.initial_factor * units.state[:, None], mission.initial_state
    np.testing.assert_allclose(factor @ factor.T, 1e-4 * np.diag(x0 * x0), rtol=1e-12)


def test_joint_risk_is_split_by_boole(mission, fully_limited):
    two_sided = 1.0 - 0.30 / 2
    split = {
        "safety_radius": 0.70,
        "site_distance_min": two_sided,
        "site_distance_max": two_sided,
        "emission_min": two_sided,
        "emission_max": two_sided,
        "phase_min": 0.70,  # the paper gives the phase no upper limit
        "battery_observation": 0.70,
    }
    both_phases = dict.fromkeys(("phase_min", "phase_max"), two_sided)
    for one, expected in ((mission, split), (fully_limited, split | both_phases)):
        found = {c.name: c.probability for c in one.problem.constraints}
        assert found == pytest.approx(expected)


@pytest.fixture(scope="module")
def fully_limited() -> Mission:
    return mission_of("observation.phase_max_deg=80")


@given(direction=unit_vectors(), away_m=st.floats(300.0, 1000.0), index=st.integers(0, 15))
def test_problem_constraints_are_the_geometric_limits(direction, away_m, index, fully_limited):
    """The regions' signed distances have the signs of the angles' and the range's margins."""
    m, offset = fully_limited, away_m * direction
    node = m.window_nodes[index]
    time = m.times_s[[node]]
    site, sun = geometry.track(m.site, m.rotation, time), m.sun_direction(time)
    position = site.position + offset
    emission = np.rad2deg(geometry.emission(position, site)[0])
    phase = np.rad2deg(geometry.phase(position, site, sun)[0])
    site_range = np.linalg.norm(offset)
    margins = {
        "safety_radius": np.linalg.norm(position) - 500.0,
        "site_distance_min": site_range - 500.0,
        "site_distance_max": 740.0 - site_range,
        "emission_min": emission - 20.0,
        "emission_max": 45.0 - emission,
        "phase_min": phase - 10.0,
        "phase_max": 80.0 - phase,
        "battery_observation": phase - 18.2,
    }
    mean = np.full((len(m.times_s), 6), np.nan)
    mean[:, :3] = position / m.units.length_m
    constraints = {one.name: one for one in m.problem.constraints}
    for name, margin in margins.items():
        assume(abs(margin) > 1e-6)
        c = constraints[name]
        ours = c.margin(mean)[np.flatnonzero(c.nodes == node)[0]] * m.units.length_m
        assert np.sign(ours) == np.sign(margin), name
        if name in ("safety_radius", "site_distance_min", "site_distance_max"):
            assert ours == pytest.approx(margin)
        else:
            # Distance to the cone's surface along the shortest way: range times the sine.
            assert ours == pytest.approx(site_range * np.sin(np.deg2rad(margin)), abs=1e-6)


def test_polytopes_are_those_chosen():
    for ball, cone, ball_facets, cone_facets in (
        ("paper", "paper", 24, 4),
        ("tangent", "12", None, 12),
        ("40", "paper", 40, 4),
    ):
        polytopes = mission_of(f"polytopes.ball={ball}", f"polytopes.cone={cone}").polytopes
        assert (polytopes.ball and len(polytopes.ball.normals)) == ball_facets
        assert polytopes.cone_facets == cone_facets


@pytest.mark.parametrize("frame", ["sun_north", "j2000"])
def test_another_initial_state_is_in_the_scenario(frame):
    mission = mission_of(f'boundary.frame="{frame}"')
    state = mission.initial_state * np.array([1.01, 0.99, 1.02, 0.95, 1.1, 0.9])
    moved = mission.with_initial_state(state)
    again = Mission.from_scenario(moved.scenario)
    assert moved.initial_state == pytest.approx(state, rel=1e-15)
    assert again.initial_state == pytest.approx(state, rel=1e-12)
    assert sigma_of(moved) == pytest.approx(sigma_of(again), rel=1e-12)
    assert np.array_equal(moved.final_state, mission.final_state)
    assert moved.units == mission.units != again.units
    assert moved.problem.initial_state * moved.units.state == pytest.approx(state, rel=1e-12)
