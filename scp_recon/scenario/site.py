"""Compute position and normal of a site on the ellipsoid or on a shape model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scp_recon.bodies.files import read_shape
from scp_recon.bodies.surface import (
    Ellipsoid,
    Mesh,
    OpenShapeError,
    Solid,
    Surface,
    angle_deg,
    coordinates_of,
    direction_of,
)
from scp_recon.display import exact
from scp_recon.errors import InputError
from scp_recon.scenario.given import check, has, shown

DIRECTION_TOLERANCE_DEG, NORMAL_TOLERANCE_DEG = 0.1, 30.0
"""Tolerances of a position beside its coordinates, and of a normal beside the rough surface's."""
OFF_ELLIPSOID, OFF_MESH, OFF_RADII = 1.5, 1.05, 1.3
"""Factor by which a position may be off the surface, and a shape off the body's radii."""
FACETS = 0.1
"""Least averaging radius over a facet's size: below it, in kilometres probably, nothing averages."""
OFF_CENTRE, OFF_INERTIA = 0.1, 0.97
"""Of a shape as a homogeneous solid: its centre off the origin, over its radius; and the inertia about
z over the largest, which is 1 of Bennu's and 0.88 with its axes y and z swapped."""


def derive_site(site: dict[str, Any], body: dict[str, Any]) -> None:
    """Enter position and normal, by the radii or the shape of the body.

    Raises:
        InputError: if the shape cannot be used, there is none, or entries contradict one another.
    """
    given = site.get("position_body_m")
    if given is None and not has(site, "latitude_deg", "longitude_deg"):
        return  # which the schema tells
    surface = _surface(site, body)
    if given is not None:
        direction = np.array(given, dtype=float) / max(np.linalg.norm(given), np.finfo(float).tiny)
        if has(site, "latitude_deg", "longitude_deg"):
            coordinates = site["latitude_deg"], site["longitude_deg"]
            near = angle_deg(direction, direction_of(*coordinates)) <= DIRECTION_TOLERANCE_DEG
            why = f"the direction of position_body_m, to {DIRECTION_TOLERANCE_DEG:g} deg"
            entry, found = "site.latitude_deg, longitude_deg", coordinates_of(direction)
            check(entry, coordinates, near, found, why)
    elif surface is not None:
        direction = direction_of(site["latitude_deg"], site["longitude_deg"])
    else:
        given_deg = f"{exact(site['latitude_deg'])} on a body without a shape"
        needs = "needs body.radii_m or body.shape_file, or a packaged body's name"
        raise InputError("site.latitude_deg", given_deg, needs)
    if surface is None:
        if has(site, "normal_body") and angle_deg(site["normal_body"], direction) >= 90.0:
            raise InputError("site.normal_body", shown(site["normal_body"]), "must point outward")
        return
    try:
        position, normal = surface.at(direction)
    except OpenShapeError as error:
        where = "latitude {:.2f} deg, longitude {:.2f} deg".format(*coordinates_of(direction))
        raise InputError("body.shape_file", f"{error}: {where}", "must be closed") from None
    if given is None:
        site["position_body_m"] = position.tolist()
    else:
        factor = OFF_MESH if isinstance(surface, Mesh) else OFF_ELLIPSOID
        size, radius = float(np.linalg.norm(given)), float(np.linalg.norm(position))
        near = radius / factor <= size <= radius * factor
        why = f"where the surface is, within a factor of {factor:g}"
        check("site.position_body_m", f"{size:g} m from the centre", near, f"{radius:g} m", why)
    if has(site, "normal_body"):
        apart = angle_deg(site["normal_body"], normal)
        why = f"the surface's there, to {NORMAL_TOLERANCE_DEG:g} deg (or be left out)"
        near = apart <= NORMAL_TOLERANCE_DEG
        check("site.normal_body", site["normal_body"], near, normal, why)
    else:
        site["normal_body"] = normal.tolist()


def _surface(site: dict[str, Any], body: dict[str, Any]) -> Surface | None:
    radii = np.array(body["radii_m"], dtype=float) if has(body, "radii_m") else None
    if not has(body, "shape_file"):
        if has(site, "normal_radius_m"):
            wide = exact(site["normal_radius_m"])
            raise InputError("site.normal_radius_m", wide, "goes with body.shape_file only")
        return None if radii is None else Ellipsoid(radii)
    path = Path(body["shape_file"])
    radius = site.get("normal_radius_m") or 0.0
    mesh = read_shape(path, body.get("shape_unit"), radius, body.get("naif_id"))
    if mesh.normal_radius_m:
        low, high = FACETS * mesh.facet_size_m, float(mesh.half_extents_m.min()) / 2.0
        if not low <= mesh.normal_radius_m <= high:
            needs = f"must be {low:.3g} to {high:.3g} m, from a tenth of a facet to half the body"
            raise InputError("site.normal_radius_m", f"{exact(mesh.normal_radius_m)} m", needs)
    if radii is not None:
        ratio = mesh.half_extents_m / radii
        why = f"body.radii_m along x, y and z, within a factor of {OFF_RADII:g}: mind unit and axes"
        near = bool(np.all((ratio <= OFF_RADII) & (ratio >= 1.0 / OFF_RADII)))
        check("body.shape_file", [*mesh.half_extents_m], near, radii, why)
    check_solid("body.shape_file", str(path), mesh)
    return mesh


def check_solid(entry: str, given: str, mesh: Mesh) -> Solid:
    """The solid in a mesh.

    Raises:
        InputError: if it is open, inside out, off the centre of mass, or off its principal axis.
    """
    try:
        solid = Solid.of(mesh)
    except ValueError as error:
        raise InputError(entry, f"{given}, with {error}", "must be closed") from None
    if solid.volume_m3 < 0.0:
        needs = "must have facets that turn outward: two axes swapped or one mirrored turn them"
        raise InputError(entry, f"{given}, whose facets turn inward", needs)
    off = float(np.linalg.norm(solid.centre_m))
    if off > OFF_CENTRE * solid.radius_m:
        needs = (
            f"must be closed and about its centre of mass, to {OFF_CENTRE * solid.radius_m:.3g} m"
        )
        raise InputError(entry, f"{given}, whose centre is {off:.3g} m off the origin", needs)
    values, axes = np.linalg.eigh(solid.inertia_m2)
    if solid.inertia_m2[2, 2] < OFF_INERTIA * values[2]:
        tilt = float(np.rad2deg(np.arccos(min(1.0, abs(axes[2, 2])))))
        given = f"{given}, whose axis of largest inertia is {tilt:.0f} deg off z"
        needs = "must turn about that axis, as bodies do: are the axes in order?"
        raise InputError(entry, given, needs)
    return solid
