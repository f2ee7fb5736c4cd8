"""Observation geometry of a site on a rotating body lit by the Sun.

Angles in radians, positions in metres, J2000, body-centred. The vector from the site to the Sun is
replaced by the one from the body's centre, an error of 1e-9 rad here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array
from scp_recon.physics.frames import Rotation


@dataclass(frozen=True)
class Site:
    """A point on the surface: body-fixed position (m) and unit outward normal, shape (3,) each.

    Attributes:
        position_body: body-fixed, m, shape (3,).
        normal_body: outward unit normal, body-fixed, shape (3,).
    """

    position_body: Array
    normal_body: Array


@dataclass(frozen=True)
class SiteTrack:
    """The site over time: inertial position (n, 3) m and unit normal (n, 3)."""

    position: Array
    normal: Array


def track(site: Site, rotation: Rotation, time_s: npt.ArrayLike) -> SiteTrack:
    """Position (m) and normal of a site in J2000 at times in s past the epoch, shape (n,).

    Site and rotation may be one a flight; times then have shape (n, 1), or are one a flight.
    """
    matrix = rotation.body_to_j2000(time_s)
    return SiteTrack(_turned(matrix, site.position_body), _turned(matrix, site.normal_body))


def _turned(matrix: Array, vector: Array) -> Array:
    if vector.ndim == 1:
        return matrix @ vector
    return np.einsum("...ij,...j->...i", matrix, vector)


def angle(a: Array, direction: Array) -> Array:
    """Angle from a unit direction to vectors along the last axis, rad, accurate near 0 and pi."""
    along = np.sum(a * direction, axis=-1)
    across = a - along[..., None] * direction
    return np.arctan2(np.sqrt(np.sum(across * across, axis=-1)), along)


def distance(position: Array, site: SiteTrack) -> Array:
    """Distance from the site to the spacecraft, m."""
    return np.linalg.norm(position - site.position, axis=-1)


def emission(position: Array, site: SiteTrack) -> Array:
    """Angle at the site between its normal and the spacecraft, rad."""
    return angle(position - site.position, site.normal)


def phase(position: Array, site: SiteTrack, sun_direction: Array) -> Array:
    """Angle at the site between the Sun and the spacecraft, rad."""
    return angle(position - site.position, sun_direction)


def incidence(site: SiteTrack, sun_direction: Array) -> Array:
    """Angle at the site between its normal and the Sun, rad."""
    return angle(site.normal, np.broadcast_to(sun_direction, site.normal.shape))


def local_solar_time(
    site: Site, rotation: Rotation, sun_direction: Array, time_s: npt.ArrayLike
) -> Array:
    """Local solar time in h: 12 when the Sun crosses the site's meridian; one rotation is 24 h."""
    sun_body = np.einsum("...ji,...j->...i", rotation.body_to_j2000(time_s), sun_direction)
    site_longitude = np.arctan2(site.position_body[..., 1], site.position_body[..., 0])
    hour_angle = site_longitude - np.arctan2(sun_body[..., 1], sun_body[..., 0])
    return (12.0 + hour_angle * 12.0 / np.pi) % 24.0
