"""Observation geometry over time: of the plan, and of sampled flights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.sampling import sample_positions
from scp_recon.physics import geometry
from scp_recon.scenario.uncertainty import Uncertainty

SAMPLES, SEED = 2000, 1


@dataclass(frozen=True)
class Quantity:
    """One observed quantity.

    Attributes:
        label: with its unit, for an axis.
        plan: of the planned flight, shape (n,).
        sampled: of sampled flights, shape (n, samples).
        limits: lower and upper, None where there is none.
    """

    label: str
    plan: Array
    sampled: Array
    limits: tuple[float | None, float | None]


def observed(
    mission: Mission, burns_m_s: Array, times_s: Array, samples: int = SAMPLES
) -> tuple[Quantity, Quantity, Quantity]:
    """Site distance (m), emission and phase (deg) at times of the flight, shape (n,)."""
    position = sample_positions(mission, burns_m_s, times_s, samples, SEED)
    plan = planned_positions(mission, burns_m_s, times_s)
    track = geometry.track(mission.site, mission.rotation, times_s)
    wide = geometry.SiteTrack(track.position[:, None], track.normal[:, None])
    sun = mission.sun_direction(times_s)
    limits = mission.scenario.observation
    return (
        Quantity(
            "site distance (m)",
            geometry.distance(plan, track),
            geometry.distance(position, wide),
            (limits.site_distance_min_m, limits.site_distance_max_m),
        ),
        Quantity(
            "emission (deg)",
            np.rad2deg(geometry.emission(plan, track)),
            np.rad2deg(geometry.emission(position, wide)),
            (limits.emission_min_deg, limits.emission_max_deg),
        ),
        Quantity(
            "phase (deg)",
            np.rad2deg(geometry.phase(plan, track, sun)),
            np.rad2deg(geometry.phase(position, wide, sun[:, None])),
            (limits.phase_min_deg, limits.phase_max_deg),
        ),
    )


def planned_positions(mission: Mission, burns_m_s: Array, times_s: Array) -> Array:
    """Positions when nothing errs, J2000, m, shape (n, 3)."""
    nothing = {"uncertainty": Uncertainty.none()}
    certain = Mission.from_scenario(mission.scenario.model_copy(update=nothing))
    return sample_positions(certain, burns_m_s, times_s, 1, SEED)[:, 0]
