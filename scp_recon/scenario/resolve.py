"""Compute the numbers that planning needs from those the user gave.

Rotation, gravity, Sun and site are each a subject. A given value that can also be computed is
checked against the computed one. A subject with missing entries is left unchanged, and the schema
reports them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from scp_recon.bodies.catalogue import DAY_S, J2000_TDB, packaged_body
from scp_recon.errors import InputError
from scp_recon.scenario.body import Body, SiteSection, Sun
from scp_recon.scenario.boundary import Boundary, HomeOrbit
from scp_recon.scenario.dependencies import ENDS, Tables, entries, found, keys
from scp_recon.scenario.fields import Section
from scp_recon.scenario.resolution.agreement import check, fill
from scp_recon.scenario.resolution.body import resolve_gravity, resolve_rotation, resolve_sun
from scp_recon.scenario.resolution.site import resolve_site
from scp_recon.scenario.time_scales import tdb_of_utc

SUBJECTS: dict[str, tuple[str, ...]] = {
    "rotation": (
        "body.pole_",
        "body.prime_",
        "body.rotation_",
        "body.pck_",
        "body.naif_",
        "body.attitude",
        "body.name",
    ),
    "gravity": (
        *("body.gm_", "body.j2", "body.reference_", "body.gravity", "body.name"),
        *("body.solid", "body.shape_unit"),
    ),
    "sun": ("sun.", "epoch.", "body.name", "body.naif_"),
    "site": ("site.", "body.name", "body.radii_", "body.shape_", "body.pck_"),
    "boundary": ("boundary.", "body.gm_", "body.gravity_", "body.name"),
}
"""Prefixes of the entries from which each subject is computed, and against which it is checked."""
FILES = (
    *("body.shape_file", "body.solid_file"),
    *("body.pck_file", "body.attitude_file", "body.gravity_file"),
)


def resolve(data: Mapping[str, Any], changes: Mapping[str, Any] | None = None) -> Tables:
    """Nested tables, their base merged in, with everything computed that can be.

    With `changes` everything else is already resolved. Only subjects that the changes affect are
    computed again, so the files of the other subjects need not exist any more.

    Raises:
        InputError: if a file cannot be used, an epoch is outside the known span, or a given value
            contradicts the computed one.
    """
    tables: Tables = {k: dict(v) if isinstance(v, Mapping) else v for k, v in data.items()}
    wanted = set(SUBJECTS) if changes is None else _touched(changes)
    resolve_epoch(tables)
    body, days = tables.get("body"), _days(tables)
    if not isinstance(body, dict) or not _well_formed(body, Body):
        return tables
    known = packaged_body(body.get("name"))
    if known is not None:
        body.setdefault("naif_id", known.entries["naif_id"])
    if "rotation" in wanted or body.get("attitude") is not None:
        resolve_rotation(body, known, days)
    if known is not None:  # where no kernel has told them
        fill(
            body,
            {key: known.entries[key] for key in ("radii_m", "companion") if key in known.entries},
        )
    if "gravity" in wanted:
        resolve_gravity(body, known)
    if "sun" in wanted:
        _table(tables, "sun", Sun, lambda sun: resolve_sun(sun, body, known, days))
    if "site" in wanted:
        _table(tables, "site", SiteSection, lambda site: resolve_site(site, body))
    if "boundary" in wanted:
        gm = body.get("gm_m3_s2")
        _table(tables, "boundary", Boundary, lambda boundary: resolve_boundary(boundary, gm))
    return tables


def anchored(data: Mapping[str, Any], folder: Path) -> Tables:
    """Nested tables whose file names, relative to a folder, are made absolute."""
    tables: Tables = {k: dict(v) if isinstance(v, Mapping) else v for k, v in data.items()}

    def anchor(name: Any) -> Any:
        return str((folder / name).absolute()) if isinstance(name, str) and name else name

    for entry in FILES:
        table, _, key = entry.partition(".")
        if found(tables, entry) is not None:
            tables[table][key] = anchor(tables[table][key])
    home = found(tables, "boundary.home")
    if isinstance(home, Mapping) and "ephemeris_file" in home:
        tables["boundary"]["home"] = {**home, "ephemeris_file": anchor(home["ephemeris_file"])}
    kernels = found(tables, "sun.spk_files")
    if isinstance(kernels, list | tuple):
        tables["sun"]["spk_files"] = [anchor(name) for name in kernels]
    return tables


def _touched(changes: Mapping[str, Any]) -> set[str]:
    changed = list(entries(changes))
    return {
        subject
        for subject, beginnings in SUBJECTS.items()
        if any(entry.startswith(beginnings) for entry in changed)
    }


def _table(
    tables: Tables, name: str, schema: type[Section], step: Callable[[dict[str, Any]], None]
) -> None:
    """Resolve a table, which may be missing if all of it can be computed."""
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


def resolve_epoch(tables: Tables) -> None:
    """Enter TDB in the place of UTC.

    Raises:
        InputError: if both are given and differ, for example by a date in UTC that was taken for
            TDB.
    """
    epoch = tables.get("epoch")
    if not isinstance(epoch, dict) or epoch.get("utc") is None:
        return
    try:
        utc = datetime.fromisoformat(str(epoch["utc"]))
        given = datetime.fromisoformat(str(epoch["tdb"])) if "tdb" in epoch else None
    except ValueError:  # the schema tells
        return
    computed = tdb_of_utc(utc)
    if given is None:
        epoch["tdb"] = computed.isoformat()
    elif given.tzinfo is None:
        off = abs((given - computed).total_seconds())
        why = f"which is epoch.utc in TDB; they are {off:.3f} s apart"
        check("epoch.tdb", given.isoformat(), off <= UTC_TOLERANCE_S, computed.isoformat(), why)
    del epoch["utc"]


def _days(tables: Mapping[str, Any]) -> float | None:
    """TDB days past J2000 of the epoch; None if it is missing or no date."""
    try:
        tdb = datetime.fromisoformat(str(found(tables, "epoch.tdb")))
        return (tdb - J2000_TDB).total_seconds() / DAY_S
    except (ValueError, TypeError):
        return None


TOLERANCE = 1e-6
"""Relative tolerance of radius and speed within which given states are those of the home orbit."""


def resolve_boundary(boundary: dict[str, Any], gm: object) -> None:
    """Enter the states, if there is a home orbit and GM, m^3/s^2, is known.

    Raises:
        InputError: if given states are not those of the home orbit.
    """
    if boundary.get("home") is None or not isinstance(gm, int | float):
        return
    home = HomeOrbit.model_validate_json(json.dumps(boundary["home"]))
    states = [
        home.state(float(np.deg2rad(span[0])), float(gm))
        for span in (home.departure_deg, home.arrival_deg)
    ]
    computed = [part for state in states for part in (state[:3], state[3:])]
    for key, value in zip(keys(ENDS), computed, strict=True):
        given = boundary.setdefault(key, value.tolist())
        if not np.allclose(given, value, rtol=0.0, atol=TOLERANCE * np.linalg.norm(value)):
            raise InputError(
                f"boundary.{key}",
                str(given)[:80],
                "must be left out beside boundary.home, from which it follows",
            )
