"""Read SPICE kernels: rotation (PCK), heliocentric state (SPK), shape (DSK), spacecraft states.

Needs the extra [spice]. Kernels that the user has loaded are loaded again after each reading.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from formulations.arrays import Array, Indices
from scp_recon.errors import InputError, needing

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
    with _kernels(entry, []) as spice:
        handle = None
        try:
            handle = spice.dasopr(str(path))
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


@contextmanager
def _kernels(entry: str, paths: Sequence[Path]) -> Iterator[Any]:
    """SPICE with these kernels loaded and no others."""
    with needing(entry, "spice", "spiceypy"):
        import spiceypy
    for path in paths:
        if not path.is_file():
            raise InputError(entry, str(path), "must be a readable kernel")
    with spiceypy.KernelPool([]):
        try:
            for path in paths:
                _load(spiceypy, path)
        except spiceypy.SpiceyError as error:
            raise _no_kernel(entry, paths, error) from None
        yield spiceypy


def _load(spiceypy: Any, path: Path) -> None:
    """Load a kernel; a list of kernels also from its own folder, as an exported one names them."""
    try:
        spiceypy.furnsh(str(path))
    except spiceypy.SpiceyError:
        if path.suffix.lower() != ".tm":
            raise
        with chdir(path.parent):
            spiceypy.furnsh(path.name)


def _no_kernel(entry: str, paths: Sequence[Path], error: Any) -> InputError:
    return InputError(
        entry, ", ".join(map(str, paths)), f"must be a SPICE kernel of its kind: {error.short}"
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
            raise InputError(entry, given, f"must give {what}: {error.short}") from None
