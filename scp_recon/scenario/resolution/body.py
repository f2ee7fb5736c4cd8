"""Compute rotation, gravity and Sun of a body from kernels and files, the catalogue, or a period."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from scp_recon.bodies.attitude import AttitudeTable, read_attitude
from scp_recon.bodies.catalogue import DAY_S, PackagedBody
from scp_recon.bodies.gravity_file import GravityTable, read_gravity
from scp_recon.bodies.kernels import read_heliocentric, read_pck
from scp_recon.bodies.shape_file import read_shape
from scp_recon.bodies.surface import direction_of
from scp_recon.errors import InputError
from scp_recon.scenario import dependencies
from scp_recon.scenario.body import DEGREE_MAX, FACETS_MAX, Attitude
from scp_recon.scenario.dependencies import keys
from scp_recon.scenario.resolution.agreement import angle_deg, check, check_share, fill, has, lacks
from scp_recon.scenario.resolution.site import check_solid

POLE, MERIDIAN, STATE = (
    keys(dependencies.POLE),
    keys(dependencies.MERIDIAN),
    keys(dependencies.STATE),
)
POLE_TOLERANCE_DEG, MERIDIAN_TOLERANCE_DEG, RATE_TOLERANCE = 0.1, 0.1, 1e-4
"""Tolerances within which given values agree with computed ones: angles; rate, relative."""


def resolve_rotation(body: dict[str, Any], known: PackagedBody | None, days: float | None) -> None:
    """Enter pole and W0, W1, W2 in the table `[body]`.

    A period of P hours is W1 = 360 * 24 / P and W2 = 0; an angle W at the epoch, d TDB days past J2000,
    is W0 = W - W1 d - W2 d^2.

    Raises:
        InputError: if a kernel cannot be used, or entries contradict one another.
    """
    if has(body, "pck_file") and days is not None:
        _from_kernel(body, days)
    if known is not None and "attitude_file" in known.entries:
        if lacks(body, *POLE, *MERIDIAN, "rotation_period_h", "attitude"):
            fill(body, {"attitude_file": known.entries["attitude_file"]})
    elif known is not None and lacks(body, "attitude_file", "attitude"):
        if lacks(body, *POLE):
            fill(body, {key: known.entries[key] for key in POLE})
        if lacks(body, *MERIDIAN, "rotation_period_h"):
            spin = MERIDIAN if lacks(body, "prime_meridian_at_epoch_deg") else MERIDIAN[1:]
            fill(body, {key: known.entries[key] for key in spin})
    if has(body, "attitude_file") or has(body, "attitude"):
        _from_attitudes(body, days)
    if has(body, "rotation_period_h"):
        rate = 360.0 * 24.0 / body["rotation_period_h"]
        fill(body, {MERIDIAN[1]: rate, MERIDIAN[2]: 0.0})
        source = "body.rotation_period_h"
        check_share(f"body.{MERIDIAN[1]}", body[MERIDIAN[1]], rate, RATE_TOLERANCE, source)
    if has(body, "prime_meridian_at_epoch_deg", MERIDIAN[1]) and days is not None:
        fill(body, {MERIDIAN[2]: 0.0})
        turned = body[MERIDIAN[1]] * days + body[MERIDIAN[2]] * days**2
        at_epoch = body["prime_meridian_at_epoch_deg"]
        fill(body, {MERIDIAN[0]: (at_epoch - turned) % 360.0})
        _check_meridian(at_epoch, body, days, "prime_meridian_at_epoch_deg")


def _from_attitudes(body: dict[str, Any], days: float | None) -> None:
    """Enter a table of attitudes, and pole and meridian that turn with it at the epoch."""
    if lacks(body, "attitude"):
        read = read_attitude(Path(body["attitude_file"]))
        body["attitude"] = {"tdb_s": read.tdb_s.tolist(), "quaternions": read.quaternions.tolist()}
    try:
        given = Attitude.model_validate_json(json.dumps(body["attitude"]))
    except ValidationError:  # the schema tells what is wrong
        return
    if days is not None:
        table = AttitudeTable(np.array(given.tdb_s), np.array(given.quaternions))
        ra, dec, meridian, rate = table.iau(days)
        _check_pole(body, (ra, dec), "attitude")
        at_epoch = ra, dec, (meridian - rate * days) % 360.0, rate, 0.0
        fill(body, dict(zip((*POLE, *MERIDIAN), at_epoch, strict=True)))


def _from_kernel(body: dict[str, Any], days: float) -> None:
    if not has(body, "naif_id"):
        raise InputError("body.naif_id", "nothing", "must be NAIF's number of the body in pck_file")
    kernel = read_pck(Path(body["pck_file"]), body["naif_id"], days)
    pole = kernel.pole_ra_deg, kernel.pole_dec_deg
    _check_pole(body, pole, "pck_file")
    fill(body, dict(zip(POLE, pole, strict=True)))
    if lacks(body, *MERIDIAN, "rotation_period_h", "prime_meridian_at_epoch_deg"):
        fill(body, dict(zip(MERIDIAN, kernel.prime_meridian, strict=True)))
    elif has(body, *MERIDIAN):
        w0, w1, w2 = kernel.prime_meridian
        _check_meridian(w0 + w1 * days + w2 * days**2, body, days, "pck_file")
    else:
        raise InputError(
            "body.pck_file", body["pck_file"], "must stand alone, or beside all of W0, W1 and W2"
        )
    if kernel.radii_m is not None and lacks(body, "radii_m"):
        body["radii_m"] = list(kernel.radii_m)


def _check_pole(body: dict[str, Any], pole: tuple[float, float], source: str) -> None:
    if has(body, *POLE):
        given = body[POLE[0]], body[POLE[1]]
        apart = angle_deg(direction_of(given[1], given[0]), direction_of(pole[1], pole[0]))
        why = f"the pole in {source}, to {POLE_TOLERANCE_DEG:g} deg"
        check("body.pole_ra_deg, pole_dec_deg", given, apart <= POLE_TOLERANCE_DEG, pole, why)


def _check_meridian(at_epoch: float, body: dict[str, Any], days: float, source: str) -> None:
    w0, w1, w2 = (body[key] for key in MERIDIAN)
    given = (w0 + w1 * days + w2 * days**2) % 360.0
    apart = abs((given - at_epoch + 180.0) % 360.0 - 180.0)
    check(
        "body.prime_meridian_deg",
        f"{given:.6g} deg at the epoch",
        apart <= MERIDIAN_TOLERANCE_DEG,
        f"{at_epoch % 360.0:.6g} deg",
        f"by body.{source}, to {MERIDIAN_TOLERANCE_DEG:g} deg",
    )


TOLERANCE = 0.01
"""Relative tolerance within which a given GM or J2 agrees with the file's."""


def resolve_gravity(body: dict[str, Any], known: PackagedBody | None) -> None:
    """Enter GM, J2, its radius, and the field if there is a file.

    Raises:
        InputError: if the file cannot be used, or does not agree with what is given.
    """
    if has(body, "gravity_file"):
        table = read_gravity(Path(body["gravity_file"]), DEGREE_MAX)
        if table.gm_m3_s2 is not None:
            fill(body, {"gm_m3_s2": table.gm_m3_s2})
            source = "gravity_file"
            check_share("body.gm_m3_s2", body["gm_m3_s2"], table.gm_m3_s2, TOLERANCE, source)
        _enter_field(body, table, known)
    elif has(body, "gravity", "j2", "reference_radius_m"):
        field = body["gravity"]
        _check_j2(body, _j2(field["coefficients"]), field["reference_radius_m"], "gravity")
    if has(body, "solid_file"):
        _enter_solid(body)
    if known is not None:
        fill(body, {"gm_m3_s2": known.entries["gm_m3_s2"]})
        if lacks(body, "j2", "reference_radius_m"):
            fill(body, {key: known.entries[key] for key in ("j2", "reference_radius_m")})


def _enter_solid(body: dict[str, Any]) -> None:
    """Enter a homogeneous solid, and its J2 at its largest radius where none is given."""
    entry, name = "body.solid_file", body["solid_file"]
    unit, naif_id = body.get("shape_unit"), body.get("naif_id")
    mesh = read_shape(Path(name), unit, naif_id=naif_id, entry=entry)
    if len(mesh.facets) > FACETS_MAX:
        raise InputError(
            entry, f"{len(mesh.facets)} facets", f"must have at most {FACETS_MAX}: a coarser model"
        )
    (xx, yy, zz) = np.diag(check_solid(entry, name, mesh).inertia_m2).tolist()
    radius = float(np.linalg.norm(mesh.vertices_m, axis=1).max())
    if lacks(body, "j2", "reference_radius_m"):
        j2 = (zz - 0.5 * (xx + yy)) / radius**2
        fill(body, {"j2": j2, "reference_radius_m": radius})
    body["solid"] = {"vertices_m": mesh.vertices_m.tolist(), "facets": mesh.facets.tolist()}


def _enter_field(body: dict[str, Any], table: GravityTable, known: PackagedBody | None) -> None:
    """Enter a field, and its J2 = -sqrt(5) C20 where none is given; check a J2 that is."""
    radius = table.radius_m or body.get("reference_radius_m")
    if radius is None and known is not None:
        radius = known.entries["reference_radius_m"]
    if radius is None:
        raise InputError(
            "body.reference_radius_m",
            "nothing",
            "must be the radius of gravity_file, which has none",
        )
    j2 = _j2(table.rows)
    if lacks(body, "j2", "reference_radius_m"):
        fill(body, {"j2": j2, "reference_radius_m": radius})
    elif lacks(body, "j2"):  # at the given radius
        body["j2"] = j2 * (radius / body["reference_radius_m"]) ** 2
    if has(body, "j2", "reference_radius_m"):
        _check_j2(body, j2, radius, "gravity_file")
    body["gravity"] = {
        "reference_radius_m": radius,
        "coefficients": [list(row) for row in table.rows],
    }


def _j2(rows: Iterable[Sequence[float]]) -> float:
    """Unnormalised J2 of fully normalised coefficients."""
    return -math.sqrt(5.0) * next((c for n, m, c, _ in rows if (n, m) == (2, 0)), 0.0)


def _check_j2(body: dict[str, Any], j2: float, radius: float, source: str) -> None:
    """Refuse a J2 that does not agree with the field's."""
    there = j2 * (radius / body["reference_radius_m"]) ** 2
    check_share("body.j2", body["j2"], there, TOLERANCE, source)


DIRECTION_TOLERANCE_DEG, DISTANCE_TOLERANCE, VELOCITY_TOLERANCE_KM_S = 0.1, 0.01, 0.5
"""Tolerances within which a given Sun agrees with the computed one."""


def resolve_sun(
    sun: dict[str, Any], body: dict[str, Any], known: PackagedBody | None, days: float | None
) -> None:
    """Enter the body's heliocentric position and velocity at the epoch, in TDB days past J2000.

    Raises:
        InputError: if kernels cannot be used, the epoch is outside the packaged elements' span and no
            Sun is given, or a given Sun does not agree with the computed one.
    """
    if days is None:
        return
    if has(sun, "spk_files"):
        if not has(body, "naif_id"):
            raise InputError(
                "body.naif_id", "nothing", "must be NAIF's number of the body in spk_files"
            )
        paths = [Path(name) for name in sun["spk_files"]]
        state, source = read_heliocentric(paths, body["naif_id"], days * DAY_S), "sun.spk_files"
    elif known is not None and (known.covers(days) or lacks(sun, *STATE)):
        position, velocity = known.heliocentric(days)
        state = position.tolist(), velocity.tolist()
        source = f"the packaged elements of {known.entries['name']}"
    else:
        return
    fill(sun, dict(zip(STATE, state, strict=True)))
    _check(sun, np.array(state[0]), np.array(state[1]), source)


def _check(sun: dict[str, Any], position: Any, velocity: Any, source: str) -> None:
    given = np.array(sun[STATE[0]], dtype=float)
    distance = float(np.linalg.norm(position))
    near = bool(
        angle_deg(given, position) <= DIRECTION_TOLERANCE_DEG
        and abs(np.linalg.norm(given) - distance) <= DISTANCE_TOLERANCE * distance
    )
    within = f"to {DIRECTION_TOLERANCE_DEG:g} deg and {DISTANCE_TOLERANCE:g} of the distance"
    check(f"sun.{STATE[0]}", given, near, position, f"by {source}, {within} (or be left out)")
    moving = np.array(sun[STATE[1]], dtype=float)
    slow = float(np.linalg.norm(moving - velocity)) <= VELOCITY_TOLERANCE_KM_S
    within = f"to {VELOCITY_TOLERANCE_KM_S:g} km/s"
    check(f"sun.{STATE[1]}", moving, slow, velocity, f"by {source}, {within} (or be left out)")
