"""Spread sites evenly over a body's surface, and find when it is noon there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from formulations.arrays import Array
from scp_recon.bodies.shape_file import read_shape
from scp_recon.bodies.surface import Ellipsoid, Mesh, Surface, coordinates_of
from scp_recon.errors import InputError
from scp_recon.mission.scene import Scene
from scp_recon.physics.two_body import two_body
from scp_recon.scenario.schema import Scenario

PARTS = 50
"""Parts of the surface for each site, over which its area is summed."""
ROUNDS = 40
"""Rounds of Lloyd's algorithm; after 20 the areas of 324 sites on Bennu hardly change."""
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


def surface_of(scenario: Scenario) -> Surface:
    """Surface of a scenario's body: its shape file, else its ellipsoid.

    Raises:
        InputError: if the scenario has neither, or the file cannot be read.
    """
    body = scenario.body
    if body.shape_file is not None:
        radius = scenario.site.normal_radius_m or 0.0
        return read_shape(Path(body.shape_file), body.shape_unit, radius, body.naif_id)
    if body.radii_m is None:
        raise InputError(
            "body.radii_m", "nothing", "must be there, or body.shape_file, to spread sites over"
        )
    return Ellipsoid(np.array(body.radii_m))


def even_sites(surface: Surface, count: int) -> list[tuple[float, float]]:
    """Spread sites over a surface: planetocentric latitude and east longitude (-180 to 180), deg.

    A centroidal Voronoi tessellation: each site is the centroid of the area nearest to it, seen from
    the body's centre. Lloyd 1982, IEEE Transactions on Information Theory 28, 129, from a spherical
    Fibonacci lattice (Gonzalez 2010, Mathematical Geosciences 42, 49), in order from south to north.
    The surface must be visible from the centre (star-shaped).
    """
    middles, areas = parts(surface, PARTS * count)
    lattice = fibonacci(count)
    sites = lattice * np.linalg.norm(middles, axis=1).mean()
    for _ in range(ROUNDS):
        nearest = KDTree(sites).query(middles)[1]
        weights = np.bincount(nearest, areas, count)
        moments = [np.bincount(nearest, areas * middles[:, k], count) for k in range(3)]
        with_parts = weights > 0.0
        sites[with_parts] = (np.array(moments).T[with_parts]) / weights[with_parts, None]
    return [coordinates_of(site) for site in sites]


def fibonacci(count: int) -> Array:
    """Unit vectors spread evenly over a sphere, from south to north, shape (count, 3)."""
    number = np.arange(count)
    height = (2.0 * number + 1.0) / count - 1.0
    across, turn = np.sqrt(1.0 - height**2), 2.0 * np.pi * GOLDEN * number
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)


def parts(surface: Surface, least: int) -> tuple[Array, Array]:
    """Cut a surface into small parts: their middles, m, shape (n, 3), and areas, m^2, shape (n,).

    Facets of a mesh are cut in four until there are `least`; an ellipsoid is divided by directions.
    """
    if isinstance(surface, Mesh):
        corners = surface.vertices_m[surface.facets]
        while len(corners) < least:
            corners = quartered(corners)
        a, b, c = np.moveaxis(corners, 1, 0)
        return corners.mean(axis=1), np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0
    directions = fibonacci(least)
    found = [surface.at(direction) for direction in directions]
    middles, normals = (np.array(each) for each in zip(*found, strict=True))
    # An area is r^2 of its solid angle, over the cosine between normal and direction.
    areas = np.sum(middles**2, axis=1) / np.sum(directions * normals, axis=1)
    return middles, 4.0 * np.pi / least * areas


def quartered(corners: Array) -> Array:
    """Cut each triangle in four at the middles of its sides: shape (n, 3, 3) to (4 n, 3, 3)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    ab, bc, ca = (a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0
    found = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(one, axis=1) for one in found])


def noons_of(scenario: Scenario) -> Callable[[float], float]:
    """Make a function from east longitude, deg, to the first local noon, s past the epoch.

    Newton's method on the Sun's body-fixed longitude.

    Raises:
        InputError: if the body tumbles: it has no solar days.
    """
    if scenario.body.attitude is not None:
        raise InputError("body.attitude", "a body that tumbles", "has no noons to begin a map at")
    rotation, sun = Scene.of(scenario).rotation, scenario.sun
    day = 2.0 * np.pi / abs(rotation.rate)
    to_body = two_body(sun.body_position_km, sun.body_velocity_km_s, (0.0, 3.0 * day))

    def longitude_at(time_s: float) -> float:
        x, y, _ = rotation.body_to_j2000(time_s).T @ -to_body(time_s)
        return float(np.arctan2(y, x))

    def noon_s(longitude_deg: float) -> float:
        time = 0.0
        for _ in range(3):
            ahead = longitude_at(time) - np.deg2rad(longitude_deg)
            turn = ahead % (2.0 * np.pi) if time == 0.0 else (ahead + np.pi) % (2.0 * np.pi) - np.pi
            time += turn / rotation.rate
        return time

    return noon_s
