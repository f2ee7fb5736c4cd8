"""Read gravity fields from files: ICGEM's gfc, and the PDS's SHA tables."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from scp_recon.errors import InputError
from scp_recon.files import read_text

ENTRY = "body.gravity_file"
BYTES_MAX = 100_000_000
SAME = 1e-3
"""Tolerance of C00 and of degree 1: how far a field may be off GM and the centre of mass."""
Row = tuple[int, int, float, float]


@dataclass(frozen=True)
class GravityTable:
    """A gravity field as read from its file.

    Attributes:
        gm_m3_s2, radius_m: None where the file lacks them, as NEAR's tables do.
        rows: degree, order, C, S; fully normalised, those of degree 0 and those that vanish left out.
    """

    gm_m3_s2: float | None
    radius_m: float | None
    rows: tuple[Row, ...]


def read_gravity(path: Path, degree_max: int) -> GravityTable:
    """Read a field up to a degree.

    Raises:
        InputError: if the file cannot be read, is in neither format, or is not fully normalised.
    """
    text = read_text(path, f"{ENTRY} {path}", "gravity field", BYTES_MAX)
    try:
        table = _gfc(text) if "end_of_head" in text else _sha(text)
    except (ValueError, IndexError) as error:
        raise InputError(
            ENTRY, f"{path} ({str(error)[:80]})", "must be an ICGEM .gfc or a PDS SHA table"
        ) from None
    _check_centre(path, table)
    rows = [row for row in table.rows if 0 < row[0] <= degree_max and any(row[2:])]
    if not rows:
        raise InputError(ENTRY, str(path), "must hold coefficients from degree 2 on")
    pairs = {(n, m) for n, m, _, _ in rows}
    if len(pairs) != len(rows) or any(not 0 <= m <= n for n, m in pairs):
        raise InputError(ENTRY, str(path), "must hold each degree and order once, order <= degree")
    if any(abs(c) > 1.0 or abs(s) > 1.0 for _, _, c, s in rows):
        raise InputError(ENTRY, str(path), "must be normalised coefficients, between -1 and 1")
    return GravityTable(table.gm_m3_s2, table.radius_m, tuple(rows))


def _check_centre(path: Path, table: GravityTable) -> None:
    """Refuse a field with C00 other than 1, or with degree 1: it is not about the centre of mass."""
    for n, m, c, s in table.rows:
        if n == 0 and c != 0.0 and abs(c - 1.0) > SAME:
            raise InputError(ENTRY, f"{path}, with C00 = {c:g}", "must have C00 = 1, or none")
        if n == 1 and max(abs(c), abs(s)) > SAME:
            raise InputError(
                ENTRY,
                f"{path}, with degree 1, order {m}: {c:g}, {s:g}",
                f"must be about the centre of mass: below {SAME:g} in degree 1",
            )


def _gfc(text: str) -> GravityTable:
    """Parse ICGEM's format (Ince et al. 2019, appendix A): SI, keywords until end_of_head."""
    head, body = re.split(r"^end_of_head.*$", text, maxsplit=1, flags=re.MULTILINE)
    keys = {words[0]: words[1] for line in head.splitlines() if len(words := line.split()) > 1}
    if keys.get("norm", "fully_normalized") != "fully_normalized":
        raise ValueError(f"norm {keys['norm']}, not fully_normalized")
    lines = [line.split() for line in body.splitlines() if line.strip()]
    if other := {words[0] for words in lines} - {"gfc"}:
        raise ValueError(f"records {sorted(other)[0]}, where only gfc is constant in time")
    gm = keys.get("gravity_constant", keys.get("earth_gravity_constant"))
    return GravityTable(
        None if gm is None else _number(gm),
        _number(keys["radius"]) if "radius" in keys else None,
        tuple(_row(words[1:]) for words in lines),
    )


def _sha(text: str) -> GravityTable:
    """Parse a PDS table: radius in km and, if present, GM in km^3/s^2; then rows n, m, C, S, sigmas."""
    lines = [
        words for line in text.splitlines() if (words := re.split(r"[,\s]+", line.strip(" ,")))[0]
    ]
    if not lines:
        raise ValueError("nothing in it")
    gm = radius = None
    if not lines[0][0].isdecimal():
        first, *lines = lines
        radius, gm = _number(first[0]) * 1e3, _number(first[1]) * 1e9
        if len(first) > 5 and int(_number(first[5])) != 1:
            raise ValueError(f"normalization state {first[5]}, not 1 (full)")
    return GravityTable(gm, radius, tuple(_row(words) for words in lines))


def _row(words: list[str]) -> Row:
    return int(words[0]), int(words[1]), _number(words[2]), _number(words[3])


def _number(word: str) -> float:
    """A number, also with Fortran's exponent."""
    value = float(word.upper().replace("D", "E"))
    if not abs(value) < 1e30:
        raise ValueError(f"{word} is no number of a gravity field")
    return value
