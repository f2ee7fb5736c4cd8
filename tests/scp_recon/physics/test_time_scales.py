"""UTC and TDB, against astropy's leap seconds and relativity."""

from __future__ import annotations

import warnings
from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scp_recon.errors import InputError
from scp_recon.physics.time_scales import (
    FIRST_TAI_MINUS_UTC_S,
    LEAPS,
    instant,
    iso_tdb,
    iso_utc,
    shown_utc,
    tdb_of_utc,
)

DATES = st.datetimes(datetime(1972, 1, 2), datetime(2040, 1, 1))
MODEL_S = 5e-5
"""What the term of TDB - TT leaves out."""


def test_leap_seconds_are_those_of_the_iers() -> None:
    erfa = pytest.importorskip("erfa")
    table = erfa.leap_seconds.get()
    known = [(int(row["year"]), int(row["month"])) for row in table if row["year"] >= 1972]
    assert known == list(LEAPS)
    assert table["tai_utc"][-1] == FIRST_TAI_MINUS_UTC_S + len(LEAPS) - 1


@given(date=DATES)
def test_utc_is_astropys(date: datetime) -> None:
    time = pytest.importorskip("astropy.time")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the future is dubious
        expected = time.Time(date, scale="tdb").utc
        found = time.Time(iso_utc(instant(date)), scale="utc")
        assert abs((found - expected).sec) < MODEL_S


@given(date=DATES)
def test_there_and_back_is_the_same(date: datetime) -> None:
    said = iso_utc(instant(tdb_of_utc(date)))
    # Rounded down from the end of a leap second it is in it, where a datetime knows no 60.
    found = datetime.fromisoformat(said[:26].replace(":60.", ":59."))
    assert abs(found - date) <= timedelta(microseconds=1)


# Two weeks after UTC begins, so that what is earlier has a UTC too.
@given(date=st.datetimes(datetime(1972, 1, 14), datetime(2040, 1, 1)), seconds=st.floats(-1e6, 1e6))
def test_later_is_later(date: datetime, seconds: float) -> None:
    later = instant(date, seconds)
    assert (later > instant(date)) == (seconds > 0.5e-9)
    assert iso_tdb(later) <= iso_tdb(later + 1)
    assert iso_utc(later) <= iso_utc(later + 1)


def test_a_leap_second_has_a_name_of_its_own() -> None:
    before = tdb_of_utc(datetime(2016, 12, 31, 23, 59, 59))
    after = tdb_of_utc(datetime(2017, 1, 1))
    assert after - before == timedelta(seconds=2)
    names = [iso_utc(instant(before, seconds) + 500)[:21] for seconds in (0.0, 1.0, 2.0)]
    assert names == ["2016-12-31T23:59:59.0", "2016-12-31T23:59:60.0", "2017-01-01T00:00:00.0"]


def test_a_zone_is_brought_to_utc() -> None:
    zone = timezone(timedelta(hours=2))
    given = datetime(2020, 1, 1, 2, tzinfo=zone)
    assert tdb_of_utc(given) == tdb_of_utc(datetime(2020, 1, 1, tzinfo=UTC))


def test_before_1972_there_is_no_utc_of_whole_seconds() -> None:
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
def test_utc_is_shown_to_the_nearest_second(tdb: str, utc: str) -> None:
    assert shown_utc(instant(datetime.fromisoformat(tdb))) == utc
