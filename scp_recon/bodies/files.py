"""Read files about a body: shapes (OBJ, DSK), gravity fields (gfc, SHA), tables of attitudes (CSV)."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from formulations.arrays import Array, Indices
from scp_recon.bodies.kernels import read_dsk
from scp_recon.bodies.surface import Mesh
from scp_recon.errors import InputError
from scp_recon.files import read_text

SHAPE, GRAVITY, ATTITUDE = "body.shape_file", "body.gravity_file", "body.attitude_file"
COLUMNS = ("tdb_s", "qw", "qx", "qy", "qz")
BYTES_MAX, TABLE_BYTES_MAX = 400_000_000, 2_000_000
"""Three million facets, the largest shape model of an asteroid, take half of the former."""
CLOSED = "must be closed: each edge the side of two facets"


def read_shape(
    path: Path,
    unit: str | None,
    normal_radius_m: float = 0.0,
    naif_id: int | None = None,
    entry: str = SHAPE,
) -> Mesh:
    """Read a DSK (.bds) of the body `naif_id`, or an OBJ in a unit, "m" or "km", which an entry names.

    Facets that turn against their neighbours are turned round, as the mesh is closed.

    Raises:
        InputError: if the file cannot be read, is no closed mesh, or its unit is not given.
    """
    is_dsk = path.suffix.lower() == ".bds"
    if is_dsk:
        vertices, facets = read_dsk(path, naif_id)
        lines = np.arange(1, len(facets) + 1)
    elif unit is None:
        raise InputError("body.shape_unit", "nothing", 'must be "m" or "km": an OBJ has no units')
    else:
        vertices, facets, lines = _read_obj(path, entry)
        vertices = vertices * {"m": 1.0, "km": 1000.0}[unit]
    if len(facets) < 4:
        raise InputError(entry, str(path), "must have four facets at least")
    if not np.isfinite(vertices).all() or np.abs(vertices).max() > 1e12:
        raise InputError(entry, str(path), "must have finite coordinates")

    def fail(facet: int, fault: str, allowed: str) -> InputError:
        word = "plate" if is_dsk else "line"
        return InputError(entry, f"{path}, {word} {lines[facet]}: {fault}", allowed)

    outside = ((facets < 0) | (facets >= len(vertices))).any(axis=1)
    if outside.any():
        raise fail(int(np.argmax(outside)), "a corner that is no vertex", "must be of its vertices")
    # Vertices may stand in a file twice, along a seam.
    _, same = np.unique(vertices, axis=0, return_inverse=True)
    flipped = _against_neighbours(same.ravel()[facets], fail)
    return Mesh(vertices, np.where(flipped[:, None], facets[:, ::-1], facets), normal_radius_m)


def _against_neighbours(facets: Indices, fail: Callable[[int, str, str], InputError]) -> Array:
    """Whether each facet turns against most others of its surface, shape (m,).

    Neighbours that turn alike run along their edge in opposite senses. Each facet has two nodes in a
    graph, as it is and turned round; an edge joins the nodes that turn alike, so that every closed
    surface becomes two components, of which that with more facets as they are is taken.

    Raises:
        InputError: made by `fail` of a facet, the fault and what is allowed, if an edge has no two
            facets, or a surface has one side alone.
    """
    # A side of no length bounds nothing.
    flat = (facets == np.roll(facets, 1, axis=1)).any(axis=1)
    owner = np.repeat(np.flatnonzero(~flat), 3)
    begin, end = facets[~flat].ravel(), np.roll(facets[~flat], -1, axis=1).ravel()
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    order = np.lexsort((high, low))
    _, first, sides = np.unique(
        np.stack([low, high], 1)[order], axis=0, return_index=True, return_counts=True
    )
    if (sides != 2).any():
        worst = order[first[sides != 2]]
        single = set(zip(low[worst].tolist(), high[worst].tolist(), strict=True))
        for facet in np.flatnonzero(flat).tolist():
            if single & set(itertools.combinations(sorted({*facets[facet].tolist()}), 2)):
                raise fail(facet, "a side of no length, beside an open edge", CLOSED)
        facet, count = int(owner[worst].min()), int(sides[sides != 2][np.argmin(owner[worst])])
        others = "no other facet has" if count == 1 else f"{count - 1} other facets have"
        raise fail(facet, f"an edge that {others}", CLOSED)
    one, other = order[first], order[first + 1]
    turned, count = (begin[one] == begin[other]).astype(int), len(facets)
    rows = np.concatenate([owner[one], owner[one] + count])
    columns = np.concatenate([owner[other] + count * turned, owner[other] + count * (1 - turned)])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * count, 2 * count))
    parts, label = connected_components(graph, directed=False)
    given, round_ = label[:count], label[count:]
    if (given == round_).any():
        raise fail(int(np.argmax(given == round_)), "a surface with one side alone", CLOSED)
    most = np.bincount(given, minlength=parts) + np.arange(parts) / (2.0 * parts)  # a tie is broken
    return np.asarray(most[given] < most[round_])


def _read_obj(path: Path, entry: str) -> tuple[Array, Indices, Indices]:
    """Parse vertices, triangles and their lines; polygons become fans, other records are ignored."""
    vertices: list[list[float]] = []
    facets: list[tuple[int, int, int]] = []
    of_facets: list[int] = []
    lines = read_text(path, f"{entry} {path}", "shape model", BYTES_MAX).splitlines()
    for number, line in enumerate(lines, start=1):
        kind, *values = line.partition("#")[0].split() or [""]
        try:
            if kind == "v":
                x, y, z = map(float, values[:3])
                vertices.append([x, y, z])
            elif kind == "f":
                given = [int(value.partition("/")[0]) for value in values]
                if len(given) < 3 or max(map(abs, given)) > 1e9 or 0 in given:
                    raise ValueError(line)
                # Counted from 1, or backwards from the last vertex so far.
                corners = [i - 1 if i > 0 else len(vertices) + i for i in given]
                facets += [(corners[0], *pair) for pair in itertools.pairwise(corners[1:])]
                of_facets += [number] * (len(corners) - 2)
        except (ValueError, OverflowError):
            raise InputError(
                entry, f"{path}, line {number}: {line[:60]!r}", "must be an OBJ of v and f lines"
            ) from None
    corners_of = np.array(facets, dtype=np.intp).reshape(-1, 3)
    return np.array(vertices, dtype=float).reshape(-1, 3), corners_of, np.array(of_facets)


# --- gravity fields ---------------------------------------------------------------------------------

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
    text = read_text(path, f"{GRAVITY} {path}", "gravity field", BYTES_MAX)
    try:
        table = _gfc(text) if "end_of_head" in text else _sha(text)
    except (ValueError, IndexError) as error:
        raise InputError(
            GRAVITY, f"{path} ({str(error)[:80]})", "must be an ICGEM .gfc or a PDS SHA table"
        ) from None
    for n, m, c, s in table.rows:  # of a field about the centre of mass
        if n == 0 and c != 0.0 and abs(c - 1.0) > SAME:
            raise InputError(GRAVITY, f"{path}, with C00 = {c:g}", "must have C00 = 1, or none")
        if n == 1 and max(abs(c), abs(s)) > SAME:
            given = f"{path}, with degree 1, order {m}: {c:g}, {s:g}"
            needs = f"must be about the centre of mass: below {SAME:g} in degree 1"
            raise InputError(GRAVITY, given, needs)
    rows = [row for row in table.rows if 0 < row[0] <= degree_max and any(row[2:])]
    if not rows:
        raise InputError(GRAVITY, str(path), "must hold coefficients from degree 2 on")
    pairs = {(n, m) for n, m, _, _ in rows}
    if len(pairs) != len(rows) or any(not 0 <= m <= n for n, m in pairs):
        raise InputError(
            GRAVITY, str(path), "must hold each degree and order once, order <= degree"
        )
    if any(abs(c) > 1.0 or abs(s) > 1.0 for _, _, c, s in rows):
        raise InputError(GRAVITY, str(path), "must be normalised coefficients, between -1 and 1")
    return GravityTable(table.gm_m3_s2, table.radius_m, tuple(rows))


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


# --- attitudes --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class AttitudeTable:
    """A table of attitudes; SciPy's `RotationSpline` interpolates with continuous acceleration.

    Attributes:
        tdb_s: times, TDB past J2000, ascending, shape (n,).
        quaternions: from body-fixed components to J2000, scalar first, shape (n, 4).
    """

    tdb_s: Array
    quaternions: Array

    @cached_property
    def _spline(self) -> Any:
        from scipy.spatial.transform import Rotation, RotationSpline  # what turns evenly needs none

        return RotationSpline(self.tdb_s, Rotation.from_quat(self.quaternions, scalar_first=True))

    def matrix(self, tdb_s: npt.ArrayLike) -> Array:
        """Rotations from body-fixed to J2000 at times, shape (..., 3, 3).

        Raises:
            InputError: before the first row or after the last.
        """
        times = np.asarray(tdb_s, dtype=float)
        first, last = self.tdb_s[0], self.tdb_s[-1]
        if times.size and not first <= times.min() <= times.max() <= last:
            given = f"rows from {first:.0f} to {last:.0f} s of TDB past J2000"
            needed = f"must span {times.min():.0f} to {times.max():.0f} s"
            raise InputError(ATTITUDE, given, needed)
        return np.asarray(self._spline(times.ravel()).as_matrix()).reshape(*times.shape, 3, 3)

    def spin(self, tdb_s: float) -> Array:
        """Angular velocity at a time, body-fixed, rad/s, shape (3,)."""
        return np.asarray(self._spline(tdb_s, 1))

    def iau(self, days: float) -> tuple[float, float, float, float]:
        """Right ascension and declination of body-fixed z, W and its rate at an epoch; deg, deg/day.

        The rate is the whole spin. The epoch is in TDB days past J2000.
        """
        axes, spin = self.matrix(86_400.0 * days), self.spin(86_400.0 * days)
        x, z = axes[:, 0], axes[:, 2]
        ra, dec = np.arctan2(z[1], z[0]), np.arcsin(np.clip(z[2], -1.0, 1.0))
        node = np.array([-np.sin(ra), np.cos(ra), 0.0])
        meridian = np.arctan2(x @ np.cross(z, node), x @ node)
        angles = np.rad2deg([ra, dec, meridian, np.linalg.norm(spin) * 86_400.0])
        return float(angles[0]), float(angles[1]), float(angles[2]) % 360.0, float(angles[3])


def read_attitude(path: Path) -> AttitudeTable:
    """Read attitudes from a CSV with the header tdb_s,qw,qx,qy,qz; lines with # are comments.

    Raises:
        InputError: if the file cannot be read, or is not such a table.
    """
    text = read_text(path, ATTITUDE, "table of attitudes", TABLE_BYTES_MAX)
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    header, *rows = [one for one in lines if one[1] and one[1][0] != "#"] or [(1, "")]
    number, line = header
    wanted, values = f"must be {','.join(COLUMNS)}, the header of a table", list[list[float]]()
    try:
        if tuple(name.strip() for name in line.split(",")) != COLUMNS:
            raise ValueError(line)
        wanted = f"must be {len(COLUMNS)} finite numbers"
        while len(values) < len(rows):
            number, line = rows[len(values)]
            row = [float(word) for word in line.split(",")]
            if len(row) != len(COLUMNS) or not np.isfinite(row).all():
                raise ValueError(line)
            values.append(row)
    except ValueError:
        raise InputError(ATTITUDE, f"{path}, line {number}: {line[:60]!r}", wanted) from None
    table = np.array(values).reshape(-1, len(COLUMNS))
    return AttitudeTable(table[:, 0], table[:, 1:])
