"""What a plan shows over time: quantities with their bands and limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scp_recon.mission.constraints import Measure, observation_limits
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit
from scp_recon.report.content.camera import Camera
from scp_recon.report.content.flown import Flown
from scp_recon.report.content.shape import Shape
from scp_recon.report.content.subject import Subject

Array = npt.NDArray[np.float64]

SIGMAS = {1: (15.8655, 84.1345), 2: (2.2750, 97.7250), 3: (0.1350, 99.8650)}
"""Percentiles between which a normal variable is within so many sigma of its mean."""


@dataclass(frozen=True, eq=False)
class Bound:
    """A limit that a quantity has to keep."""

    name: str
    value: float


@dataclass(frozen=True, eq=False)
class History:
    """A quantity over time.

    Attributes:
        title: of its axis, with the unit.
        times_s: shape (n,).
        planned: of the mean, shape (n,).
        bands: of the sampled flights, by sigmas: low and high, shape (n,) each; none if it is certain.
        bounds: what it has to keep.
    """

    title: str
    times_s: Array
    planned: Array
    bands: dict[int, tuple[Array, Array]]
    bounds: tuple[Bound, ...] = ()


def bands_of(sampled: Array, sigmas: tuple[int, ...]) -> dict[int, tuple[Array, Array]]:
    """Percentiles of samples (n, flights)."""
    levels = [level for sigma in sigmas for level in SIGMAS[sigma]]
    edges = np.percentile(sampled, levels, axis=1)
    return {sigma: (edges[2 * i], edges[2 * i + 1]) for i, sigma in enumerate(sigmas)}


def observation_histories(subject: Subject, flown: Flown) -> list[History]:
    """Distance from the site, emission and phase in the window, with every limit on them."""
    mission, times = subject.mission, flown.window_s
    track = geometry.track(mission.site, mission.rotation, times)
    wide = geometry.SiteTrack(track.position[:, None], track.normal[:, None])
    sun = mission.sun_direction(times)
    mean, sampled = subject.positions(times), flown.positions[flown.window]
    limits = observation_limits(mission.scenario)

    def history(
        measure: Measure, title: str, scale: float, of: Callable[..., Array], lit: bool
    ) -> History:
        suns = ((sun,), (sun[:, None],)) if lit else ((), ())
        return History(
            title,
            times,
            scale * of(mean, track, *suns[0]),
            bands_of(scale * of(sampled, wide, *suns[1]), (1, 2)),
            tuple(
                Bound(f"{limit.name}: at {'least' if limit.sense == 'min' else 'most'}", value)
                for limit in limits
                if limit.measure == measure
                and (value := scale * limit.value) < (180.0 if lit else np.inf)
            ),
        )

    degrees = float(np.rad2deg(1.0))
    return [
        history("distance", "distance from the site (m)", 1.0, geometry.distance, lit=False),
        history("emission", "emission (deg)", degrees, geometry.emission, lit=False),
        history("phase", "phase (deg)", degrees, geometry.phase, lit=True),
    ]


def range_histories(subject: Subject, flown: Flown, shape: Shape) -> list[History]:
    """Range to the surface below, along the line to the centre, and to the centre; with 3 sigma."""
    mission, times = subject.mission, flown.times_s
    body = mission.rotation.body_to_j2000(times)
    mean = subject.positions(times)

    def altitude(position: Array, matrix: Array) -> Array:
        fixed = np.einsum("n...ji,n...j->n...i", matrix, position)
        size = np.linalg.norm(fixed, axis=-1)
        return size - shape.radius(unit(fixed))

    safety = Bound("safety_radius: at least", mission.scenario.safety.radius_min_m)
    return [
        History(
            "range to the surface (m)",
            times,
            altitude(mean, body),
            bands_of(altitude(flown.positions, body[:, None]), (1, 3)),
        ),
        History(
            "distance from the centre (m)",
            times,
            np.linalg.norm(mean, axis=1),
            bands_of(np.linalg.norm(flown.positions, axis=2), (1, 3)),
            (safety,),
        ),
    ]


def lighting_histories(subject: Subject) -> list[History]:
    """Incidence and local solar time at the site throughout the flight; both are certain."""
    mission, times = subject.mission, np.linspace(0.0, subject.nodes_s[-1], 401)
    limits = mission.scenario.observation
    sun = mission.sun_direction(times)
    track = geometry.track(mission.site, mission.rotation, times)
    hours = geometry.local_solar_time(mission.site, mission.rotation, sun, times)
    # A line from 24 to 0 h would cross the chart: the last hour before is left open.
    hours = np.where(np.abs(np.diff(hours, append=hours[-1])) > 12.0, np.nan, hours)
    return [
        History(
            "incidence (deg)",
            times,
            np.rad2deg(geometry.incidence(track, sun)),
            {},
            (Bound("incidence: at most", limits.incidence_max_deg),),
        ),
        History(
            "local solar time (h)",
            times,
            hours,
            {},
            (
                Bound("local solar time: from", limits.local_solar_time_min_h),
                Bound("local solar time: to", limits.local_solar_time_max_h),
            ),
        ),
    ]


def resolution_history(subject: Subject, flown: Flown, camera: Camera) -> list[History]:
    """Ground that a pixel sees at the site: across the line of sight, and along the slope."""
    mission, times = subject.mission, flown.window_s
    track = geometry.track(mission.site, mission.rotation, times)
    wide = geometry.SiteTrack(track.position[:, None], track.normal[:, None])

    def pixel(position: Array, site: geometry.SiteTrack, *, slant: bool) -> Array:
        across = 100.0 * camera.pixel_rad * geometry.distance(position, site)
        return across / np.cos(geometry.emission(position, site)) if slant else across

    mean, sampled = subject.positions(times), flown.positions[flown.window]
    return [
        History(
            f"pixel {name} (cm)",
            times,
            pixel(mean, track, slant=slant),
            bands_of(pixel(sampled, wide, slant=slant), (1, 2)),
        )
        for name, slant in (("across the line of sight", False), ("along the slope", True))
    ]
