"""GM, J2 and the field of the truth, from a file or the catalogue."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from scp_recon.environment.catalogue import PackagedBody
from scp_recon.environment.gravity_file import GravityTable, read_gravity
from scp_recon.errors import InputError
from scp_recon.scenario.body import DEGREE_MAX
from scp_recon.scenario.resolution.agreement import check, fill, has, lacks

TOLERANCE = 0.01
"""Share within which GM and J2, given beside a file, are taken for the file's."""


def resolve_gravity(body: dict[str, Any], known: PackagedBody | None) -> None:
    """Enter GM, J2, its radius, and the field if there is a file.

    Args:
        body: table to enter them in.
        known: the packaged body of that name.

    Raises:
        InputError: if the file cannot be used, or does not agree with what is given.
    """
    if has(body, "gravity_file"):
        table = read_gravity(Path(body["gravity_file"]), DEGREE_MAX)
        if table.gm_m3_s2 is not None:
            fill(body, {"gm_m3_s2": table.gm_m3_s2})
            given, near = body["gm_m3_s2"], TOLERANCE * table.gm_m3_s2
            close = abs(given - table.gm_m3_s2) <= near
            check("body.gm_m3_s2", given, close, table.gm_m3_s2, f"gravity_file, to {TOLERANCE:g}")
        _enter_field(body, table, known)
    elif has(body, "gravity", "j2", "reference_radius_m"):
        field = body["gravity"]
        _check_j2(body, _j2(field["coefficients"]), field["reference_radius_m"], "gravity")
    if known is not None:
        fill(body, {"gm_m3_s2": known.entries["gm_m3_s2"]})
        if lacks(body, "j2", "reference_radius_m"):
            fill(body, {key: known.entries[key] for key in ("j2", "reference_radius_m")})


def _enter_field(body: dict[str, Any], table: GravityTable, known: PackagedBody | None) -> None:
    """J2 about z is -sqrt(5) times the normalised C20; over the square of its radius it compares."""
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
    elif lacks(body, "j2"):  # at the radius that is given
        body["j2"] = j2 * (radius / body["reference_radius_m"]) ** 2
    if has(body, "j2", "reference_radius_m"):
        _check_j2(body, j2, radius, "gravity_file")
    body["gravity"] = {
        "reference_radius_m": radius,
        "coefficients": [list(row) for row in table.rows],
    }


def _j2(rows: Iterable[Sequence[float]]) -> float:
    """Unnormalised, of fully normalised coefficients."""
    return -math.sqrt(5.0) * next((c for n, m, c, _ in rows if (n, m) == (2, 0)), 0.0)


def _check_j2(body: dict[str, Any], j2: float, radius: float, source: str) -> None:
    """What the planner flies against the field that the truth does."""
    there = j2 * (radius / body["reference_radius_m"]) ** 2
    close = abs(body["j2"] - there) <= TOLERANCE * abs(there)
    check("body.j2", body["j2"], close, there, f"{source}, to {TOLERANCE:g}")
