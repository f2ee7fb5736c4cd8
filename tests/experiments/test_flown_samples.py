from __future__ import annotations

import numpy as np
import pytest

from experiments.flown_plan import sample_distances
from experiments.uncertainty_sources.flights import TRANSLATION, fly_paths
from scp_recon.simulation.vehicle import load_vehicle
from tests.scp_recon.simulation.short_plan import SHORT, short_plan
from tests.scp_recon.support import mission_of

SPREAD_M = 10.0
"""Of every position in the short plan's covariance."""


def test_samples_spread_as_paths_with_the_same_errors_do() -> None:
    mission, vehicle = mission_of(*SHORT), load_vehicle()
    solution = short_plan(mission)
    fraction = solution.scenario.uncertainty.initial_sigma_fraction
    errors = vehicle.errors.model_copy(update={"initial_state": fraction})
    ends = fly_paths(solution, vehicle.model_copy(update={"errors": errors}), TRANSLATION, 3000, 7)[
        :, :3
    ]
    expected = np.linalg.norm(ends - np.array(solution.nodes.state[-1])[:3], axis=1) / SPREAD_M
    found = sample_distances(solution, vehicle, 3000)
    assert found.shape == (3000, len(solution.nodes.t_s))
    assert np.std(found[:, -1]) == pytest.approx(np.std(expected), rel=0.1)
    assert np.mean(found[:, -1]) == pytest.approx(np.mean(expected), rel=0.05)
    first = np.sqrt(np.mean(found[:, 0] ** 2))
    assert first == pytest.approx(np.linalg.norm(mission.initial_sigma[:3]) / SPREAD_M, rel=0.05)


def test_the_planner_expects_errors_of_every_component_and_less_of_the_size() -> None:
    """With no error of the start, along one burn: beta of the vehicle against the planner's."""
    mission, vehicle = mission_of(*SHORT, "uncertainty.initial_sigma_fraction=0.0"), load_vehicle()
    solution = short_plan(mission)
    by_thrust, by_component = (sample_distances(solution, v, 2000) for v in (vehicle, None))
    rms = [np.sqrt(np.mean(found[:, 1] ** 2)) for found in (by_thrust, by_component)]
    beta = solution.scenario.uncertainty.execution_error
    ratio = vehicle.errors.chemical_thruster / beta
    assert rms[0] / rms[1] == pytest.approx(ratio, rel=0.05)
