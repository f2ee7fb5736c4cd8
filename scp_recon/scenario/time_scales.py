"""Convert between UTC and TDB to the nanosecond: leap seconds by IERS Bulletin C, TDB - TT as in SPICE.

    TDB = UTC + (TAI - UTC) + 32.184 s + K sin E,  E = M + EB sin M,  M = M0 + M1 t,

with t in TDB seconds past J2000. The constants of the last term are those of NAIF's leap-second
kernels; the terms left out are about 30 microseconds. An instant is a whole number of nanoseconds of
TDB past J2000.
"""

from __future__ import annotations

from bisect import bisect_right
from datetime import UTC, datetime, timedelta
from math import sin

from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.errors import InputError

TT_MINUS_TAI_S = 32.184
K_S, EB, M0, M1 = 1.657e-3, 1.671e-2, 6.239996, 1.99096871e-7
"""In s, 1, rad and rad/s."""
NS = 1_000_000_000
"""Nanoseconds in a second."""
YEAR_MAX = 9998
"""Last year of a date that is converted: the calendar ends a year later."""

FIRST_TAI_MINUS_UTC_S = 10
LEAPS = (
    *((1972, 1), (1972, 7), (1973, 1), (1974, 1), (1975, 1), (1976, 1), (1977, 1), (1978, 1)),
    *((1979, 1), (1980, 1), (1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1)),
    *((1991, 1), (1992, 7), (1993, 7), (1994, 7), (1996, 1), (1997, 7), (1999, 1), (2006, 1)),
    *((2009, 1), (2012, 7), (2015, 7), (2017, 1)),
)
"""Year and month from whose first day on TAI - UTC is 10 s, 11 s, ... The last, of Bulletin C 52, holds
for all later dates; one that is announced belongs here."""


def _ns(date: datetime) -> int:
    """Nanoseconds since noon of 1 January 2000 in a date's own scale."""
    since = date - J2000_TDB
    return (since.days * 86_400 + since.seconds) * NS + since.microseconds * 1000


_BEGINS = tuple(
    _ns(datetime(year, month, 1)) + (FIRST_TAI_MINUS_UTC_S + i) * NS
    for i, (year, month) in enumerate(LEAPS)
)
"""In TAI: when each offset begins."""


def instant(epoch_tdb: datetime, seconds: float = 0.0) -> int:
    """Nanoseconds of TDB past J2000 at some seconds past an epoch in TDB."""
    return _ns(epoch_tdb) + round(seconds * NS)


def iso_tdb(when: int) -> str:
    """Calendar date in TDB, to the nanosecond."""
    seconds, fraction = divmod(when, NS)
    return f"{(J2000_TDB + timedelta(seconds=seconds)).isoformat()}.{fraction:09d}"


def iso_utc(when: int) -> str:
    """Calendar date in UTC, to the nanosecond; a leap second reads 23:59:60.

    Raises:
        InputError: before 1972, when UTC had no whole seconds.
    """
    tai = when - _tdb_minus_tai(when)
    index = bisect_right(_BEGINS, tai) - 1
    if index < 0:
        raise InputError("epoch.tdb", iso_tdb(when), "must be in 1972 or later: UTC has no seconds")
    offset = FIRST_TAI_MINUS_UTC_S + index
    if index + 1 < len(_BEGINS) and tai >= _BEGINS[index + 1] - NS:  # in the leap second itself
        return iso_tdb(tai - (offset + 1) * NS).replace(":59.", ":60.")
    return iso_tdb(tai - offset * NS)  # a date is written alike in every scale


def shown_utc(when: int) -> str:
    """UTC to the second, as in 2020-01-21 20:32:08.

    Raises:
        InputError: before 1972.
    """
    return iso_utc(when + NS // 2)[:19].replace("T", " ")


def tdb_of_utc(utc: datetime, entry: str = "UTC") -> datetime:
    """TDB, to the microsecond, of a date in UTC; a date with a time zone is converted first.

    Raises:
        InputError: naming the entry, if a date is before 1972 or after 9998.
    """
    given = utc.isoformat()
    if utc.tzinfo is not None and 1 < utc.year < YEAR_MAX + 1:
        utc = utc.astimezone(UTC).replace(tzinfo=None)
    if not LEAPS[0][0] <= utc.year <= YEAR_MAX:
        raise InputError(entry, given, f"must be in 1972 or later, and at most in {YEAR_MAX}")
    return J2000_TDB + timedelta(microseconds=round(tdb_instant(utc.isoformat(), "UTC") / 1000))


def tdb_instant(date: str, scale: str) -> int:
    """Nanoseconds of TDB past J2000 of a calendar date in UTC, TAI, TT or TDB, with any digits.

    Raises:
        ValueError: if there is no such date, or UTC is before 1972.
    """
    whole, _, fraction = date.partition(".")
    leap = whole.endswith(":60")
    day = datetime.fromisoformat(f"{whole[:-2]}59" if leap else whole)
    when = _ns(day) + leap * NS + round(float(f"0.{fraction}0") * NS)
    if scale == "TDB":
        return when
    if scale == "UTC":
        count = bisect_right([datetime(year, month, 1) for year, month in LEAPS], day)
        if not count:
            raise ValueError("must be in 1972 or later")
        when += (FIRST_TAI_MINUS_UTC_S + count - 1) * NS
    elif scale == "TT":
        when -= round(TT_MINUS_TAI_S * NS)
    return when + _tdb_minus_tai(when + round(TT_MINUS_TAI_S * NS))


def _tdb_minus_tai(when: int) -> int:
    """TDB - TAI in nanoseconds."""
    anomaly = M0 + M1 * (when / NS)
    return round((TT_MINUS_TAI_S + K_S * sin(anomaly + EB * sin(anomaly))) * NS)
