"""All lighting windows of a span: none missed, none invented, edges where they are."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from formulations.arrays import Array
from scp_recon.bodies.catalogue import DAY_S
from scp_recon.errors import InputError
from scp_recon.mission.schedule import survey
from scp_recon.mission.windows import (
    SCAN_STEP_S,
    each_window,
    moved_edges,
    scan_step_s,
)
from scp_recon.scenario.load import load_scenario
from tests.scp_recon.mission.test_schedule import independent_incidence
from tests.scp_recon.support import file_of

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
