"""Read SPICE kernels: rotation (PCK), heliocentric state (SPK), shape (DSK), spacecraft states.

Needs the extra [spice]. SPICE has one state in a process and no thread may share it: whatever uses
SPICE does so in `spice_alone`. Kernels that the user has loaded are loaded again after each reading.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np

from formulations.arrays import Array, Indices
from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.errors import InputError, imported

SUN = 10
"""NAIF's number."""
CENTURY_DAYS = 36_525.0


@dataclass(frozen=True)
class PckRotation:
    """Rotation of a body from a PCK, with radii if the PCK has them.

    Attributes:
        pole_ra_deg, pole_dec_deg: at the epoch, J2000.
        prime_meridian: W0, W1, W2 in deg and days.
        radii_m: along x, y and z.
    """

    pole_ra_deg: float
    pole_dec_deg: float
    prime_meridian: tuple[float, float, float]
    radii_m: tuple[float, float, float] | None


def read_pck(path: Path, naif_id: int, days: float) -> PckRotation:
    """Rotation of a body at an epoch in TDB days past J2000.

    The pole is constant, as at the epoch: poles in asteroids' kernels have no rates.

    Raises:
        InputError: if spiceypy is missing, the file is no kernel, or it lacks the body.
    """
    entry = "body.pck_file"
    with _kernels(entry, [path]) as spice:

        def values(item: str) -> list[float]:
            if not spice.bodfnd(naif_id, item):
                return []
            count, padded = spice.bodvcd(naif_id, item, 10)
            return [float(x) for x in padded[:count]]

        pole_ra, pole_dec, meridian = (values(item) for item in ("POLE_RA", "POLE_DEC", "PM"))
        radii = values("RADII")
        nutation = values("NUT_PREC_PM") + values("NUT_PREC_RA") + values("NUT_PREC_DEC")
    if not (pole_ra and pole_dec and meridian) or len(meridian) > 3:
        raise InputError(
            entry, str(path), f"must hold POLE_RA, POLE_DEC and PM of body {naif_id} (body.naif_id)"
        )
    if any(nutation):
        raise InputError(
            entry, str(path), "must be without nutation: the body turns uniformly here"
        )

    def at_epoch(coefficients: list[float]) -> float:
        return float(np.polynomial.polynomial.polyval(days / CENTURY_DAYS, coefficients))

    w0, w1, w2 = (*meridian, 0.0, 0.0)[:3]
    return PckRotation(
        at_epoch(pole_ra),
        at_epoch(pole_dec),
        (w0, w1, w2),
        (radii[0] * 1e3, radii[1] * 1e3, radii[2] * 1e3) if len(radii) == 3 else None,
    )


def read_heliocentric(
    paths: Sequence[Path], naif_id: int, seconds: float
) -> tuple[list[float], list[float]]:
    """Position (km) and velocity (km/s) from the Sun, J2000, geometric, at TDB seconds past J2000.

    Raises:
        InputError: if spiceypy is missing, a file is no kernel, or they do not cover the epoch.
    """
    what = f"body {naif_id} (body.naif_id) from the Sun ({SUN}) at the epoch"
    (state,) = _geometric("sun.spk_files", paths, (naif_id, SUN), [seconds], what)
    return state[:3].tolist(), state[3:].tolist()


def read_dsk(path: Path, naif_id: int | None = None) -> tuple[Array, Indices]:
    """Read vertices in m and triangles (indices from 0) from a DSK with one segment of type 2.

    Raises:
        InputError: if spiceypy is missing, the file is not such a kernel, or it belongs to another
            body.
    """
    entry = "body.shape_file"
    if path.is_fifo():
        raise InputError(entry, str(path), "must be a readable kernel")
    with _kernels(entry, []) as spice:
        handle = None
        try:
            with reachable(path) as name:
                handle = spice.dasopr(name)
            segment = spice.dlabfs(handle)
            described = spice.dskgd(handle, segment)
            if described.dtype != 2:
                raise InputError(entry, str(path), "must hold a plate model (DSK type 2)")
            if naif_id is not None and described.center != naif_id:
                given = f"{path}, of body {described.center}"
                raise InputError(entry, given, f"must be of body {naif_id} (body.naif_id)")
            with spice.no_found_check():
                _, another = spice.dlafns(handle, segment)
            if another:
                raise InputError(entry, f"{path}, of several segments", "must hold one shape alone")
            vertex_count, plate_count = spice.dskz02(handle, segment)
            vertices = spice.dskv02(handle, segment, 1, vertex_count)
            plates = spice.dskp02(handle, segment, 1, plate_count)
        except spice.SpiceyError as error:
            raise _no_kernel(entry, [path], error) from None
        finally:
            if handle is not None:
                spice.dascls(handle)
    return np.array(vertices) * 1e3, np.array(plates, dtype=np.intp) - 1


_ALONE = RLock()
NAME_MAX = 255
"""Characters of a file's name that SPICE reads."""
SEGMENTS = 20_000
"""Size of a window: twice the disjoint spans that a kernel may have of a body."""


@contextmanager
def spice_alone(entry: str) -> Iterator[Any]:
    """SPICE for one thread at a time; others wait.

    Raises:
        InputError: naming the entry, if spiceypy is missing.
    """
    spiceypy = imported(entry, "spice", "spiceypy")
    with _ALONE:
        yield spiceypy


@contextmanager
def _kernels(entry: str, paths: Sequence[Path]) -> Iterator[Any]:
    """SPICE with these kernels loaded and no others."""
    for path in paths:
        if not path.is_file():
            raise InputError(entry, str(path), "must be a readable kernel")
    with spice_alone(entry) as spiceypy, spiceypy.KernelPool([]):
        try:
            for path in paths:
                _load(spiceypy, path)
        except spiceypy.SpiceyError as error:
            raise _no_kernel(entry, paths, error) from None
        yield spiceypy


@contextmanager
def reachable(path: Path) -> Iterator[str]:
    """Name by which SPICE finds a file: from its own folder, if the whole path is too long."""
    if len(os.fsencode(path)) <= NAME_MAX:
        yield str(path)
    else:
        with chdir(path.parent):
            yield path.name


def _load(spiceypy: Any, path: Path) -> None:
    """Load a kernel; a list of kernels also from its own folder, as an exported one names them."""
    try:
        with reachable(path) as name:
            spiceypy.furnsh(name)
    except spiceypy.SpiceyError:
        if path.suffix.lower() != ".tm":
            raise
        with chdir(path.parent):
            spiceypy.furnsh(path.name)


def _no_kernel(entry: str, paths: Sequence[Path], error: Any) -> InputError:
    why = error.short
    if "NOSUCHFILE" in why:  # of a list of kernels
        why += f" {' '.join(error.long.split())}"
    return InputError(
        entry, ", ".join(map(str, paths)), f"must be a SPICE kernel of its kind: {why}"
    )


def number_of(paths: Sequence[Path], name: str, entry: str) -> int | None:
    """NAIF's number of a body by its name, or the number itself in digits; None if unknown."""
    with _kernels(entry, paths) as spice:
        try:
            return int(spice.bods2c(name))
        except spice.SpiceyError:
            return None


def read_gm(paths: Sequence[Path], naif_id: int, entry: str) -> float | None:
    """Gravitational parameter of a body in m^3/s^2; None where no kernel has it."""
    with _kernels(entry, paths) as spice:
        if not spice.bodfnd(naif_id, "GM"):
            return None
        return float(spice.bodvcd(naif_id, "GM", 1)[1][0]) * 1e9


def read_states(
    paths: Sequence[Path], spacecraft: int, naif_id: int, seconds: Array, entry: str
) -> Array:
    """States of a spacecraft about a body, geometric, J2000, m and m/s, shape (n, 6).

    The `seconds` are TDB past J2000, shape (n,); messages call the kernels `entry`.

    Raises:
        InputError: if spiceypy is missing, a file is no kernel, or they do not cover the times.
    """
    what = f"spacecraft {spacecraft} about body {naif_id} throughout"
    return 1e3 * _geometric(entry, paths, (spacecraft, naif_id), seconds.tolist(), what)


def _geometric(
    entry: str, paths: Sequence[Path], pair: tuple[int, int], seconds: Sequence[float], what: str
) -> Array:
    """States of the first of a pair from the second, J2000, km and km/s, shape (n, 6)."""
    target, center = pair
    with _kernels(entry, paths) as spice:
        try:
            return np.array([spice.spkgeo(target, t, "J2000", center)[0] for t in seconds])
        except spice.SpiceyError as error:
            given = ", ".join(map(str, paths))
            if spans := [span for one in pair for span in _spans(spice, one)]:
                given += f" ({'; '.join(spans)})"
            ends = " to ".join(map(_tdb, dict.fromkeys((seconds[0], seconds[-1]))))
            allowed = f"must give {what}, {ends} TDB: {error.short}"
            raise InputError(entry, given, allowed) from None


def _spans(spice: Any, body: int) -> Iterator[str]:
    """Times in TDB for which each loaded file has a body.

    Files are searched by their handles: the names of those loaded from their own folder lead nowhere.
    """
    for number in range(spice.ktotal("SPK")):
        file, _, _, handle = spice.kdata(number, "SPK")
        times = spice.cell_double(SEGMENTS)
        spice.dafbfs(handle)
        while spice.daffna():
            (begin, end), (target, *_) = spice.dafus(spice.dafgs(), 2, 6)
            if target == body:
                spice.wninsd(begin, end, times)
        for begin, end in (spice.wnfetd(times, k) for k in range(spice.wncard(times))):
            yield f"{Path(file).name} has {body} from {_tdb(begin)} to {_tdb(end)} TDB"


def _tdb(seconds: float) -> str:
    """Calendar date to the second of TDB seconds past J2000."""
    return (J2000_TDB + timedelta(seconds=round(seconds))).isoformat()
