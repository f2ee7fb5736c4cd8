"""From TDB, in which scenarios are dated, to UTC, in which people are."""

from __future__ import annotations

from bisect import bisect_right
from datetime import datetime, timedelta

TT_TAI_S = 32.184
FIRST_LEAP = 10
"""Seconds of TAI over UTC since 1 January 1972, when leap seconds began."""
LEAPS = (
    *("1972-07", "1973-01", "1974-01", "1975-01", "1976-01", "1977-01", "1978-01", "1979-01"),
    *("1980-01", "1981-07", "1982-07", "1983-07", "1985-07", "1988-01", "1990-01", "1991-01"),
    *("1992-07", "1993-07", "1994-07", "1996-01", "1997-07", "1999-01", "2006-01", "2009-01"),
    *("2012-07", "2015-07", "2017-01"),
)
"""Months that began with one second more: IERS Bulletin C, up to the last one announced."""


def utc_of(tdb: datetime) -> datetime:
    """UTC, to the 2 ms by which TDB and TT differ; before 1972, to the seconds UTC then was off.

    A leap second itself is shown as the second after it.
    """
    tai = tdb - timedelta(seconds=TT_TAI_S)
    starts = [
        datetime.fromisoformat(f"{month}-01") + timedelta(seconds=FIRST_LEAP + number)
        for number, month in enumerate(LEAPS, start=1)
    ]
    return tai - timedelta(seconds=FIRST_LEAP + bisect_right(starts, tai))


def told(moment: datetime) -> str:
    """A moment to the second, as in 2020-01-21 20:32:08."""
    rounded = moment + timedelta(microseconds=500_000)
    return rounded.strftime("%Y-%m-%d %H:%M:%S")
