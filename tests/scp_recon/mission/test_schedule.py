"""The window, timing rules and legal burns of a flight, and all lighting windows of a span."""

import itertools
import re
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation as SciPyRotation

from formulations.arrays import Array
from scp_recon.bodies.catalogue import DAY_S
from scp_recon.errors import InputError
from scp_recon.mission.schedule import (
    Mode,
    Schedule,
    legal_additions,
    legal_burns,
    legal_shifts,
    make_schedule,
    survey,
)
from scp_recon.mission.windows import SCAN_STEP_S, each_window, moved_edges, scan_step_s
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario, ScheduleRules
from tests.scp_recon.support import file_of, mission_of, refusal

WINDOW = (13_140.0, 16_537.0)
RULES = ScheduleRules(attitude_s=1800.0, heating_s=1800.0, recharge_s=1200.0)
FIRING = (0.0, 8000.0, 25_000.0, 34_842.0)
RULE = "sun-pointing leg lasts at least one slew and one recharge"


def independent_incidence(scenario: Scenario, times: Array) -> Array:
    """Degrees between the site's normal and the Sun, from the scenario's numbers alone."""
    body, sun = scenario.body, scenario.sun
    days = (times + (scenario.epoch.tdb - scenario.epoch.tdb.replace(2000, 1, 1, 12, 0, 0, 0))
            .total_seconds()) / 86_400.0  # fmt: skip
    w = body.prime_meridian_deg + body.prime_meridian_rate_deg_day * days
    w += body.prime_meridian_acceleration_deg_day2 * days**2
    angles = np.stack(
        [np.full_like(w, 90.0 + body.pole_ra_deg), np.full_like(w, 90.0 - body.pole_dec_deg), w], 1
    )
    normal = SciPyRotation.from_euler("ZXZ", angles, degrees=True).apply(scenario.site.normal_body)
    to_sun = -np.array(sun.body_position_km) - np.outer(times, sun.body_velocity_km_s)
    cosine = np.sum(normal * to_sun, axis=1)
    cosine /= np.linalg.norm(normal, axis=1) * np.linalg.norm(to_sun, axis=1)
    return np.rad2deg(np.arccos(cosine))


def test_window_edges_are_at_the_incidence_limit(mission):
    first, last = mission.schedule.window_s
    assert first == pytest.approx(13_140.0, abs=1.0)
    assert last - first == pytest.approx(3397.3, abs=0.5)
    times = np.linspace(first, last, 400)
    incidence = independent_incidence(mission.scenario, times)
    np.testing.assert_allclose(incidence[[0, -1]], 60.0, rtol=0.0, atol=1e-5)
    assert np.all(incidence[1:-1] < 60.0)
    outside = np.array([first - 1.0, last + 1.0])
    assert np.all(independent_incidence(mission.scenario, outside) > 60.0)
    # The flight begins in the light of the rotation before; that window is not whole.
    before = np.arange(0.0, first - 1.0, 5.0)
    lit = independent_incidence(mission.scenario, before) <= 60.0
    assert not np.any(lit[1:] & ~lit[:-1])


def test_local_solar_time_may_close_the_window_instead():
    whole, short = mission_of(), mission_of("observation.local_solar_time_max_h=11.0")
    assert short.schedule.window_s[0] == whole.schedule.window_s[0]
    assert short.schedule.window_s[1] < whole.schedule.window_s[1] - 60.0
    late = mission_of("observation.local_solar_time_min_h=10.0")
    assert late.schedule.window_s[0] > whole.schedule.window_s[0] + 60.0
    assert late.schedule.window_s[1] == pytest.approx(whole.schedule.window_s[1], abs=1e-4)


@pytest.mark.parametrize(
    "window", [(-10.0, 1000.0), (30_000.0, 40_000.0), (15_000.0, 14_000.0), (9e3, 9e3), (0.0, 9e3)]
)
def test_a_window_outside_the_flight_is_refused(window):
    error = refusal(mission_of, f"observation.window_s={list(window)}")
    error = error
    assert error.entry == "observation.window_s"
    assert all(f"{edge:g}" in error.given for edge in window)
    assert "34842" in error.allowed


def is_allowed(times: tuple[float, ...], window: tuple[float, float]) -> tuple[bool, float]:
    """Whether the rules of Echigo et al., section V.A, hold, and by how many seconds."""
    busy = [(0.0, 0.0), (window[0] - 1800.0, window[1]), *((t - 3600.0, t) for t in times[1:])]
    busy.sort()
    gaps = [after[0] - before[1] for before, after in itertools.pairwise(busy)]
    return min(gaps) >= 3000.0, abs(min(gaps) - 3000.0)


ascending = st.lists(st.floats(1.0, 60_000.0), min_size=1, max_size=5, unique=True).map(sorted)


@given(times=ascending, window=st.tuples(st.floats(0.01, 0.98), st.floats(0.01, 0.98)))
@example(times=list(FIRING[1:]), window=(WINDOW[0] / FIRING[-1], WINDOW[1] / FIRING[-1]))
@example(times=[30_000.0], window=(0.3, 0.4))
@example(times=[8000.0, 30_000.0], window=(0.5, 0.6))
def test_firing_times_are_accepted_iff_legal(times, window):
    firing = (0.0, *times)
    first, last = sorted(edge * firing[-1] for edge in window)
    assume(first < last)
    allowed, clear_by = is_allowed(firing, (first, last))
    assume(clear_by > 1e-3)
    if allowed:
        assert_is_sound(make_schedule(firing, (first, last), RULES), firing, (first, last))
    else:
        with pytest.raises(InputError, match=RULE):
            make_schedule(firing, (first, last), RULES)


def assert_is_sound(
    schedule: Schedule, firing: tuple[float, ...], window: tuple[float, float]
) -> None:
    """The paper's rules, leg by leg."""
    legs = schedule.legs
    assert legs[0].start_s == 0.0
    assert legs[-1].end_s == firing[-1]
    assert all(a.end_s == b.start_s for a, b in itertools.pairwise(legs))
    lasting = {mode: [leg for leg in legs if leg.mode is mode] for mode in Mode}
    assert [leg.end_s for leg in lasting[Mode.DELTA_V]] == list(firing[1:])
    assert all(leg.end_s - leg.start_s == 3600.0 for leg in lasting[Mode.DELTA_V])
    (observation,) = lasting[Mode.OBSERVATION]
    assert (observation.start_s, observation.end_s) == (window[0] - 1800.0, window[1])
    assert all(leg.end_s - leg.start_s >= 3000.0 - 1e-6 for leg in lasting[Mode.SUN_POINTING])


def moved(burn: int, time: float) -> tuple[float, ...]:
    return (*FIRING[:burn], time, *FIRING[burn + 1 :])


def test_what_the_message_offers_is_allowed():
    with pytest.raises(InputError, match=r"between 6600 s and 8340 s"):
        make_schedule(moved(1, 6000.0), WINDOW, RULES)
    with pytest.raises(InputError, match=r"from 34900 s on"):
        make_schedule(moved(2, 28_300.0), WINDOW, RULES)
    make_schedule((0.0, 8000.0, 28_300.0, 34_900.0), WINDOW, RULES)
    # The first burn is at zero in every scenario: it cannot be what the user has to change.
    assert message("observation.window_s=[1000.0, 2000.0]").startswith("observation.window_s: ")


rules_of = st.builds(
    ScheduleRules, **dict.fromkeys(("attitude_s", "heating_s", "recharge_s"), st.floats(0, 3000))
)


def by_linear_program(
    window: tuple[float, float], duration: float, before: int, rules: ScheduleRules, count: int
) -> list[tuple[float, float]] | None:
    """Least and largest time of each burn under the rules of section V.A, all burns variables."""
    sun = rules.attitude_s + rules.recharge_s
    cycle = sun + rules.attitude_s + rules.heating_s
    t = np.eye(count)
    rows = [t[i] - t[i + 1] for i in range(count - 1) if i != before]
    rows += [t[before], -t[before + 1]]
    bounds = [-cycle] * (count - 2) + [window[0] - rules.attitude_s - sun, -window[1] - cycle]
    whole = (t[-1] - t[0])[None]
    found = []
    for cost in t:
        ends = [
            linprog(sign * cost, np.array(rows), bounds, whole, [duration], bounds=(None, None))
            for sign in (1.0, -1.0)
        ]
        if any(end.status != 0 for end in ends):
            return None
        found.append((sum(cost * ends[0].x), sum(cost * ends[1].x)))
    return found


@given(
    window=st.tuples(st.floats(0.0, 4e4), st.floats(10.0, 2e4)),
    duration=st.floats(1e3, 1e5),
    before=st.integers(0, 3),
    after=st.integers(1, 3),
    rules=rules_of,
)
def test_intervals_are_those_of_a_linear_program(window, duration, before, after, rules):
    edges = window[0], window[0] + window[1]
    found = legal_burns(edges, duration, before, after, rules)
    early, late = found[0]
    assume(abs(early - late) > 1e-3)
    expected = by_linear_program(edges, duration, before, rules, before + after + 1)
    if early > late:
        assert expected is None
        return
    np.testing.assert_allclose(found, expected, atol=1e-4)


@given(
    gaps=st.lists(st.floats(6600.0, 20_000.0), min_size=1, max_size=4),
    window=st.tuples(st.floats(-1e5, 1e5), st.floats(100.0, 8000.0)),
    share=st.floats(0.001, 0.999),
)
def test_shifts_are_legal_within_their_interval_only(gaps, window, share):
    times = (0.0, *np.cumsum(gaps).tolist())
    edges = window[0], window[0] + window[1]
    shifts = legal_shifts(edges, times, RULES)
    assert len(shifts) == sum(gap >= window[1] + 11_400.0 for gap in gaps)
    for _, (low, high) in shifts:
        inside = low + share * (high - low)
        make_schedule(times, (edges[0] - inside, edges[1] - inside), RULES)
        for outside in (low - 1.0, high + 1.0):
            with pytest.raises(InputError):
                make_schedule(times, (edges[0] - outside, edges[1] - outside), RULES)


@given(
    gaps=st.lists(st.floats(6600.0, 30_000.0), min_size=1, max_size=4),
    length=st.floats(100.0, 8000.0),
    share=st.floats(0.0, 1.0),
    added=st.floats(0.0, 1.0),
)
def test_additional_burns_are_legal_in_their_spans(gaps, length, share, added):
    """The oracle is the schedule itself, with the burn in it."""
    gaps[0] += length + 11_400.0 - 6600.0
    times = (0.0, *np.cumsum(gaps).tolist())
    opens = 4800.0 + share * (gaps[0] - length - 11_400.0)
    window = opens, opens + length
    make_schedule(times, window, RULES)
    time = added * times[-1]
    spans = legal_additions(times, window, RULES)
    assume(all(abs(time - edge) > 1.0 for span in spans for edge in span))
    assume(min(abs(time - other) for other in times) > 1.0)
    if any(first < time < last for first, last in spans):
        make_schedule(tuple(sorted((*times, time))), window, RULES)
    else:
        with pytest.raises(InputError):
            make_schedule(tuple(sorted((*times, time))), window, RULES)


def message(*overrides: str) -> str:
    error = refusal(mission_of, *overrides)
    return str(error)


@pytest.mark.parametrize(
    ("epoch", "fault"),
    [
        ("2020-01-21T20:33:17.184", "must contain a whole window"),
        ("2020-01-21T23:33:17.184", "is broken"),
    ],
)
def test_following_the_message_makes_the_flight_legal(epoch, fault):
    """By the shift that is told, where there is no window in the flight or it is too early."""
    burns = "burns.times_s=[0.0, 15500.0]"
    said = message(burns, f"epoch.tdb={epoch}")
    assert fault in said
    shifts = re.findall(r"epoch\.tdb moved by ([+-]\d+) to ([+-]\d+) s", said)
    low, high = min(shifts, key=lambda pair: abs(int(pair[0])))
    moved = np.datetime64(epoch) + np.timedelta64((int(low) + int(high)) // 2, "s")
    mission_of(burns, f"epoch.tdb={moved}")


ALWAYS = (
    "observation.incidence_max_deg=180",
    *("observation.local_solar_time_min_h=0", "observation.local_solar_time_max_h=24"),
)


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (
            ["burns.times_s=[0.0, 8000.0, 12000.0]"],
            ["13140.2 to 16537.5 s: no gap between burns is long enough", "14797 s"],
        ),
        (ALWAYS, ["give observation.window_s"]),
        (["observation.incidence_max_deg=10"], ["10 deg", "34842", "least incidence is 48.9 deg"]),
    ],
)
def test_windows_near_a_windowless_flight_are_listed(overrides, told):
    said = message(*overrides)
    assert said.startswith("observation: got incidence at most")
    assert all(words in said for words in told)


SPAN = (-5000.0, 60_000.0)


def waves(*terms: tuple[float, float, float]) -> Callable[[Array], Array]:
    """A sum of cosines: size, period in s, phase."""
    return lambda t: sum(
        (a * np.cos(2.0 * np.pi * t / period + phase) for a, period, phase in terms),
        np.full_like(t, -0.3, dtype=float),
    )


wave = st.tuples(st.floats(0.05, 1.0), st.floats(3000.0, 40_000.0), st.floats(0.0, 6.3))


@given(terms=st.lists(wave, min_size=1, max_size=3))
def test_windows_are_those_of_dense_sampling(terms):
    slack = waves(*terms)
    dense = np.linspace(*SPAN, 40_001)
    lit = slack(dense) >= 0.0
    found = list(each_window(slack, SPAN, SCAN_STEP_S))
    covered = np.zeros_like(lit)
    for first, last in found:
        covered |= (dense >= first) & (dense <= last)
    clear = np.abs(slack(dense)) > 1e-7
    np.testing.assert_array_equal(covered[clear], lit[clear])
    edges = [edge for window in found for edge in window if edge not in SPAN]
    np.testing.assert_allclose(slack(np.array(edges)), 0.0, atol=1e-7)


@given(at=st.floats(100.0, 900.0), width=st.floats(1e-3, 30.0))
@example(at=100.0, width=1.0)
def test_a_short_window_between_limits_is_found(at, width):
    """One limit begins to hold shortly before another ceases to: a corner, not a smooth peak."""

    def slack(t: Array) -> Array:
        return np.minimum(0.01 * (t - at), 0.03 * (at + width - t))

    (window,) = each_window(slack, (0.0, 1000.0), SCAN_STEP_S)
    assert window == pytest.approx((at, at + width), abs=1e-5)


def test_moved_edges_are_those_of_each_flights_window():
    """A phase of a wave a flight; a flight without such an edge stays within half a window."""
    phases = np.array([-0.2, 0.0, 0.15])

    def slack(t: Array) -> Array:
        return np.cos(2.0 * np.pi * t / 10_000.0 + phases) - 0.3

    (window,) = each_window(waves((1.0, 10_000.0, 0.0)), (5000.0, 15_000.0), SCAN_STEP_S)
    moved = moved_edges(slack, window)
    expected = np.array(window)[:, None] - phases * 10_000.0 / (2.0 * np.pi)
    np.testing.assert_allclose(moved, expected, atol=1e-6)
    never = moved_edges(lambda t: slack(t) - 1.0, window)
    half = 0.5 * (window[1] - window[0])
    assert np.abs(never - np.array(window)[:, None]).max() <= half + 1e-6


def test_a_body_turning_too_often_is_refused():
    assert scan_step_s(2.0 * np.pi / 15_466.0, (0.0, 34_842.0)) == SCAN_STEP_S
    assert scan_step_s(0.0, (0.0, 34_842.0)) == SCAN_STEP_S
    assert scan_step_s(-2.0 * np.pi / 1000.0, (0.0, 34_842.0)) == pytest.approx(2.0)
    with pytest.raises(InputError, match="rotation in 1 s"):
        scan_step_s(2.0 * np.pi, (0.0, 34_842.0))


def test_survey_windows_are_exactly_the_lit_times(mission):
    span = 10.0 * DAY_S, 11.0 * DAY_S
    found = survey(mission.scenario, span)
    times = np.linspace(*span, 20_000)
    incidence = np.rad2deg(found.lighting.incidence(times))
    inside = np.zeros(len(times), dtype=bool)
    for w in found.windows:
        here = (times >= w.edges_s[0]) & (times <= w.edges_s[1])
        assert np.rad2deg(w.least_incidence_rad) == pytest.approx(incidence[here].min(), abs=1e-4)
        assert w.least_incidence_rad <= np.deg2rad(incidence[here].min())
        inside |= here
    complete = (times > found.windows[0].edges_s[0]) & (times < found.windows[-1].edges_s[1])
    assert np.all(incidence[inside] <= 60.0)
    assert np.all(incidence[complete & ~inside] > 60.0)
    # The Sun has moved on: what a straight line would give differs by less than the orbit curves.
    straight = independent_incidence(mission.scenario, times)
    assert 0.05 < np.abs(straight - incidence).max() < 3.0


def test_a_body_falling_into_the_sun_is_refused():
    falling = file_of(load_scenario(), {"sun.body_velocity_km_s": [0.0, 0.0, 0.0]}, name="Stone")
    with pytest.raises(InputError, match="Sun's centre"):
        survey(falling, (0.0, 100.0 * DAY_S))
