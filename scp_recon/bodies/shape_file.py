"""Read shape models from files: OBJ, and SPICE DSK with the extra [spice]."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from scp_recon.bodies.kernels import read_dsk
from scp_recon.bodies.surface import Mesh
from scp_recon.errors import InputError
from scp_recon.files import read_text

ENTRY = "body.shape_file"
BYTES_MAX = 400_000_000
"""Three million facets, the largest shape model of an asteroid, take half of it."""


def read_shape(
    path: Path,
    unit: str | None,
    normal_radius_m: float = 0.0,
    naif_id: int | None = None,
    entry: str = ENTRY,
) -> Mesh:
    """Read a DSK (.bds) of the body `naif_id`, or an OBJ in a unit, "m" or "km", named by an entry.

    Raises:
        InputError: if the file cannot be read, is no mesh of triangles, or its unit is not given.
    """
    if path.suffix.lower() == ".bds":
        vertices, facets = read_dsk(path, naif_id)
    else:
        if unit is None:
            raise InputError(
                "body.shape_unit", "nothing", 'must be "m" or "km": an OBJ has no units'
            )
        vertices, facets = _read_obj(path, entry)
        vertices = vertices * {"m": 1.0, "km": 1000.0}[unit]
    if len(facets) < 4 or facets.min() < 0 or facets.max() >= len(vertices):
        raise InputError(entry, str(path), "must be facets of its own vertices, four at least")
    if not np.isfinite(vertices).all() or np.abs(vertices).max() > 1e12:
        raise InputError(entry, str(path), "must have finite coordinates")
    return Mesh(vertices, facets, normal_radius_m)


def _read_obj(path: Path, entry: str) -> tuple[np.ndarray, np.ndarray]:
    """Parse vertices and triangles; polygons become fans, textures and normals are ignored."""
    vertices: list[list[float]] = []
    facets: list[tuple[int, int, int]] = []
    lines = read_text(path, f"{entry} {path}", "shape model", BYTES_MAX).splitlines()
    for number, line in enumerate(lines, start=1):
        kind, *values = line.split() or [""]
        try:
            if kind == "v":
                x, y, z = map(float, values[:3])
                vertices.append([x, y, z])
            elif kind == "f":
                given = [int(value.partition("/")[0]) for value in values]
                # Counted from 1, or backwards from the last vertex so far.
                corners = [i - 1 if i > 0 else len(vertices) + i for i in given]
                facets += [(corners[0], *pair) for pair in itertools.pairwise(corners[1:])]
        except (ValueError, OverflowError):
            raise InputError(
                entry, f"{path}, line {number}: {line[:60]!r}", "must be an OBJ of v and f lines"
            ) from None
    try:
        corners_of = np.array(facets, dtype=np.intp).reshape(-1, 3)
    except OverflowError:
        raise InputError(entry, str(path), "must be an OBJ of v and f lines") from None
    return np.array(vertices, dtype=float).reshape(-1, 3), corners_of
