"""Compute the observation geometry over time of a plan and of sampled flights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.observation_time import measured
from scp_recon.monte_carlo.sampling import sample_positions
from scp_recon.results.solution import Solution
from scp_recon.scenario.uncertainty import Uncertainty

SAMPLES, SEED = 2000, 1
DEGREES = float(np.rad2deg(1.0))


@dataclass(frozen=True)
class Quantity:
    """One observed quantity.

    Attributes:
        label: with its unit, for an axis.
        plan: of the planned flight, shape (n,).
        sampled: of sampled flights, shape (n, samples).
        limits: its limits.
    """

    label: str
    plan: Array
    sampled: Array
    limits: list[float]


def observed(solution: Solution, times_s: Array, samples: int = SAMPLES) -> list[Quantity]:
    """Site distance (m), emission and phase (deg) at times of the flight, shape (n,)."""
    mission, burns, policy = solution.mission, solution.burns_m_s, solution.corrections
    plan = measured(mission, times_s, planned_positions(mission, burns, times_s))
    flights = sample_positions(mission, burns, times_s, samples, SEED, policy)
    sampled, limits = measured(mission, times_s, flights), mission.scenario.observation
    looks = (
        ("site distance (m)", 1.0, (limits.site_distance_min_m, limits.site_distance_max_m)),
        ("emission (deg)", DEGREES, (limits.emission_min_deg, limits.emission_max_deg)),
        ("phase (deg)", DEGREES, (limits.phase_min_deg, limits.phase_max_deg)),
    )
    return [
        Quantity(label, scale * mean, scale * sampled[of], [x for x in both if x is not None])
        for (of, mean), (label, scale, both) in zip(plan.items(), looks, strict=True)
    ]


def planned_positions(mission: Mission, burns_m_s: Array, times_s: Array) -> Array:
    """Positions without errors, J2000, m, shape (n, 3)."""
    nothing = {"uncertainty": Uncertainty.none()}
    certain = Mission.from_scenario(mission.scenario.model_copy(update=nothing))
    return sample_positions(certain, burns_m_s, times_s, 1, SEED)[:, 0]
