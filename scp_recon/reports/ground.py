"""Compute the ground track and the camera's footprints. Body-fixed, m."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array
from scp_recon.physics.frames import unit
from scp_recon.reports.subject import Subject
from scp_recon.reports.surfaces import TURNS, Shape, rim

LOOKS = 41
"""Times in the window at which the outline of the field of view is drawn on the ground."""
STEPS, HALVINGS = 48, 30
"""Of the search along a ray: even steps until the ray is below the surface, and bisections after."""


@dataclass(frozen=True)
class Camera:
    """A round field of view about the boresight, in which the site is kept: full angle, pixels across.

    The default is the DARE SmallSat's in NASA MuSCAT.
    """

    field_deg: float = 21.0
    pixels: int = 5120

    def __str__(self) -> str:
        """The camera in words."""
        return f"camera of {self.field_deg:g} deg and {self.pixels} pixels across"


@dataclass(frozen=True, eq=False)
class GroundTrack:
    """A plan over the ground.

    Attributes:
        times_s: shape (n,).
        longitude_deg: east, -180 to 180, of the point below the spacecraft, shape (n,).
        latitude_deg: planetocentric, shape (n,).
        looks_s: times in the rest of the window, shape (w,).
        outlines_m: edge of the field of view on the ground, NaN where a ray misses the body, shape
            (w, rays, 3).
    """

    times_s: Array
    longitude_deg: Array
    latitude_deg: Array
    looks_s: Array
    outlines_m: Array


def ground_track(subject: Subject, shape: Shape, camera: Camera) -> GroundTrack:
    """Ground track of the planned mean; the camera points to the site in the rest of the window."""
    mission, times = subject.mission, subject.fine_s
    looks, below = subject.looks_s(LOOKS), degrees_of(_fixed(subject, times))
    if not len(looks):
        return GroundTrack(times, below[0], below[1], looks, np.empty((0, TURNS, 3)))
    here = _fixed(subject, looks)
    boresight = unit(mission.site.position_body - here)
    half = float(np.deg2rad(0.5 * camera.field_deg))
    rays = np.cos(half) * boresight[:, None] + np.sin(half) * rim(boresight)
    outlines = first_hit(np.broadcast_to(here[:, None], rays.shape), rays, shape)
    return GroundTrack(times, below[0], below[1], looks, outlines)


def _fixed(subject: Subject, times: Array) -> Array:
    """The planned path in the body's frame, m."""
    matrix = subject.mission.rotation.body_to_j2000(times)
    return np.einsum("nji,nj->ni", matrix, subject.positions(times))


def degrees_of(position: Array) -> tuple[Array, Array]:
    """East longitude and planetocentric latitude of positions (..., 3), deg."""
    x, y, z = np.moveaxis(position, -1, 0)
    return np.rad2deg(np.arctan2(y, x)), np.rad2deg(np.arctan2(z, np.hypot(x, y)))


def first_hit(start: Array, ray: Array, shape: Shape) -> Array:
    """First points at which rays meet the surface; NaN where none does.

    Every direction from the centre is assumed to meet the surface once. The search takes even steps
    through the sphere around the surface, and then halves them. Rays are unit vectors (..., 3) that
    start outside.
    """
    size = 1.001 * shape.size_m
    middle = -np.sum(start * ray, axis=-1)
    nearest2 = np.sum(start * start, axis=-1) - middle**2
    half = np.sqrt(np.maximum(size**2 - nearest2, 0.0))

    def above(along: Array) -> Array:
        position = start + along[..., None] * ray
        distance = np.linalg.norm(position, axis=-1)
        return distance - shape.radius(position / np.maximum(distance, 1e-9)[..., None])

    steps = (middle - half)[..., None] + half[..., None] * np.linspace(0.0, 2.0, STEPS)
    under = np.stack([above(steps[..., k]) < 0.0 for k in range(STEPS)], axis=-1)
    first = np.argmax(under, axis=-1)
    hit = under.any(axis=-1) & (nearest2 < size**2)
    high = np.take_along_axis(steps, first[..., None], -1)[..., 0]
    low = np.take_along_axis(steps, np.maximum(first - 1, 0)[..., None], -1)[..., 0]
    for _ in range(HALVINGS):
        between = 0.5 * (low + high)
        below = above(between) < 0.0
        low, high = np.where(below, low, between), np.where(below, between, high)
    found = start + (0.5 * (low + high))[..., None] * ray
    return np.where(hit[..., None], found, np.nan)


def terminator(subject: Subject, time_s: float) -> tuple[Array, Array]:
    """Longitude and latitude (deg) of the great circle on which the Sun stands on the horizon.

    Of a sphere: a rough shape's own terminator departs from it.
    """
    mission = subject.mission
    sun = mission.rotation.body_to_j2000(time_s).T @ mission.sun_direction(time_s)
    # n . sun = 0: tan(latitude) tan(latitude of the Sun) = -cos(longitude from the Sun)
    longitude = np.linspace(-180.0, 180.0, 361)
    at, high = degrees_of(sun)
    from_sun = np.deg2rad(longitude - at)
    latitude = np.arctan2(-np.cos(from_sun) * np.cos(np.deg2rad(high)), np.sin(np.deg2rad(high)))
    latitude = np.where(
        np.abs(latitude) > 0.5 * np.pi, latitude - np.sign(latitude) * np.pi, latitude
    )
    return longitude, np.rad2deg(latitude)
