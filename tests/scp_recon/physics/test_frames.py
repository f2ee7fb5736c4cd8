"""Frames and time scales."""

import warnings
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation as SciPyRotation

from scp_recon.errors import InputError
from scp_recon.physics.frames import Rotation, sun_north_to_j2000
from scp_recon.scenario.time_scales import (
    FIRST_TAI_MINUS_UTC_S,
    LEAPS,
    instant,
    iso_utc,
    shown_utc,
    tdb_of_utc,
)
from tests import reference
from tests.helpers import unit_vectors
from tests.reference import EPOCH_ET
from tests.scp_recon.support import mission_of

FLIGHT_S = 34_842.0

angles = st.floats(-np.pi, np.pi)
rotations = st.builds(
    Rotation,
    pole_ra=angles,
    pole_dec=st.floats(-1.5, 1.5),
    meridian=angles,
    rate=st.floats(-1e-3, 1e-3),
    acceleration=st.floats(-1e-12, 1e-12),
)
times = st.floats(-1e5, 1e5)


def test_iau_polynomial_counts_days_from_j2000_noon():
    # Two and a half days past J2000: W = 10 + 100 * 2.5 + 0.4 * 6.25 = 262.5 deg.
    rotation = Rotation.from_iau(0.0, 90.0, (10.0, 100.0, 0.4), datetime(2000, 1, 4))
    assert np.rad2deg(rotation.meridian) == pytest.approx(262.5)
    # dW/dt = 100 + 2 * 0.4 * 2.5 = 102 deg a day, d2W/dt2 = 0.8 deg a day squared.
    assert np.rad2deg(rotation.rate) * 86_400.0 == pytest.approx(102.0)
    assert np.rad2deg(rotation.acceleration) * 86_400.0**2 == pytest.approx(0.8)


@given(rotations, times)
def test_body_orientation_is_the_iau_sequence_of_rotations(rotation, t):
    w = rotation.meridian + rotation.rate * t + 0.5 * rotation.acceleration * t**2
    # R3(W) R1(90 deg - dec) R3(90 deg + ra) turns frames; its transpose turns vectors the same way.
    sequence = [np.pi / 2 + rotation.pole_ra, np.pi / 2 - rotation.pole_dec, w]
    expected = SciPyRotation.from_euler("ZXZ", sequence).as_matrix()
    np.testing.assert_allclose(rotation.body_to_j2000(t), expected, rtol=0.0, atol=1e-12)
    scaled = rotation.in_units(3600.0).body_to_j2000(t / 3600.0)
    np.testing.assert_allclose(scaled, expected, rtol=0.0, atol=1e-12)


@given(unit_vectors(), unit_vectors())
def test_sun_north_has_x_sunward_and_z_poleward(sun, pole):
    if np.linalg.norm(np.cross(sun, pole)) < 1e-3:
        return  # the frame is not defined where the Sun stands over the pole
    matrix = sun_north_to_j2000(sun, pole)
    np.testing.assert_allclose(matrix.T @ matrix, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    np.testing.assert_allclose(matrix @ [1.0, 0.0, 0.0], sun, atol=1e-12)
    # Of all directions across the Sun line, Z is the one nearest to the pole.
    assert matrix[:, 2] @ pole == pytest.approx(np.linalg.norm(np.cross(sun, pole)))


@pytest.mark.parametrize("which", ["initial_state", "final_state"])
def test_boundary_states_are_converted_from_sun_north(mission, which):
    recorded = reference.STATES_FROM_SUN_NORTH[which]
    state = getattr(mission, which)
    np.testing.assert_allclose(state[:3], recorded[:3], rtol=0.0, atol=0.05)
    np.testing.assert_allclose(state[3:], recorded[3:], rtol=0.0, atol=1e-6)
    literal = mission_of("boundary.frame=j2000")
    np.testing.assert_array_equal(getattr(literal, which), reference.PRINTED_STATES[which])


def test_sun_direction_is_that_of_the_ephemeris(mission):
    hourly = np.array(reference.SUN_DIRECTIONS)
    times, suns = hourly[:, 0] - EPOCH_ET, hourly[:, 1:]
    # Table of parameters of Echigo et al.
    assert np.round(mission.sun_direction(0.0), 4).tolist() == [-0.9992, 0.0323, 0.0225]
    assert times[0] < 0.0
    assert times[-1] > FLIGHT_S
    error = np.linalg.norm(np.cross(mission.sun_direction(times), suns), axis=1)
    assert error.max() < 5e-5


DATES = st.datetimes(datetime(1972, 1, 2), datetime(2040, 1, 1))
MODEL_S = 5e-5
"""What the term of TDB - TT leaves out."""


def test_leap_seconds_are_those_of_the_iers():
    erfa = pytest.importorskip("erfa")
    table = erfa.leap_seconds.get()
    known = [(int(row["year"]), int(row["month"])) for row in table if row["year"] >= 1972]
    assert known == list(LEAPS)
    assert table["tai_utc"][-1] == FIRST_TAI_MINUS_UTC_S + len(LEAPS) - 1


@pytest.mark.slow
@given(date=DATES)
def test_utc_is_astropys(date):
    time = pytest.importorskip("astropy.time")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the future is dubious
        expected = time.Time(date, scale="tdb").utc
        found = time.Time(iso_utc(instant(date)), scale="utc")
        assert abs((found - expected).sec) < MODEL_S


def test_leap_second_has_its_own_name():
    before = tdb_of_utc(datetime(2016, 12, 31, 23, 59, 59))
    after = tdb_of_utc(datetime(2017, 1, 1))
    assert after - before == timedelta(seconds=2)
    names = [iso_utc(instant(before, seconds) + 500)[:21] for seconds in (0.0, 1.0, 2.0)]
    assert names == ["2016-12-31T23:59:59.0", "2016-12-31T23:59:60.0", "2017-01-01T00:00:00.0"]


def test_zones_become_utc_from_1972_on():
    given = datetime(2020, 1, 1, 2, tzinfo=timezone(timedelta(hours=2)))
    assert tdb_of_utc(given) == tdb_of_utc(datetime(2020, 1, 1, tzinfo=UTC))
    with pytest.raises(InputError, match="1972"):
        iso_utc(instant(datetime(1971, 12, 31)))
    with pytest.raises(InputError, match="1972"):
        tdb_of_utc(datetime(1971, 12, 31))


@pytest.mark.parametrize(
    ("tdb", "utc"),
    [
        ("2000-01-01T12:00:00", "2000-01-01 11:58:56"),  # Explanatory Supplement: 64.184 s
        ("2020-01-21T20:33:17.184", "2020-01-21 20:32:08"),
        ("2017-01-01T00:01:08.000", "2016-12-31 23:59:60"),  # the leap second
        ("2017-01-01T00:01:09.184", "2017-01-01 00:00:00"),
        ("2016-12-31T23:59:59.184", "2016-12-31 23:58:51"),
        ("1972-01-01T00:00:42.184", "1972-01-01 00:00:00"),
    ],
)
def test_utc_is_shown_to_the_nearest_second(tdb, utc):
    assert shown_utc(instant(datetime.fromisoformat(tdb))) == utc
