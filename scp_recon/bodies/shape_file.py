"""Read shape models from files: OBJ, and SPICE DSK with the extra [spice]."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from formulations.arrays import Array, Indices
from scp_recon.bodies.kernels import read_dsk
from scp_recon.bodies.surface import Mesh
from scp_recon.errors import InputError
from scp_recon.files import read_text

ENTRY = "body.shape_file"
BYTES_MAX = 400_000_000
"""Three million facets, the largest shape model of an asteroid, take half of it."""
CLOSED = "must be closed: each edge the side of two facets"


def read_shape(
    path: Path,
    unit: str | None,
    normal_radius_m: float = 0.0,
    naif_id: int | None = None,
    entry: str = ENTRY,
) -> Mesh:
    """Read a DSK (.bds) of the body `naif_id`, or an OBJ in a unit, "m" or "km", named by an entry.

    Facets that turn against their neighbours are turned round, as the mesh is closed.

    Raises:
        InputError: if the file cannot be read, is no closed mesh, or its unit is not given.
    """
    if path.suffix.lower() == ".bds":
        vertices, facets = read_dsk(path, naif_id)
        lines = np.arange(1, len(facets) + 1)
    else:
        if unit is None:
            raise InputError(
                "body.shape_unit", "nothing", 'must be "m" or "km": an OBJ has no units'
            )
        vertices, facets, lines = _read_obj(path, entry)
        vertices = vertices * {"m": 1.0, "km": 1000.0}[unit]
    if len(facets) < 4:
        raise InputError(entry, str(path), "must have four facets at least")
    if not np.isfinite(vertices).all() or np.abs(vertices).max() > 1e12:
        raise InputError(entry, str(path), "must have finite coordinates")

    def fail(facet: int, fault: str, allowed: str) -> InputError:
        word = "plate" if path.suffix.lower() == ".bds" else "line"
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
    flat = (facets == np.roll(facets, 1, axis=1)).any(
        axis=1
    )  # a side of no length: it bounds nothing
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
