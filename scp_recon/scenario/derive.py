"""Derive a complete scenario's entries from the given ones: one way, in the order of `derive`.

Epoch, rotation, gravity, Sun, site and boundary are each a subject. A given value that can also be
computed is checked against the computed one. A subject with missing entries is left unchanged, and
the schema reports them. A new derived entry is entered by the function of its subject; if it belongs
to the value of another entry, `given.inherit` says so in one line.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from scp_recon.bodies.catalogue import DAY_S, J2000_TDB, PackagedBody, packaged_body
from scp_recon.bodies.files import (
    AttitudeTable,
    GravityTable,
    read_attitude,
    read_gravity,
    read_shape,
)
from scp_recon.bodies.kernels import read_heliocentric, read_pck
from scp_recon.bodies.surface import angle_deg, direction_of
from scp_recon.errors import InputError
from scp_recon.scenario import given as entries_of
from scp_recon.scenario.body import (
    DEGREE_MAX,
    FACETS_MAX,
    Attitude,
    Body,
    Boundary,
    HomeOrbit,
    SiteSection,
    Sun,
)
from scp_recon.scenario.fields import Section
from scp_recon.scenario.given import (
    Given,
    check,
    check_share,
    copied,
    entries,
    fill,
    has,
    keys,
    lacks,
    value_of,
)
from scp_recon.scenario.site import check_solid, derive_site
from scp_recon.scenario.time_scales import tdb_of_utc

POLE, MERIDIAN, STATE, ENDS = map(
    keys, (entries_of.POLE, entries_of.MERIDIAN, entries_of.STATE, entries_of.ENDS)
)


def derive(given: Mapping[str, Any], changes: Mapping[str, Any] | None = None) -> Given:
    """Given entries with everything computed that can be.

    With `changes`, which are part of `given`, everything else is already complete. Only subjects
    that the changes affect are computed again, so the files of the other subjects need not exist any
    more.

    Raises:
        InputError: if a file cannot be used, an epoch is outside the known span, or a given value
            contradicts the computed one.
    """
    tables = copied(given)
    changed = None if changes is None else list(entries(changes))

    def is_new(*beginnings: str) -> bool:
        """Whether an entry that begins like this is new."""
        return changed is None or any(entry.startswith(beginnings) for entry in changed)

    _epoch(tables)
    _check_state_epoch(tables)
    body, days = tables.get("body"), _days(tables)
    if not isinstance(body, dict) or not _well_formed(body, Body):
        return tables
    known = packaged_body(body.get("name"))
    if known is not None:
        body.setdefault("naif_id", known.entries["naif_id"])
    turning = ("pole_", "prime_", "rotation_", "pck_", "naif_", "attitude", "name")
    if is_new(*(f"body.{key}" for key in turning)) or body.get("attitude") is not None:
        _rotation(body, known, days)
    if known is not None:  # where no kernel has told them
        fill(body, {k: v for k, v in known.entries.items() if k in ("radii_m", "companion")})
    pulling = ("gm_", "j2", "reference_", "gravity", "name", "solid", "shape_unit")
    if is_new(*(f"body.{key}" for key in pulling)):
        _gravity(body, known)
    if is_new("sun.", "epoch.", "body.name", "body.naif_"):
        _table(tables, "sun", Sun, lambda sun: _sun(sun, body, known, days))
    if is_new("site.", "body.name", "body.radii_", "body.shape_", "body.pck_"):
        _table(tables, "site", SiteSection, lambda site: derive_site(site, body))
    if is_new("boundary.", "body.gm_", "body.gravity_", "body.name"):
        gm = body.get("gm_m3_s2")
        _table(tables, "boundary", Boundary, lambda boundary: _boundary(boundary, gm))
    return tables


def _table(
    tables: Given, name: str, schema: type[Section], step: Callable[[dict[str, Any]], None]
) -> None:
    """Derive the entries of a table, which may be missing if all of it can be computed."""
    table = tables.get(name, {})
    if isinstance(table, dict) and _well_formed(table, schema):
        step(table)
        if table:
            tables[name] = table


def _well_formed(table: Mapping[str, Any], schema: type[Section]) -> bool:
    """Whether a table's only faults are missing entries."""
    try:
        schema.model_validate_json(json.dumps(table, default=str))
    except ValidationError as error:
        # An item that a list lacks is missing too, but deeper.
        problems = error.errors(include_url=False)
        return all(item["type"] == "missing" and len(item["loc"]) == 1 for item in problems)
    except (ValueError, RecursionError):
        return False
    return True


UTC_TOLERANCE_S = 0.001
"""Within which a given TDB is that of a given UTC: a file's milliseconds."""


def _epoch(tables: Given) -> None:
    """Enter TDB in the place of UTC; refuse both if they differ, as by a UTC that was taken for TDB."""
    epoch = tables.get("epoch")
    if not isinstance(epoch, dict) or epoch.get("utc") is None:
        return
    try:
        utc = datetime.fromisoformat(str(epoch["utc"]))
        given = datetime.fromisoformat(str(epoch["tdb"])) if "tdb" in epoch else None
    except ValueError:  # the schema tells
        return
    computed = tdb_of_utc(utc, "epoch.utc")
    if given is None:
        epoch["tdb"] = computed.isoformat()
    elif given.tzinfo is None:
        off = abs((given - computed).total_seconds())
        why = f"which is epoch.utc in TDB; they are {off:.3f} s apart"
        check("epoch.tdb", given.isoformat(), off <= UTC_TOLERANCE_S, computed.isoformat(), why)
    del epoch["utc"]


def _check_state_epoch(tables: Mapping[str, Any]) -> None:
    """Refuse an epoch other than that of the given Sun and prime meridian."""
    of_state, epoch = _days(tables, "sun.state_tdb"), _days(tables)
    if of_state is not None and epoch is not None and abs(of_state - epoch) * DAY_S > 1.0:
        given, known = (str(value_of(tables, entry)) for entry in ("epoch.tdb", "sun.state_tdb"))
        belong = "the Sun's state and the prime meridian at the epoch belong: give those of another"
        hint = f"must be {known} (sun.state_tdb), to which {belong} epoch with it"
        raise InputError("epoch.tdb", given, hint)


def _days(tables: Mapping[str, Any], entry: str = "epoch.tdb") -> float | None:
    """TDB days past J2000 of the epoch, or of another date; None if it is missing or no date."""
    try:
        tdb = datetime.fromisoformat(str(value_of(tables, entry)))
        return (tdb - J2000_TDB).total_seconds() / DAY_S
    except (ValueError, TypeError):
        return None


POLE_TOLERANCE_DEG, MERIDIAN_TOLERANCE_DEG, RATE_TOLERANCE = 0.1, 0.1, 1e-4
"""Tolerances within which given values agree with computed ones: angles; rate, relative."""


def _rotation(body: dict[str, Any], known: PackagedBody | None, days: float | None) -> None:
    """Enter pole and W0, W1, W2 in the table `[body]`.

    A period of P hours is W1 = 360 * 24 / P and W2 = 0; an angle W at the epoch, d TDB days past J2000,
    is W0 = W - W1 d - W2 d^2.
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
    if is_read := lacks(body, "attitude"):
        read = read_attitude(Path(body["attitude_file"]))
        body["attitude"] = {"tdb_s": read.tdb_s.tolist(), "quaternions": read.quaternions.tolist()}
    try:
        given = Attitude.model_validate_json(json.dumps(body["attitude"]))
    except ValidationError as error:
        fault = error.errors()[0]
        if is_read and fault["type"] == "value_error":
            allowed = fault["msg"].removeprefix("Value error, ")
            raise InputError("body.attitude_file", str(body["attitude_file"]), allowed) from None
        return  # the schema tells what is wrong
    if days is not None:
        table = AttitudeTable(np.array(given.tdb_s), np.array(given.quaternions))
        ra, dec, meridian, rate = table.iau(days)
        _check_pole(body, (ra, dec), "attitude")
        at_epoch = ra, dec, (meridian - rate * days) % 360.0, rate, 0.0
        fill(body, dict(zip((*POLE, *MERIDIAN), at_epoch, strict=True)))


def _from_kernel(body: dict[str, Any], days: float) -> None:
    _require_number(body, "pck_file")
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
        needs = "must stand alone, or beside all of W0, W1 and W2"
        raise InputError("body.pck_file", body["pck_file"], needs)
    if kernel.radii_m is not None and lacks(body, "radii_m"):
        body["radii_m"] = list(kernel.radii_m)


def _require_number(body: dict[str, Any], kernels: str) -> None:
    if not has(body, "naif_id"):
        needs = f"must be NAIF's number of the body in {kernels}"
        raise InputError("body.naif_id", "nothing", needs)


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


GRAVITY_TOLERANCE = 0.01
"""Relative tolerance within which a given GM or J2 agrees with the file's."""


def _gravity(body: dict[str, Any], known: PackagedBody | None) -> None:
    """Enter GM, J2, its radius, and the field if there is a file."""
    if has(body, "gravity_file"):
        table = read_gravity(Path(body["gravity_file"]), DEGREE_MAX)
        if table.gm_m3_s2 is not None:
            fill(body, {"gm_m3_s2": table.gm_m3_s2})
            given, source = body["gm_m3_s2"], "gravity_file"
            check_share("body.gm_m3_s2", given, table.gm_m3_s2, GRAVITY_TOLERANCE, source)
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
        needs = f"must have at most {FACETS_MAX}: a coarser model"
        raise InputError(entry, f"{len(mesh.facets)} facets", needs)
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
        needs = "must be the radius of gravity_file, which has none"
        raise InputError("body.reference_radius_m", "nothing", needs)
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
    check_share("body.j2", body["j2"], there, GRAVITY_TOLERANCE, source)


SUN_DIRECTION_DEG, SUN_DISTANCE, SUN_VELOCITY_KM_S = 0.1, 0.01, 0.5
"""Tolerances within which a given Sun agrees with the computed one."""


def _sun(
    sun: dict[str, Any], body: dict[str, Any], known: PackagedBody | None, days: float | None
) -> None:
    """Enter the body's heliocentric state at the epoch, in TDB days past J2000; check a given one."""
    if days is None:
        return
    if has(sun, "spk_files"):
        _require_number(body, "spk_files")
        paths = [Path(name) for name in sun["spk_files"]]
        state, source = read_heliocentric(paths, body["naif_id"], days * DAY_S), "sun.spk_files"
    elif known is not None and (known.covers(days) or lacks(sun, *STATE)):
        position, velocity = known.heliocentric(days)
        state = position.tolist(), velocity.tolist()
        source = f"the packaged elements of {known.entries['name']}"
    else:
        return
    fill(sun, dict(zip(STATE, state, strict=True)))
    (position, velocity), source = map(np.array, state), f"by {source}, to"
    given, moving = (np.array(sun[key], dtype=float) for key in STATE)
    distance = float(np.linalg.norm(position))
    near = angle_deg(given, position) <= SUN_DIRECTION_DEG
    near &= abs(float(np.linalg.norm(given)) - distance) <= SUN_DISTANCE * distance
    slow = float(np.linalg.norm(moving - velocity)) <= SUN_VELOCITY_KM_S
    within = f"{SUN_DIRECTION_DEG:g} deg and {SUN_DISTANCE:g} of the distance (or be left out)"
    check(f"sun.{STATE[0]}", given, near, position, f"{source} {within}")
    within = f"{SUN_VELOCITY_KM_S:g} km/s (or be left out)"
    check(f"sun.{STATE[1]}", moving, slow, velocity, f"{source} {within}")


HOME_TOLERANCE = 1e-6
"""Relative tolerance of radius and speed within which given states are those of the home orbit."""


def _boundary(boundary: dict[str, Any], gm: object) -> None:
    """Enter the states of a home orbit, if there is one and GM, m^3/s^2, is known; check given ones."""
    if boundary.get("home") is None or not isinstance(gm, int | float):
        return
    home = HomeOrbit.model_validate_json(json.dumps(boundary["home"]))
    states = [
        home.state(float(np.deg2rad(span[0])), float(gm))
        for span in (home.departure_deg, home.arrival_deg)
    ]
    computed = [part for state in states for part in (state[:3], state[3:])]
    for key, value in zip(ENDS, computed, strict=True):
        given = boundary.setdefault(key, value.tolist())
        if not np.allclose(given, value, rtol=0.0, atol=HOME_TOLERANCE * np.linalg.norm(value)):
            needs = "must be left out beside boundary.home, from which it follows"
            raise InputError(f"boundary.{key}", str(given)[:80], needs)
