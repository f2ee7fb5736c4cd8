"""What a plan's flights would do without a spacecraft: samples of the planner's dynamics."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from scp_recon.mission.mission import Mission
from scp_recon.mission.uncertainty import execution_errors
from scp_recon.solution.file import Solution
from scp_recon.spacecraft.outcome import distance_in_sigmas
from scp_recon.spacecraft.vehicle import Vehicle

Array = npt.NDArray[np.float64]

BLOCK = 1000


def sample_distances(
    solution: Solution, vehicle: Vehicle | None, samples: int, seed: int = 0
) -> Array:
    """Distances of sampled positions at the nodes from the mean, in sigmas of the planned covariance.

    The initial state errs as the scenario says.

    Args:
        solution: plan.
        vehicle: whose thruster errs in the size of each burn; without one burns err as the planner
            expects.
        samples: how many.
        seed: of all.

    Returns:
        Shape (samples, nodes).
    """
    mission, planned = Mission.from_scenario(solution.scenario), solution.burns_m_s
    units, model, found = mission.units, execution_errors(mission.scenario), []
    for block, first in enumerate(range(0, samples, BLOCK)):
        rng = np.random.default_rng([seed, block])
        numbers = planned.size if vehicle else model.draws(len(planned))
        draws = rng.standard_normal((min(BLOCK, samples - first), 6 + numbers))
        if vehicle is None:
            executed = model.execute(planned, draws[:, 6:])
        else:
            sizes = draws[:, 6:].reshape(-1, *planned.shape)[..., :1]
            executed = planned * (1.0 + vehicle.errors.chemical_thruster * sizes)
        initial = mission.initial_state + draws[:, :6] @ mission.initial_factor.T
        states = mission.dynamics.rollout(initial / units.state, executed / units.speed_m_s)
        positions = np.moveaxis(states, 0, 1)[..., :3] * units.length_m
        found.append(distance_in_sigmas(positions, solution))
    return np.concatenate(found)
