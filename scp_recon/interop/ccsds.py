"""Write and read CCSDS 502.0-B-2 messages: OEM (path, covariances), and OPM (burns).

Messages are written in key-value notation. An OEM has a segment for each coast, so that no
interpolation crosses a burn. Segments meet at the burn's epoch. An OEM cannot hold burns, so an OPM
holds them as manoeuvres. Units are the standard's: km, km/s, kg, s.

OEMs are read as key = value or XML. Their states must be in J2000 axes about the requested body:
another frame or centre is refused, with the key and the line. Other doubts become warnings.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from itertools import chain
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from formulations.arrays import Array
from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.drafting.draft import Track
from scp_recon.errors import InputError, option
from scp_recon.files import read_text
from scp_recon.interop.export import Coast, Export, heading, maker
from scp_recon.interop.tracks import LATE_MAX_S
from scp_recon.physics.two_body import Orbit
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.time_scales import iso_tdb, tdb_instant

KM = 1e-3
AXES = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
FRAME = "EME2000"
"""Name of SPICE's J2000, whose axes are the ICRF's: docs/frames.md says why not ICRF."""
UNITS = ("km",) * 3 + ("km/s",) * 3
CUBIC = 3


def oem_text(export: Export) -> str:
    """The plan's path and covariances: TIME_SYSTEM TDB, REF_FRAME EME2000, km and km/s."""
    lines = [*_header("OEM", export), ""]
    for number, coast in enumerate(export.coasts):
        lines += [*_segment(export, number, coast), ""]
    return "\n".join(lines)


def opm_text(export: Export) -> str:
    """Text of an OPM: state before the first burn, orbit, covariance, spacecraft, burns."""
    craft, before = export.mission.scenario.spacecraft, export.coasts[0]
    epoch = iso_tdb(export.instant(0.0))
    lines = [
        *_header("OPM", export),
        *_object(export),
        f"EPOCH = {epoch}",
        *(
            f"{axis} = {x:.15e} [{unit}]"
            for axis, x, unit in zip(AXES, KM * before.states[-1], UNITS, strict=True)
        ),
        *_keplerian(before.states[-1], export.mission.forces.gm),
        f"MASS = {craft.mass_kg:.15e} [kg]",
        f"SOLAR_RAD_AREA = {craft.srp_area_m2:.15e} [m**2]",
        f"SOLAR_RAD_COEFF = {craft.reflectivity_coefficient:.15e}",
        f"COV_REF_FRAME = {FRAME}",
    ]
    for row, name in enumerate(AXES):
        entries = KM**2 * before.covariances[-1][row, : row + 1]
        lines += [
            f"C{name}_{other} = {x:.15e} [{_unit(name, other)}]"
            for other, x in zip(AXES[: row + 1], entries, strict=True)
        ]
    for number, burn in export.executed:
        lines += [
            f"COMMENT burn {number}; the mass is not modelled",
            f"MAN_EPOCH_IGNITION = {iso_tdb(export.instant(burn.t_s))}",
            "MAN_DURATION = 0.0 [s]",
            "MAN_DELTA_MASS = 0.0 [kg]",
            f"MAN_REF_FRAME = {FRAME}",
            *(f"MAN_DV_{i} = {KM * x:.15e} [km/s]" for i, x in enumerate(burn.dv_m_s, start=1)),
        ]
    return "\n".join(lines) + "\n"


def _keplerian(state: Array, gm: float) -> list[str]:
    """Lines of the osculating orbit and GM; no lines for a parabola or a radial fall."""
    orbit = Orbit.of(state[:3], state[3:], gm)
    if np.isinf(orbit.axis) or not orbit.normal.any():
        return []
    angles = np.rad2deg(orbit.angles(state[:3]))
    names = "INCLINATION", "RA_OF_ASC_NODE", "ARG_OF_PERICENTER", "TRUE_ANOMALY"
    return [
        f"SEMI_MAJOR_AXIS = {KM * orbit.axis:.15e} [km]",
        f"ECCENTRICITY = {np.linalg.norm(orbit.eccentricity):.15e}",
        *(f"{name} = {x:.15e} [deg]" for name, x in zip(names, angles, strict=True)),
        f"GM = {KM**3 * gm:.15e} [km**3/s**2]",
    ]


def _header(kind: str, export: Export) -> list[str]:
    return [
        f"CCSDS_{kind}_VERS = 2.0",
        *(f"COMMENT {line}" for line in heading(export)),
        f"CREATION_DATE = {datetime.now(UTC):%Y-%m-%dT%H:%M:%S}",
        f"ORIGINATOR = {maker().partition(' ')[0].upper()}",
    ]


def _object(export: Export) -> list[str]:
    return [
        f"OBJECT_NAME = {plain_name(export.mission.scenario.name)}",
        f"OBJECT_ID = {export.spacecraft}",
        f"CENTER_NAME = {plain_name(export.mission.scenario.body.name)}",
        f"REF_FRAME = {FRAME}",
        "TIME_SYSTEM = TDB",
    ]


def _segment(export: Export, number: int, coast: Coast) -> list[str]:
    epochs = [iso_tdb(export.instant(time)) for time in coast.times_s.tolist()]
    last, burn = len(export.coasts) - 1, export.burns_flown + number
    covariances = [
        [f"EPOCH = {epoch}", f"COV_REF_FRAME = {FRAME}"]
        + [_numbers(row[: i + 1]) for i, row in enumerate(matrix)]
        for epoch, matrix in zip(epochs, KM**2 * coast.covariances, strict=True)
    ]  # lower triangles, km^2, km^2/s and km^2/s^2
    ends = [f"begins after burn {burn}"] if number else []
    ends += [f"ends before burn {burn + 1}"] if number < last else []
    return [
        "META_START",
        f"COMMENT {' and '.join(ends)}",
        *_object(export),
        f"START_TIME = {epochs[0]}",
        f"STOP_TIME = {epochs[-1]}",
        "INTERPOLATION = HERMITE",
        f"INTERPOLATION_DEGREE = {CUBIC}",
        "META_STOP",
        *(
            f"{epoch} {_numbers(KM * state)}"
            for epoch, state in zip(epochs, coast.states, strict=True)
        ),
        "COVARIANCE_START",
        *chain.from_iterable(covariances),
        "COVARIANCE_STOP",
    ]


def _unit(row: str, column: str) -> str:
    """Unit of an entry of the covariance."""
    return ("km**2", "km**2/s", "km**2/s**2")[row.count("_DOT") + column.count("_DOT")]


def _numbers(values: Array) -> str:
    return " ".join(f"{value:.15e}" for value in values.tolist())


def plain_name(name: str) -> str:
    """A name in capitals, digits and underscores, which other tools accept."""
    return "".join(c if c.isascii() and c.isalnum() else "_" for c in name).upper() or "UNNAMED"


OEM = option("from_oem")
FRAMES = ("EME2000", "J2000", "ICRF", "GCRF")
"""CCSDS's names of J2000 axes, or of axes within 0.02 arcseconds of them."""
BARYCENTER, EPOCH_SLACK_S = "BARYCENTER", 120.0
"""What systems' names end with; and how far a frame's epoch may be off J2000, which no scale is."""
SCALES = ("UTC", "TDB", "TT", "TAI")
VERSIONS = ("1.0", "2.0", "3.0")
SIZE = 6
"""Rows and columns of a covariance."""
EPOCH = re.compile(r"([1-8]\d{3})-(?:(\d\d-\d\d)|(\d{3}))T(\d\d:\d\d:\d\d(?:\.\d*)?)Z?")
"""A calendar date or day of the year; a Z ends it in any scale: CCSDS 502.0-B-3, 7.5.10."""
AN_EPOCH = "must have an epoch such as 2020-01-21T20:33:17.184, or 2020-021T20:33:17.184"
Line = tuple[str, str]
"""Where a line of an OEM stands, in words, and the line."""


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
        scale = about.scale()
        found, previous = list(about.centre_doubts(body)), ""
        for where, line in rows:
            epoch, *numbers = line.split()
            try:
                when, state = _instant(epoch, scale), _state(numbers)
                if instants and (when < instants[-1] or (previous and when == instants[-1])):
                    last = previous or "a burn"
                    raise ValueError(f"must be later than the state before, at {last}")
            except ValueError as error:
                raise InputError(f"{entry}, {where}", line[:120], str(error)) from None
            instants.append(when)
            states.append(state)
            places.append(where)
            previous = epoch
        found += about.span_doubts(*(line.split()[0] for _, line in (rows[0], rows[-1])))
        doubts |= {str(doubt): doubt for doubt in found}
    if not instants:
        raise InputError(entry, "no states", "must be a CCSDS OEM with states")
    first = instants[0]
    return Track(
        J2000_TDB + timedelta(microseconds=round(first / 1e3)),  # as fine as a scenario's
        np.array([(when - first) / 1e9 for when in instants]),
        1e3 * np.array(states),
        f"from {path.name}",
        tuple(doubts.values()),
        entry=entry,
        where=tuple(places),
    )


def _of_kvn(text: str) -> Iterator[Line]:
    """Lines of an OEM in key-value notation that are neither blank nor comments."""
    for number, line in enumerate(text.splitlines(), start=1):
        if (kept := line.strip()) and not kept.startswith("COMMENT"):
            yield f"line {number}", kept


def _of_xml(text: str, entry: str) -> Iterator[Line]:
    """The lines that an OEM in XML would have in key-value notation."""
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


def _segments(entry: str, lines: Iterable[Line]) -> Iterator[tuple[_Metadata, list[Line]]]:
    """Metadata and lines with states of each segment.

    Raises:
        InputError: naming the line, if it is none of an OEM.
    """
    about, rows, inside, triangle = _Metadata(entry), list[Line](), "", -1
    for number, (where, line) in enumerate(lines):
        key, equals, value = (part.strip() for part in line.partition("="))
        mark = not equals and re.fullmatch("(META|COVARIANCE)_(START|STOP)", line)
        begins, allowed = inside == "COVARIANCE_START" and key == "EPOCH", ""
        if number == 0:
            if key != "CCSDS_OEM_VERS" or value not in VERSIONS:
                allowed = f"must be CCSDS_OEM_VERS = {' or '.join(VERSIONS)}, as an OEM begins"
        elif (mark or begins) and 0 <= triangle < SIZE:
            allowed = f"must follow all {SIZE} rows of a covariance, and follows {triangle}"
        elif begins:
            triangle, allowed = 0, "" if EPOCH.fullmatch(value) else AN_EPOCH
        elif mark:
            if line == "META_START":
                if rows:
                    yield about, rows
                about, rows = _Metadata(entry), []
            inside, triangle = line, -1
        elif inside in ("", "META_START"):
            if not equals:
                allowed = "must read KEY = value"
            elif key in about.values:
                allowed = f"must be given once, not on {about.values[key][0]} too"
            elif inside:
                about.values[key] = (where, value)
        elif inside != "COVARIANCE_START":
            rows.append((where, line))
        elif not equals:  # a covariance is not used, but a row that is none tells of a damaged file
            triangle += triangle >= 0
            words = line.split()
            if not len(words) == triangle <= SIZE:
                rows_of_it = f"a lower triangle of {SIZE} rows"
                allowed = (
                    f"must be the next row of {rows_of_it}, each a number longer, after its EPOCH"
                )
            elif not all(map(_is_finite, words)):
                allowed = "must be finite numbers"
        if allowed:
            raise InputError(f"{entry}, {where}", line[:120], allowed)
    if inside == "COVARIANCE_START":
        raise InputError(f"{entry}, {where}", line[:120], "must be followed by COVARIANCE_STOP")
    if rows:
        yield about, rows


@dataclass(frozen=True)
class _Metadata:
    """A segment's metadata by key: where each stands, and its value."""

    entry: str
    values: dict[str, Line] = field(default_factory=dict)

    def refusal(self, key: str, allowed: str) -> InputError:
        where, given = self.values.get(key, ("metadata", "nothing"))
        return InputError(f"{self.entry}: {key}, {where}", given, allowed)

    def one_of(self, key: str, known: Sequence[str], hint: str = "") -> str:
        """The value of a key in capitals, which must be known."""
        given = self.values.get(key, ("", "nothing"))[1].upper()
        if given not in known:
            raise self.refusal(key, f"must be {' or '.join(dict.fromkeys(known))}{hint}")
        return given

    def instant(self, key: str, allowed: str) -> int:
        """Nanoseconds past J2000 of a date, in its own scale."""
        try:
            return _instant(self.values[key][1], "TDB")
        except ValueError:
            raise self.refusal(key, allowed) from None

    def scale(self) -> str:
        """The time scale; refuses other axes than J2000's, also those of another date."""
        frame = self.one_of("REF_FRAME", FRAMES, "; turn the states to one of them")
        if "REF_FRAME_EPOCH" in self.values:
            allowed = (
                f"must be 2000-01-01T12:00:00, or left out, as {frame} has no other; turn the states "
                "to it if their axes are of that date"
            )
            if abs(self.instant("REF_FRAME_EPOCH", allowed)) > 1e9 * EPOCH_SLACK_S:
                raise self.refusal("REF_FRAME_EPOCH", allowed)
        return self.one_of("TIME_SYSTEM", SCALES)

    def centre_doubts(self, body: str) -> Iterator[ScenarioWarning]:
        """Warn of a system's barycentre in the place of a body's own centre; refuse others."""
        named = self.values.get("CENTER_NAME", ("", ""))[1]
        given, own = (plain_name(name).replace("_", "") for name in (named, body))
        if given not in (own, own + BARYCENTER):
            self.one_of("CENTER_NAME", (body.upper(), plain_name(body)))
        if given != own:
            yield ScenarioWarning.of(
                "trajectory",
                f"about {named}",
                f"taken as about the centre of {body}, from which other bodies of the system move the "
                "barycentre",
            )

    def span_doubts(self, first: str, last: str) -> Iterator[ScenarioWarning]:
        """Warn of states that begin after START_TIME or end before STOP_TIME: of a file cut short."""
        for key, word, epoch in (("START_TIME", "begin", first), ("STOP_TIME", "end", last)):
            if key in self.values:
                said = self.instant(key, "must be a date such as 2020-01-21T20:33:17.184")
                if abs(_instant(epoch, "TDB") - said) > 1e9 * LATE_MAX_S:
                    expected = f"expected {key}, {self.values[key][1]}"
                    yield ScenarioWarning.of(
                        "trajectory", f"states that {word} at {epoch}", expected
                    )


def _instant(epoch: str, scale: str) -> int:
    """Nanoseconds of TDB past J2000 of an epoch in a scale.

    Raises:
        ValueError: if it is no date.
    """
    found = EPOCH.fullmatch(epoch)
    if found is None:
        raise ValueError(AN_EPOCH)
    year, date, day, time = found.groups()
    if day is not None:
        turned = datetime(int(year), 1, 1) + timedelta(days=int(day) - 1)
        date = f"{turned:%m-%d}" if turned.year == int(year) else "00-00"
    try:
        return tdb_instant(f"{year}-{date}T{time}", scale)
    except ValueError as error:
        raise ValueError(f"must have an epoch in {scale} ({error})") from None


def _state(words: Sequence[str]) -> list[float]:
    """Six numbers, km and km/s; a state may have an acceleration.

    Raises:
        ValueError: if they are none.
    """
    if len(words) not in (6, 9):
        raise ValueError("must be an epoch and six numbers")
    if not all(map(_is_finite, words)):
        raise ValueError("must be finite numbers")
    return [float(word) for word in words[:6]]


def _is_finite(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False
