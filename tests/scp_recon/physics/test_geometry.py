"""Observation angles on cases whose answer is known, and against SPICE."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scp_recon.bodies.surface import direction_of
from scp_recon.physics import geometry
from scp_recon.physics.frames import Rotation
from scp_recon.physics.geometry import Site, SiteTrack
from tests import reference

# Spinning about Z with the prime meridian on X at t = 0, a quarter of a turn in 100 s.
UPRIGHT = Rotation(
    pole_ra=-np.pi / 2, pole_dec=np.pi / 2, meridian=0.0, rate=np.pi / 200, acceleration=0.0
)
EQUATOR = Site(np.array([250.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
HERE = SiteTrack(np.array([[250.0, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0]]))

components = st.floats(-1e3, 1e3)
vectors = st.tuples(components, components, components).map(np.array)


def test_site_turns_east_and_incidence_counts_from_zenith():
    track = geometry.track(EQUATOR, UPRIGHT, np.array([0.0, 100.0, 200.0]))
    expected = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    np.testing.assert_allclose(track.normal, expected, atol=1e-15)
    np.testing.assert_allclose(track.position, 250.0 * np.array(expected), atol=1e-12)
    for degrees in (0.0, 60.0, 120.0):  # of the Sun from the zenith
        sun = np.array([np.cos(np.deg2rad(degrees)), 0.0, np.sin(np.deg2rad(degrees))])
        assert np.rad2deg(geometry.incidence(HERE, sun)[0]) == pytest.approx(degrees)


@pytest.mark.parametrize(
    ("offset", "range_m", "emission_deg", "phase_deg"),
    [
        ([600.0, 0.0, 0.0], 600.0, 0.0, 90.0),  # overhead, the Sun on the horizon
        ([0.0, 600.0, 0.0], 600.0, 90.0, 0.0),  # on the horizon, towards the Sun
        ([300.0, 300.0, 0.0], 300.0 * np.sqrt(2.0), 45.0, 45.0),
        ([300.0, -300.0, 0.0], 300.0 * np.sqrt(2.0), 45.0, 135.0),
        ([-100.0, 0.0, 0.0], 100.0, 180.0, 90.0),  # below the ground
        ([1.0, 0.0, np.sqrt(3.0)], 2.0, 60.0, 90.0),
    ],
)
def test_range_emission_and_phase_of_known_positions(offset, range_m, emission_deg, phase_deg):
    position = HERE.position + np.array([offset])
    sun = np.array([[0.0, 1.0, 0.0]])
    assert geometry.distance(position, HERE)[0] == pytest.approx(range_m)
    assert np.rad2deg(geometry.emission(position, HERE)[0]) == pytest.approx(emission_deg)
    assert np.rad2deg(geometry.phase(position, HERE, sun)[0]) == pytest.approx(phase_deg)


@pytest.mark.parametrize("tiny", [1e-3, 1e-6, 1e-9, 1e-12])
def test_angle_is_accurate_near_zero_and_pi(tiny):
    # The arc cosine of the dot product would be wrong by 1e-8 here, and give zero at 1e-9.
    a, b = np.array([1.0, 0.0, 0.0]), np.array([np.cos(tiny), np.sin(tiny), 0.0])
    assert geometry.angle(a, b) == pytest.approx(tiny, rel=1e-9)
    assert np.pi - geometry.angle(a, -b) == pytest.approx(tiny, abs=1e-15, rel=1e-9)


@given(
    longitude=st.floats(-178.0, 178.0),
    latitude=st.floats(-86.0, 86.0),
    sun_latitude=st.floats(-86.0, 86.0),
    hours=st.floats(-11.9, 11.9),
    time=st.floats(0.0, 4e4),
    meridian=st.floats(-3.0, 3.0),
)
def test_local_solar_noon_has_sun_over_the_meridian(
    longitude, latitude, sun_latitude, hours, time, meridian
):
    rotation = Rotation(1.2, -0.8, meridian, 4e-4, 0.0)
    normal = direction_of(latitude, longitude)
    # `hours` past noon the Sun stands that many twenty-fourths of a turn west of the site.
    over = direction_of(sun_latitude, longitude - 15.0 * hours)
    sun = rotation.body_to_j2000(time) @ over
    hour = geometry.local_solar_time(Site(250.0 * normal, normal), rotation, sun, time)
    assert hour == pytest.approx(12.0 + hours, abs=1e-9)


def test_nightingale_is_where_and_as_recorded(mission):
    site = mission.site
    np.testing.assert_array_equal(site.position_body, reference.SITE_BODY_M)
    x, y, z = site.position_body
    latitude, longitude = np.arcsin(z / np.linalg.norm(site.position_body)), np.arctan2(y, x)
    expected = [reference.SITE_LATITUDE_DEG, reference.SITE_LONGITUDE_DEG]
    np.testing.assert_allclose(np.rad2deg([latitude, longitude]), expected, atol=0.01)
    printed = np.array(reference.PRINTED_SITE_NORMAL)
    np.testing.assert_allclose(site.normal_body, printed / np.linalg.norm(printed), atol=1e-15)
