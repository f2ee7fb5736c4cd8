"""From a home orbit to spaces of passes and back to a scenario: epochs, windows, rules, messages."""

from datetime import timedelta

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import make_schedule
from scp_recon.passes.space import Pass, at_epoch, nearest_legal, settled, spaces_of
from scp_recon.scenario.load import load_scenario, validate_scenario
from scp_recon.scenario.schema import ScheduleRules
from tests.scp_recon.passes.support import MEASURED, home_scenario
from tests.scp_recon.support import integrate

RULES = ScheduleRules(attitude_s=1800.0, heating_s=1800.0, recharge_s=1200.0)


@given(st.floats(0, 2 * np.pi), st.sampled_from(["right_handed", "left_handed"]))
def test_home_orbit_is_a_two_body_circle(phase, sense):
    scenario = home_scenario(sense=sense)
    home, gm = scenario.boundary.home, scenario.body.gm_m3_s2
    r, v = home.state(phase, gm).reshape(2, 3)
    np.testing.assert_allclose(r, 1000.0 * np.array([0, np.cos(phase), np.sin(phase)]), atol=1e-9)
    assert np.linalg.norm(v) == pytest.approx(np.sqrt(gm / 1000.0), rel=1e-12)
    momentum = np.cross(r, v)
    assert momentum[0] * (1.0 if sense == "right_handed" else -1.0) == pytest.approx(
        1000.0 * np.linalg.norm(v), rel=1e-12
    )


def test_flown_home_orbit_obeys_the_forces():
    """Held against an integration of the test's own, from one phase to another."""
    space, *_ = spaces_of(home_scenario(flown=True))
    circle, *_ = spaces_of(home_scenario())
    np.testing.assert_allclose(space.ring(0.0), circle.ring(0.0), atol=1e-6)
    apart = [np.linalg.norm(space.ring(-a)[:3] - circle.ring(-a)[:3]) for a in (0.1, 1.0, 3.0)]
    assert 0.0 < apart[0] < apart[1] < apart[2] < 200.0
    begin, end = space.ring(-1.0), space.ring(-2.0)
    times = np.linspace(0.0, 20_000.0, 4001)
    there = integrate(space.mission.forces, begin, times)
    nearest = np.argmin(np.linalg.norm(there[:, :3] - end[:3], axis=1))
    assert np.linalg.norm(there[nearest] - end) < 1.0  # a look is 5 s, 0.35 m
    with pytest.raises(InputError, match=r"boundary\.home"):
        Mission.from_scenario(
            home_scenario(flown=True, departure_deg=[0.0, 0.0], arrival_deg=[1.0, 1.0])
        )


@pytest.mark.parametrize("site", ["nightingale", "kingfisher", "osprey", "sandpiper"])
def test_packaged_designs_have_a_window_and_legal_times(site):
    scenario = load_scenario(site)
    assert scenario.site.name.casefold() == site
    assert scenario.body == load_scenario("recon_b").body
    assert spaces_of(scenario)


def test_with_feedback_burns_fill_time_before_windows():
    """Legal, planned open loop, and told to correct again in the scenario that is found."""
    scenario = load_scenario("kingfisher").replace(MEASURED)
    counts = []
    for space in spaces_of(scenario):
        begun = space.times_s
        counts.append(space.before(begun))
        assert space.mission.scenario.policy.kind == "open"
        make_schedule(begun, space.window_s, scenario.schedule)
        cycle = space.window_s[0] - begun[0] - 4800.0 - 6600.0 * counts[-1]
        assert 0.0 <= cycle < 6600.0  # no room for another
    assert counts == [1, 3]
    fixed = settled(scenario, space, Pass((4.0, 5.8), begun))
    assert fixed.policy == scenario.policy


def test_home_orbit_with_fixed_phases_is_a_boundary():
    fixed = home_scenario(departure_deg=[150.0, 150.0], arrival_deg=[0.0, 0.0])
    mission = Mission.from_scenario(fixed)
    axes = mission.scene.boundary_axes
    expected = 1000.0 * np.array([0.0, np.cos(np.deg2rad(150.0)), 0.5])
    np.testing.assert_allclose(axes.T @ mission.initial_state[:3], expected, atol=1e-9)
    moved = mission.with_initial_state(mission.initial_state * 1.01)
    assert moved.scenario.boundary.home is None


def test_states_and_home_orbit_replace_each_other():
    scenario = home_scenario()
    given_states = scenario.replace({"boundary.initial_position_m": [900.0, 0.0, 100.0]})
    assert given_states.boundary.home is None
    heavier = scenario.replace({"body.gm_m3_s2": 4.0 * scenario.body.gm_m3_s2})
    speeds = [np.linalg.norm(s.boundary.initial_velocity_m_s) for s in (scenario, heavier)]
    assert speeds[1] == pytest.approx(2.0 * speeds[0], rel=1e-12)
    home = {"radius_m": 1000.0, "normal": [1.0, 0.0, 0.0]}
    both = {"home": home, "initial_position_m": [0.0, 900.0, 0.0]}
    with pytest.raises(InputError, match=r"beside boundary.home"):
        validate_scenario({"base": "recon_b", "boundary": both})


@pytest.mark.parametrize(
    ("changes", "entry"),
    [
        ({"boundary.home.departure_deg": [10.0, 0.0]}, r"boundary\.home\.departure_deg.*\[10"),
        ({"boundary.home.arrival_deg": [0.0, 400.0]}, r"boundary\.home\.arrival_deg.*400"),
        ({"boundary.home.radius_m": -1.0}, "boundary.home.radius_m"),
        ({"boundary.home.normal": [0.0, 0.0, 0.0]}, "boundary.home.normal"),
        ({"design.departure_s": [10.0, 0.0]}, r"design\.departure_s.*\[10"),
        ({"design.burn_tines": "free"}, r"design\.burn_tines.*did you mean design\.burn_times"),
        ({"design.zzz": 4}, r"design\.zzz.*departure_s, arrival_s, burn_times$"),
        ({"boundary.home.radus_m": 4.0}, r"boundary\.home.*did you mean boundary\.home\.radius_m"),
        ({"design.burn_times": "any"}, "design.burn_times"),
        ({"boundary.final_sigma_position_m": -1.0}, r"boundary\.final_sigma_position_m"),
    ],
)
def test_bad_entries_are_named(changes, entry):
    """And no state is called missing beside a home orbit: it follows as soon as they are mended."""
    with pytest.raises(InputError, match=f"^{entry}") as told:
        home_scenario(changes)
    assert "missing" not in str(told.value)


GIVEN = {"arrival_s": [3e4, 5e4], "burn_times": "given"}


@pytest.mark.parametrize(
    ("changes", "design", "told"),
    [
        ({"boundary.home.radius_m": 500.0}, None, r"^boundary\.home\.radius_m.*_min_m, 500 m"),
        ({"burns.times_s": [8e3 * k for k in range(9)]}, None, r"^burns\.times_s: got 9 .*most 8"),
        ({"observation.incidence_max_deg": 10.0}, None, r"design.*none"),
        (
            {"schedule.recharge_s": 2e4},
            None,
            r"design\.arrival_s: .*25400 s after the one before it",
        ),
        (
            {"schedule.recharge_s": 5e3},
            None,
            r"burn 2 is left 10400 to 4540.* 10400 s after burn 1",
        ),
        ({}, {"arrival_s": [-10.0, -5.0]}, r"design\.arrival_s.*after departure.*-5 s is left"),
        ({"observation.window_s": [9e4, 92e3]}, None, r"burn 4 is left .*6600 s after the window"),
        ({"burns.times_s": [0.0, 7e3, 25e3, 6e4]}, GIVEN, r"design\.arrival_s: .*, 60000 s"),
        (
            {"burns.times_s": [0.0, 2e4, 21e3, 45e3]},
            GIVEN,
            r"burn 2 is left 20000 to 14400 s \(burn 3 at least 6600 s after burn 2\)",
        ),
        ({}, {"arrival_s": [30_000.0, 900_000.0]}, "at most 24"),
    ],
)
def test_impossible_designs_are_refused(changes, design, told):
    with pytest.raises(InputError, match=told):
        spaces_of(home_scenario(changes, design))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {"design": {"departure_s": [0.0, 9.0]}},
            r"^design\.departure_s: got 0 to 9 s; goes with b",
        ),
        ({"design": {"arrival_s": [3e4, 4e4]}}, r"^design\.arrival_s.*goes with boundary\.home"),
        ({"design": {"burn_times": "given"}}, r"^design\.burn_times.*nothing is left to design"),
        ({"burns.times_s": [0.0, 34_842.0]}, r"^burns\.times_s: got 2 burns; must be at least 3"),
        (
            {"observation.window_s": [1e3, 2e3]},
            r"burn 1 is left 0 to -3800 s \(burn 1 at least 4800 s before the window\)$",
        ),
    ],
)
def test_given_states_leave_burns_alone_to_move(changes, told):
    with pytest.raises(InputError, match=told):
        spaces_of(load_scenario().replace(changes))


def test_every_window_has_a_space_with_legal_times():
    design = {"departure_s": [-20_000.0, 30_000.0], "arrival_s": [10_000.0, 70_000.0]}
    scenario = home_scenario(design=design)
    spaces = spaces_of(scenario)
    assert len(spaces) >= 3
    for space in spaces:
        assert Mission.from_scenario(space.mission.scenario).schedule.legs
        shift = space.mission.scenario.epoch.tdb - scenario.epoch.tdb
        assert shift.total_seconds() == pytest.approx(space.begin_s, abs=1e-5)
        assert -20_000.0 <= space.begin_s <= 30_000.0
        assert 10_000.0 <= space.begin_s + space.times_s[-1] <= 70_000.0


@pytest.mark.parametrize("later_s", [0.0, 777.0])
def test_settled_pass_keeps_ring_and_window(later_s):
    span = [0.0, 2000.0]
    scenario = home_scenario(design={"departure_s": span, "arrival_s": [30_000.0, 40_000.0]})
    space, *_ = spaces_of(scenario)
    one = Pass((2.5, -0.3), (later_s, *space.times_s[1:]))
    fixed = settled(scenario, space, one)
    mission = Mission.from_scenario(fixed)
    begin = timedelta(seconds=space.begin_s + later_s)
    assert abs(fixed.epoch.tdb - scenario.epoch.tdb - begin) < timedelta(microseconds=2)
    np.testing.assert_allclose(mission.initial_state, space.ring(2.5), atol=1e-8)
    np.testing.assert_allclose(mission.final_state, space.ring(-0.3), atol=1e-8)
    window = np.array(space.window_s) - later_s
    np.testing.assert_allclose(mission.schedule.window_s, window, atol=1.0)
    assert fixed.boundary.home is None
    assert fixed.design is None


@given(
    st.lists(st.floats(0, 60_000), min_size=2, max_size=6),
    st.floats(5_000, 30_000),
    st.integers(0, 4),
)
def test_nearest_legal_times_keep_the_schedule_s_rules(wanted, opens, before):
    """The oracle is the schedule itself, which is laid out burn by burn."""
    window, m = (opens, opens + 3000.0), len(wanted)
    spans = [(0.0, 0.0), *[(0.0, 90_000.0)] * (m - 1)]
    times = nearest_legal(wanted, spans, window, min(before, m - 2), RULES)
    if times is not None:
        make_schedule(times, window, RULES)
    else:  # as many cycles do not fit before the window
        assert min(before, m - 2) * 6600.0 + 4800.0 > opens


@pytest.mark.parametrize(
    ("contacts", "expected"),
    [
        ({"every_s": 9000.0, "first_s": 500.0}, {"first_s": 8500.0}),
        ({"every_s": 9000.0, "first_s": 4000.0}, {"first_s": 3000.0}),
        ({"windows_s": [[0.0, 900.0], [1500.0, 2000.0]]}, {"windows_s": ((500.0, 1000.0),)}),
    ],
)
def test_contacts_stay_where_they_are_at_later_epochs(contacts, expected):
    given = {"navigation.contacts": contacts | {"turnaround_s": 0.0}}
    moved = at_epoch(load_scenario().replace(given), 1000.0).navigation.contacts
    assert moved is not None
    assert {entry: getattr(moved, entry) for entry in expected} == expected
