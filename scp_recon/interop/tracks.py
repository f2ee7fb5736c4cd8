"""Read trajectories and bodies from SPICE kernels, CCSDS OEMs and tables.

States must be in J2000 axes about the requested body: another frame or centre is refused. Other
doubts about a trajectory become warnings, which are kept with the plan.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from scp_recon.bodies.catalogue import DAY_S, J2000_TDB, PackagedBody
from scp_recon.bodies.kernels import number_of, read_gm, read_heliocentric, read_pck, read_states
from scp_recon.drafting.draft import Entry, Tables
from scp_recon.drafting.flown import Track
from scp_recon.errors import InputError, option
from scp_recon.files import read_text
from scp_recon.interop.ccsds import plain_name
from scp_recon.mission.mission import Mission
from scp_recon.physics.flow import propagate
from scp_recon.planning.initial_guess import read_table
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.time_scales import tdb_instant

SPICE, OEM, CSV = (option(f"from_{form}") for form in ("spice", "oem", "csv"))
STEP_S, STATES_MAX = 30.0, 100_000
"""Step between states read from kernels, s."""
FRAMES = ("EME2000", "J2000", "ICRF", "GCRF")
"""CCSDS's names of J2000 axes, or of axes within 0.02 arcseconds of them."""
BARYCENTER, EPOCH_SLACK_S = "BARYCENTER", 120.0
"""What systems' names end with; and how far a frame's epoch may be off J2000, which no scale is."""
SCALES = ("UTC", "TDB", "TT", "TAI")
STATES, SUBSTEPS = 60, 20
"""Number of states propagated from each to the next; and steps of RK4 between two."""
PULL_OFF_MAX = 0.3
"""Largest median relative difference between the trajectory's change of velocity and the planner's."""
GAP_MAX = 10.0
"""Largest step, in usual steps, that is not a gap."""
SPREAD_MAX, APART_MAX = 0.5, 1e-3
"""Tolerances of positions against velocities, relative to the step and to the radius."""
LATE_MAX_S = 1.0
"""Tolerance of a trajectory's ends against the requested times, s."""
BESIDE_S, JUMP_MAX_M_S = 1.0, 1e-3
"""Time from an end within which a burn is sought, s, and the least jump that is a burn, m/s."""


def spice_track(meta: Path, spacecraft: int, body: int, span: tuple[datetime, datetime]) -> Track:
    """Read a spacecraft's track from kernels, between two dates in TDB.

    Raises:
        InputError: if the kernels cannot be read or do not cover the dates, or the dates do not ascend.
    """
    begin, end = span
    duration = (end - begin).total_seconds()
    count = int(np.ceil(duration / STEP_S)) + 1
    if not 1 < count <= STATES_MAX:
        raise InputError(
            option("end"),
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

    If the kernels lack GM, it is that of the packaged body of that name. No kernel has J2, so J2 is
    always that of the packaged body, or zero without one.

    Raises:
        InputError: if the kernels cannot be read or lack rotation, GM, size or heliocentric state.
    """
    number = known.entries["naif_id"] if known else number_of([meta], name, SPICE)
    if number is None:
        raise InputError(option("body"), name, f"must be a packaged body, or one that {meta} names")
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
        ("state_tdb", when.isoformat(), "TDB to which the next two entries belong"),
        ("body_position_km", position, f"km, {how}"),
        ("body_velocity_km_s", velocity, f"km/s, {how}"),
        ("solar_constant_w_m2", 1361.0, "W/m^2 at 1 au"),
    ]
    return number, radius, {"body": body, "sun": sun}


def oem_track(path: Path, body: str) -> Track:
    """Read all segments of an OEM, in order; there are two states at a burn.

    Spaces, case and signs of the centre's name do not count. States about the barycentre of a
    body's system count as states about the body, with a warning.

    Raises:
        InputError: if the file is no OEM, of another frame, centre or time scale, or its states or
            segments are not in order; names the key and the line.
    """
    entry = f"{OEM} {path}"
    text = read_text(path, entry, "CCSDS OEM")
    lines = _of_xml(text, entry) if text.lstrip().startswith("<") else _of_kvn(text)
    instants, states, doubts = list[int](), list[list[float]](), dict[str, ScenarioWarning]()
    for about, rows in _segments(entry, lines):
        turn = "; turn the states to one of them"
        _one_of(entry, "REF_FRAME", about, FRAMES, turn)
        _one_of(entry, "TIME_SYSTEM", about, SCALES)
        _check_frame_epoch(entry, about)
        doubts |= {str(doubt): doubt for doubt in _centre_doubts(entry, about, body)}
        scale, previous = about["TIME_SYSTEM"][1].upper(), ""
        for where, line, epoch, numbers in rows:
            try:
                when = tdb_instant(epoch, scale)
            except ValueError as error:
                allowed = f"must have an epoch in {scale} ({error})"
                raise InputError(f"{entry}, {where}", line[:120], allowed) from None
            if instants and (when < instants[-1] or (previous and when == instants[-1])):
                allowed = "must be later than the state before"
                raise InputError(
                    f"{entry}, {where}", line[:120], f"{allowed}, at {previous or 'a burn'}"
                )
            instants.append(when)
            states.append(numbers)
            previous = epoch
        ends = rows[0][2], rows[-1][2]
        doubts |= {str(doubt): doubt for doubt in _span_doubts(entry, about, ends)}
    if not instants:
        raise InputError(entry, "no states", "must be a CCSDS OEM with states")
    first = instants[0]
    epoch_tdb = J2000_TDB + timedelta(microseconds=round(first / 1e3))  # as fine as a scenario's
    times = np.array([(when - first) / 1e9 for when in instants])
    source = f"from {path.name}"
    return Track(epoch_tdb, times, 1e3 * np.array(states), source, tuple(doubts.values()))


Line = tuple[str, str]
"""Where a line of an OEM stands, in words, and the line."""
About = dict[str, Line]
"""A segment's metadata by key: where each stands, and its value."""
Row = tuple[str, str, str, list[float]]
"""Where a state stands, its line, its epoch on the calendar, and six numbers in km and km/s."""
VERSIONS = ("1.0", "2.0", "3.0")
SIZE = 6
"""Rows and columns of a covariance."""
EPOCH = re.compile(r"([1-8]\d{3})-(?:(\d\d-\d\d)|(\d{3}))T(\d\d:\d\d:\d\d(?:\.\d*)?)Z?")
"""A calendar date or day of the year; a Z ends it in any scale: CCSDS 502.0-B-3, 7.5.10."""


def _of_kvn(text: str) -> Iterator[Line]:
    """Lines of an OEM in key-value notation that are neither blank nor comments."""
    for number, line in enumerate(text.splitlines(), start=1):
        if (kept := line.strip()) and not kept.startswith("COMMENT"):
            yield f"line {number}", kept


def _of_xml(text: str, entry: str) -> Iterator[Line]:
    """The lines that an OEM in XML would have in key-value notation; covariances are left out."""
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(entry, f"no OEM ({error})", "must be a CCSDS OEM") from None
    count, versions = 0, (part.get("version") for part in root.iter() if part.tag.endswith("oem"))
    yield "version", f"CCSDS_OEM_VERS = {next(versions, 'nothing')}"
    for part in root.iter():
        inside = {item.tag.rpartition("}")[2]: (item.text or "").strip() for item in part}
        if part.tag.endswith("metadata"):
            yield "metadata", "META_START"
            yield from ((key, f"{key} = {value}") for key, value in inside.items())
            yield "metadata", "META_STOP"
        elif part.tag.endswith("stateVector"):
            count += 1
            keys = ("EPOCH", "X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
            yield f"stateVector {count}", " ".join(inside.get(key, "nothing") for key in keys)


def _segments(entry: str, lines: Iterable[Line]) -> Iterator[tuple[About, list[Row]]]:
    """Metadata and states of each segment.

    Raises:
        InputError: naming the line, if it is none of an OEM.
    """
    about, rows, inside, triangle = About(), list[Row](), "", -1
    for number, (where, line) in enumerate(lines):
        key, equals, value = (part.strip() for part in line.partition("="))

        def fail(allowed: str, where: str = where, line: str = line) -> InputError:
            return InputError(f"{entry}, {where}", line[:120], allowed)

        if number == 0:
            if key != "CCSDS_OEM_VERS" or value not in VERSIONS:
                raise fail(f"must be CCSDS_OEM_VERS = {' or '.join(VERSIONS)}, as an OEM begins")
        elif not equals and re.fullmatch("(META|COVARIANCE)_(START|STOP)", line):
            _check_whole(triangle, fail)
            if line == "META_START" and rows:
                yield about, rows
            if line == "META_START":
                about, rows = {}, []
            inside = line if line.endswith("START") else "states"
            triangle = -1
        elif inside in ("", "META_START"):
            if not equals:
                raise fail("must read KEY = value")
            if inside and key in about:
                raise fail(f"must be given once, not on {about[key][0]} too")
            if inside:
                about[key] = (where, value)
        elif inside == "COVARIANCE_START" and equals:
            if key == "EPOCH":
                _check_whole(triangle, fail)
                _calendar(value, fail)
                triangle = 0
        elif inside == "COVARIANCE_START":
            if triangle < 0:
                raise fail("must come after its EPOCH")
            triangle += 1
            if triangle > SIZE:
                raise fail(f"must be left out: a covariance is a lower triangle of {SIZE} rows")
            if len(line.split()) != triangle:
                raise fail(
                    f"must have {triangle} numbers, the row's of a lower triangle of {SIZE} rows"
                )
            _finite(line.split(), fail)
        else:
            epoch, *numbers = line.split()
            if len(numbers) not in (6, 9):
                raise fail("must be an epoch and six numbers")
            rows.append((where, line, _calendar(epoch, fail), _finite(numbers, fail)[:6]))
    if inside == "COVARIANCE_START":
        raise fail("must not be the last line: COVARIANCE_STOP is missing")
    if rows:
        yield about, rows


def _check_whole(rows: int, fail: Callable[[str], InputError]) -> None:
    """Refuse a covariance with some rows and not all; -1 before any."""
    if 0 <= rows < SIZE:
        raise fail(f"must come after all {SIZE} rows of a covariance, and follows {rows}")


def _calendar(epoch: str, fail: Callable[[str], InputError]) -> str:
    """An epoch as a calendar date without a Z."""
    found = EPOCH.fullmatch(epoch)
    if found is None:
        raise fail("must have an epoch such as 2020-01-21T20:33:17.184, or 2020-021T20:33:17.184")
    year, date, day, time = found.groups()
    if day is not None:
        turned = datetime(int(year), 1, 1) + timedelta(days=int(day) - 1)
        date = f"{turned:%m-%d}" if turned.year == int(year) else "00-00"
    return f"{year}-{date}T{time}"


def _date(text: str, refusal: InputError) -> int:
    """Nanoseconds past J2000 of a date, in its own scale; the refusal is raised if it is none."""
    try:
        return tdb_instant(_calendar(text, lambda _: refusal), "TDB")
    except ValueError:
        raise refusal from None


def _finite(words: Sequence[str], fail: Callable[[str], InputError]) -> list[float]:
    try:
        found = [float(word) for word in words]
    except ValueError:
        raise fail("must be numbers") from None
    if not np.isfinite(found).all():
        raise fail("must be finite numbers")
    return found


def _check_frame_epoch(entry: str, about: About) -> None:
    """Refuse axes of another date than J2000, which none of `FRAMES` has.

    Raises:
        InputError: if REF_FRAME_EPOCH is another date, or none.
    """
    if "REF_FRAME_EPOCH" not in about:
        return
    where, given = about["REF_FRAME_EPOCH"]
    allowed = (
        f"must be 2000-01-01T12:00:00, or left out, as {about['REF_FRAME'][1]} has no other; turn "
        "the states to it if their axes are of that date"
    )
    refusal = InputError(f"{entry}: REF_FRAME_EPOCH, {where}", given, allowed)
    off = _date(given, refusal) / 1e9
    if abs(off) > EPOCH_SLACK_S:
        raise refusal


def _centre_doubts(entry: str, about: About, body: str) -> Iterator[ScenarioWarning]:
    """Warn of a system's barycentre in the place of a body's own centre.

    Raises:
        InputError: if the states are about something else.
    """
    named = about.get("CENTER_NAME", ("", ""))[1]
    given, own = (plain_name(name).replace("_", "") for name in (named, body))
    if given not in (own, own + BARYCENTER):
        _one_of(entry, "CENTER_NAME", about, (body.upper(), plain_name(body)))
    if given != own:
        yield ScenarioWarning.of(
            "trajectory",
            f"about {named}",
            f"taken as about the centre of {body}, from which other bodies of the system move the "
            "barycentre",
        )


def _span_doubts(entry: str, about: About, ends: tuple[str, str]) -> Iterator[ScenarioWarning]:
    """Warn of states that begin after START_TIME or end before STOP_TIME: of a file cut short.

    Raises:
        InputError: if one of these is no date.
    """
    for key, epoch in zip(("START_TIME", "STOP_TIME"), ends, strict=True):
        if key not in about:
            continue
        where, given = about[key]
        allowed = "must be a date such as 2020-01-21T20:33:17.184"
        refusal = InputError(f"{entry}: {key}, {where}", given, allowed)
        first, said = _date(epoch, refusal), _date(given, refusal)
        if abs(first - said) > 1e9 * LATE_MAX_S:
            word = "begin" if key == "START_TIME" else "end"
            yield ScenarioWarning.of(
                "trajectory", f"states that {word} at {epoch}", f"expected {key}, {given}"
            )


def csv_track(path: Path, epoch: datetime) -> Track:
    """Read a table of states as for `--init`; `t_s` counts from the epoch, TDB.

    Raises:
        InputError: if the file cannot be read, or has a column `tdb` that says another epoch.
    """
    table = read_table(path, f"{CSV} {path}")
    begin = epoch + timedelta(seconds=float(table[0, 0]))
    lines = (line for line in read_text(path, CSV, "file").splitlines() if line[:1] != "#")
    if (said := next(csv.DictReader(lines)).get("tdb")) is not None:
        off = (begin - datetime.fromisoformat(said)).total_seconds()
        if abs(off) > LATE_MAX_S:
            raise InputError(
                option("epoch"),
                f"{epoch.isoformat()}, which puts the first row at {begin.isoformat()}",
                f"must be TDB, and {-off:.3f} s later: the row's own column tdb says {said}",
            )
    return Track(begin, table[:, 0] - table[0, 0], table[:, 1:], f"from {path.name}")


def cut(track: Track, begin: datetime | None, end: datetime | None) -> Track:
    """The part of a track between two times on it, from the first state within to the last.

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
            f"{option('begin')}, {option('end')}",
            f"{low:g} to {high:g} s of {track.duration_s:g} s",
            "must have two states of the trajectory between them",
        )
    first, last = (track.epoch + timedelta(seconds=float(time)) for time in times[[0, -1]])
    doubts = (*track.doubts, *late_doubts(begin, end, (first, last)))
    return Track(first, times - times[0], track.states[inside], track.source, doubts)


def _et(when: datetime) -> float:
    """TDB seconds past J2000."""
    return (when - J2000_TDB).total_seconds()


def _one_of(entry: str, key: str, about: About, known: Sequence[str], hint: str = "") -> None:
    """Refuse a segment whose value of a key is missing, or none of the known ones."""
    where, given = about.get(key, ("metadata", "nothing"))
    if given.upper() not in known:
        allowed = f"must be {' or '.join(dict.fromkeys(known))}{hint}"
        raise InputError(f"{entry}: {key}, {where}", given, allowed)


def pull_doubts(mission: Mission, track: Track) -> Iterator[ScenarioWarning]:
    """Warn of a trajectory with another acceleration: about another body, or in rotating axes.

    States are propagated to later ones by the planner's forces; half of them must arrive with about the
    trajectory's change of velocity. Fixed but wrong axes cannot be detected.
    """
    chosen = np.unique(np.linspace(0, len(track.times_s) - 1, STATES + 1).astype(int))
    times, states = track.times_s[chosen], track.states[chosen]
    took = np.diff(times)
    later = took > 0.0
    begin = times[:-1][later]
    arrived = propagate(states[:-1][later], took[later], mission.forces, SUBSTEPS, begin)
    gained = np.linalg.norm((states[1:] - states[:-1])[later, 3:], axis=1)
    off = np.linalg.norm(arrived[:, 3:] - states[1:][later, 3:], axis=1)
    share = float(np.median(off) / max(float(np.median(gained)), 1e-12))
    if not share <= PULL_OFF_MAX:
        yield ScenarioWarning.of(
            "trajectory",
            f"{track.source}, whose change of velocity differs by {100.0 * share:.3g} % from that by "
            f"{mission.scenario.body.name} and sunlight",
            f"expected below {100.0 * PULL_OFF_MAX:g} %: body, inertial axes, m and s?",
        )


def step_doubts(track: Track) -> Iterator[ScenarioWarning]:
    """Warn of a gap, and of positions that do not agree with the velocities."""
    times, position, velocity = track.times_s, track.states[:, :3], track.states[:, 3:]
    took = np.diff(times)
    usual, k = float(np.median(took[took > 0.0])), int(np.argmax(took))
    if took[k] > GAP_MAX * usual:
        yield ScenarioWarning.of(
            "trajectory",
            f"{track.source}, without a state from {times[k]:g} to {times[k + 1]:g} s",
            f"expected the usual step, {usual:.3g} s",
        )
    way = 0.5 * (velocity[1:] + velocity[:-1]) * took[:, None]
    off = np.linalg.norm(np.diff(position, axis=0) - way, axis=1)
    speed = np.linalg.norm(velocity, axis=1)
    allowed = SPREAD_MAX * np.maximum(speed[1:], speed[:-1]) * took
    off -= allowed + APART_MAX * np.linalg.norm(position[1:], axis=1)
    off[took > GAP_MAX * usual] = 0.0
    if off.max() > 0.0:
        k = int(np.argmax(off))
        yield ScenarioWarning.of(
            "trajectory",
            f"{track.source}, whose positions jump between {times[k]:g} and {times[k + 1]:g} s",
            "expected positions that agree with the velocities",
        )


def late_doubts(
    begin: datetime | None, end: datetime | None, got: tuple[datetime, datetime]
) -> Iterator[ScenarioWarning]:
    """Warn of a trajectory that does not begin and end at the requested times (TDB)."""
    for entry, wanted, found in (("--from", begin, got[0]), ("--to", end, got[1])):
        off = 0.0 if wanted is None else (found - wanted).total_seconds()
        if abs(off) > LATE_MAX_S:
            yield ScenarioWarning.of(
                entry,
                f"a time {abs(off):.3f} s {'before' if off > 0.0 else 'after'} the nearest state",
                "the trajectory is taken from state to state: the plan "
                f"{'begins' if entry == '--from' else 'ends'} at that one",
            )


def jump_doubts(
    meta: Path, spacecraft: int, body: int, ends: tuple[float, float], entry: str
) -> Iterator[ScenarioWarning]:
    """Warn of a burn just outside of a trajectory's ends, TDB seconds past J2000."""
    for flag, at, out in (("--from", ends[0], -BESIDE_S), ("--to", ends[1], BESIDE_S)):
        beside = at + out * np.array([1.0, 0.5, 0.0])
        try:
            outside, between, here = read_states([meta], spacecraft, body, beside, entry)[:, 3:]
        except InputError:  # they have nothing there
            continue
        jump = float(np.linalg.norm(2.0 * between - outside - here))
        if jump > JUMP_MAX_M_S:
            side, beyond = ("before", "earlier") if out < 0.0 else ("after", "later")
            yield ScenarioWarning.of(
                flag,
                f"a time with a jump of {jump:.4f} m/s within {BESIDE_S:g} s {side} it",
                f"the boundary state is without it: {BESIDE_S:g} s {beyond} if that is a burn of the "
                "plan",
            )
