"""Trajectories and bodies from other tools' files: SPICE kernels, CCSDS OEM, tables.

What is read is held to J2000 axes about the body that was asked for: another frame or centre is
refused.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import numpy.typing as npt

from scp_recon.draft.flown import Tables, Track
from scp_recon.draft.text import Entry
from scp_recon.environment.catalogue import PackagedBody
from scp_recon.environment.kernels import (
    number_of,
    read_gm,
    read_heliocentric,
    read_pck,
    read_states,
)
from scp_recon.errors import InputError, needing
from scp_recon.exchange.ccsds import plain_name
from scp_recon.exchange.track_doubts import jump_doubts, late_doubts
from scp_recon.physics.frames import DAY_S, J2000_TDB
from scp_recon.planning.state_table import read_table

Array = npt.NDArray[np.float64]

SPICE, OEM, CSV = "--from-spice", "--from-oem", "--from-csv"
STEP_S, STATES_MAX = 30.0, 100_000
"""Between states that are read from kernels."""
FRAMES = ("EME2000", "J2000", "ICRF", "GCRF")
"""What CCSDS calls J2000 axes, or what is within 0.02 arcseconds of them."""
SCALES = ("UTC", "TDB", "TT", "TAI")


def spice_track(meta: Path, spacecraft: int, body: int, span: tuple[datetime, datetime]) -> Track:
    """From kernels, between two dates in TDB.

    Raises:
        InputError: if they cannot be read, do not cover the dates, or these are not ascending.
    """
    begin, end = span
    duration = (end - begin).total_seconds()
    count = int(np.ceil(duration / STEP_S)) + 1
    if not 1 < count <= STATES_MAX:
        raise InputError(
            "--to",
            f"{duration:g} s after --from",
            f"must be later by {STEP_S:g} to {STEP_S * STATES_MAX:g} s",
        )
    times = np.linspace(0.0, duration, count)
    states = read_states([meta], spacecraft, body, _et(begin) + times, SPICE)
    doubts = tuple(jump_doubts(meta, spacecraft, body, (_et(begin), _et(end)), SPICE))
    return Track(begin, times, states, f"from {meta.name}, spacecraft {spacecraft}", doubts)


def spice_body(
    meta: Path, name: str, known: PackagedBody | None, when: datetime
) -> tuple[int, float, Tables]:
    """Number, reference radius in m, and the tables `[body]` and `[sun]` of a body, from kernels.

    What the kernels lack of gravity is taken from a packaged body of that name; J2, which no kernel of
    its kind has, is zero without one.

    Raises:
        InputError: if they cannot be read or lack rotation, GM, size or the way about the Sun.
    """
    number = known.entries["naif_id"] if known else number_of([meta], name, SPICE)
    if number is None:
        raise InputError("--body", name, f"must be a packaged body, or one that {meta} names")
    days = _et(when) / DAY_S
    try:
        rotation = read_pck(meta, number, days)
        position, velocity = read_heliocentric([meta], number, _et(when))
    except InputError as error:
        raise InputError(SPICE, error.given, error.allowed) from None
    gm, source = read_gm([meta], number, SPICE), f"from {meta.name}"
    packaged = known.entries if known else {}
    radii = rotation.radii_m or packaged.get("radii_m")
    if (gm is None and not packaged) or radii is None:
        lacking = f"BODY{number}_GM" if gm is None else f"BODY{number}_RADII"
        raise InputError(SPICE, str(meta), f"must hold {lacking}")
    radius = float(packaged.get("reference_radius_m", max(radii)))
    own = f"packaged, of {packaged['name']}" if packaged else "unknown here"
    w0, w1, w2 = rotation.prime_meridian
    body: list[Entry] = [
        ("name", packaged.get("name", name), "as given"),
        ("naif_id", number, "NAIF's number"),
        (
            "gm_m3_s2",
            packaged["gm_m3_s2"] if gm is None else gm,
            f"m^3/s^2; {own if gm is None else source}",
        ),
        ("j2", packaged.get("j2", 0.0), f"unnormalised, at reference_radius_m; {own}"),
        ("reference_radius_m", radius, f"m; {own if packaged else 'the largest of radii_m'}"),
        ("radii_m", list(radii), f"m, semi-axes body-fixed; {source if rotation.radii_m else own}"),
        ("pole_ra_deg", rotation.pole_ra_deg, f"deg, J2000; {source}"),
        ("pole_dec_deg", rotation.pole_dec_deg, f"deg, J2000; {source}"),
        ("prime_meridian_deg", w0, f"deg; {source}"),
        ("prime_meridian_rate_deg_day", w1, f"deg/day; {source}"),
        ("prime_meridian_acceleration_deg_day2", w2, f"deg/day^2; {source}"),
    ]
    how = f"J2000, body from the Sun at epoch.tdb; {source}"
    sun: list[Entry] = [
        ("body_position_km", position, f"km, {how}"),
        ("body_velocity_km_s", velocity, f"km/s, {how}"),
        ("solar_constant_w_m2", 1361.0, "W/m^2 at 1 au"),
    ]
    return number, radius, {"body": body, "sun": sun}


def oem_track(path: Path, body: str) -> Track:
    """All segments of an OEM, in order; two states at a burn.

    Raises:
        InputError: if the extra [oem] is missing, or the message is none, of another frame, centre or
            time scale, or its segments are not in order.
    """
    entry = f"{OEM} {path}"
    with needing(OEM, "oem"):
        from astropy.time import Time
        from oem import OrbitEphemerisMessage
    if not path.is_file():
        raise InputError(entry, "no such file", "must be a readable OEM")
    rows = []
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore")  # of leap seconds that nobody knows yet
        warnings.filterwarnings("error", message="Unsupported TIME_SYSTEM")
        try:
            segments = list(OrbitEphemerisMessage.open(str(path)))
        except Exception as error:  # of whatever kind: the library has none of its own
            raise InputError(entry, f"no OEM ({str(error)[:120]})", "must be a CCSDS OEM") from None
        for segment in segments:
            about = segment.metadata
            _one_of(entry, "REF_FRAME", about["REF_FRAME"], FRAMES)
            _one_of(entry, "CENTER_NAME", about["CENTER_NAME"], (body.upper(), plain_name(body)))
            _one_of(entry, "TIME_SYSTEM", about["TIME_SYSTEM"], SCALES)
            rows += [(s.epoch.tdb, 1e3 * s.position, 1e3 * s.velocity) for s in segment.states]
    first = rows[0][0]
    since = (first - Time(J2000_TDB, scale="tdb")).sec
    epoch = J2000_TDB + timedelta(microseconds=round(since * 1e6))  # as fine as a scenario's
    times = np.round([(row[0] - first).sec for row in rows], 9)
    states = np.array([np.concatenate(row[1:]) for row in rows])
    return Track(epoch, times, states, f"from {path.name}")


def csv_track(path: Path, epoch: datetime) -> Track:
    """A table of states as `--init` takes it; `t_s` counts from the epoch, TDB.

    Raises:
        InputError: if it cannot be read.
    """
    table = read_table(path, f"{CSV} {path}")
    begin = epoch + timedelta(seconds=float(table[0, 0]))
    return Track(begin, table[:, 0] - table[0, 0], table[:, 1:], f"from {path.name}")


def cut(track: Track, begin: datetime | None, end: datetime | None) -> Track:
    """The part between two of a track's own times; to the nearest state within them.

    Raises:
        InputError: if fewer than two states are left, or times are not ascending.
    """
    low = 0.0 if begin is None else (begin - track.epoch).total_seconds()
    high = track.duration_s if end is None else (end - track.epoch).total_seconds()
    if np.any(np.diff(track.times_s) < 0.0):
        raise InputError("times", track.source, "must be ascending")
    inside = (track.times_s >= low - 1e-6) & (track.times_s <= high + 1e-6)
    times = track.times_s[inside]
    if len(times) < 2 or times[0] == times[-1]:
        raise InputError(
            "--from, --to",
            f"{low:g} to {high:g} s of {track.duration_s:g} s",
            "must have two states of the trajectory between them",
        )
    first, last = (track.epoch + timedelta(seconds=float(time)) for time in times[[0, -1]])
    doubts = (*track.doubts, *late_doubts(begin, end, (first, last)))
    return Track(first, times - times[0], track.states[inside], track.source, doubts)


def _et(when: datetime) -> float:
    """TDB seconds past J2000."""
    return (when - J2000_TDB).total_seconds()


def _one_of(entry: str, key: str, given: str, known: Sequence[str]) -> None:
    if given.strip().upper() not in known:
        raise InputError(f"{entry}: {key}", given, f"must be {' or '.join(dict.fromkeys(known))}")
