"""Read trajectories from CCSDS OEMs, as key = value or XML.

States must be in J2000 axes about the requested body: another frame or centre is refused, with the key
and the line. Other doubts become warnings.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.drafting.flown import Track
from scp_recon.errors import InputError, option
from scp_recon.files import read_text
from scp_recon.interop.ccsds import plain_name
from scp_recon.interop.tracks import LATE_MAX_S
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.time_scales import tdb_instant

OEM = option("from_oem")
FRAMES = ("EME2000", "J2000", "ICRF", "GCRF")
"""CCSDS's names of J2000 axes, or of axes within 0.02 arcseconds of them."""
BARYCENTER, EPOCH_SLACK_S = "BARYCENTER", 120.0
"""What systems' names end with; and how far a frame's epoch may be off J2000, which no scale is."""
SCALES = ("UTC", "TDB", "TT", "TAI")


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
    places = list[str]()
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
            places.append(where)
            previous = epoch
        ends = rows[0][2], rows[-1][2]
        doubts |= {str(doubt): doubt for doubt in _span_doubts(entry, about, ends)}
    if not instants:
        raise InputError(entry, "no states", "must be a CCSDS OEM with states")
    first = instants[0]
    epoch_tdb = J2000_TDB + timedelta(microseconds=round(first / 1e3))  # as fine as a scenario's
    times = np.array([(when - first) / 1e9 for when in instants])
    return Track(
        epoch_tdb,
        times,
        1e3 * np.array(states),
        f"from {path.name}",
        tuple(doubts.values()),
        entry=entry,
        where=tuple(places),
    )


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


def _one_of(entry: str, key: str, about: About, known: Sequence[str], hint: str = "") -> None:
    """Refuse a segment whose value of a key is missing, or none of the known ones."""
    where, given = about.get(key, ("metadata", "nothing"))
    if given.upper() not in known:
        allowed = f"must be {' or '.join(dict.fromkeys(known))}{hint}"
        raise InputError(f"{entry}: {key}, {where}", given, allowed)
