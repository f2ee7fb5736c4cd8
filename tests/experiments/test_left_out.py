"""What the planner leaves out: flights by other models, cones of too little power, dispersion."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from experiments.left_out import (
    BURNS,
    GRAVITY,
    PLANNER,
    SAMPLES,
    SRP,
    dispersion,
    find_cones,
    flight_plan,
    fly,
    models_of,
)
from scp_recon.physics.flow import propagate
from scp_recon.simulation.guidance import SolarArray, irradiance
from scp_recon.simulation.vehicle import load_vehicle

THRUST_M_S2 = 1.0 / 178.0


def test_planners_model_is_flown_to_a_millimetre(mission, solution):
    """Against the planner's own equations, integrated by Runge and Kutta in steps of 20 s."""
    arc = flight_plan(solution, mission, load_vehicle())
    models, burns = models_of(arc), np.array([firing.dv_m_s for firing in arc.firings])
    model: dict[str, Any] = {effect: models[effect][name] for effect, name in PLANNER.items()}
    end_s = float(mission.times_s[-1])
    found = fly(mission, burns, model, end_s, thrust_m_s2=THRUST_M_S2)
    state = mission.initial_state + np.r_[np.zeros(3), burns[0]]
    expected = propagate(state, end_s, mission.forces, 1742)
    np.testing.assert_allclose(found[:3], expected[:3], atol=1e-3)
    np.testing.assert_allclose(found[3:], expected[3:], atol=1e-7)


@pytest.mark.parametrize(("late", "lead_s"), [(0.0, 0.0), (0.5, 0.5), (None, 0.5)])
def test_burn_acts_from_its_middle(mission, late, lead_s):
    """In empty space an impulse leads a finite burn by half of its length times the velocity."""
    burns = np.array([[0.1, 0.0, 0.0], [0.0, 0.05, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    nothing = SimpleNamespace(acceleration=lambda *_: np.zeros(3))
    model: dict[str, Any] = {GRAVITY: nothing, SRP: lambda _: np.zeros(3), BURNS: late}
    lengths, start = np.array([0.1, 0.05]) / THRUST_M_S2, mission.initial_state
    for time in (3000.0, 20_000.0):
        found = fly(mission, burns, model, time, thrust_m_s2=THRUST_M_S2)
        acting = np.maximum(time - np.array([0.0, 8000.0]) - lead_s * lengths, 0.0)
        expected = start[:3] + time * start[3:] + np.r_[0.1 * acting[0], 0.05 * acting[1], 0.0]
        np.testing.assert_allclose(found[:3], expected, atol=1e-6)


def test_cones_are_the_papers_and_hold_their_samples(mission):
    """Peaks of SP1 to SP5 by areas of 0.0286, 0.0676 and 0.36 m^2, 30 % cells and 1332 W/m^2."""
    panels = SolarArray.of(load_vehicle(), irradiance(mission.scenario))
    assert panels.peak_w == pytest.approx([11.4, 27.0, 27.0, 143.9, 143.9], abs=0.05)
    assert panels.generation(-np.eye(3)[0]).sum() == pytest.approx(299.2, abs=0.2)
    cones, most = find_cones(0), np.linalg.norm(panels.best_direction())
    assert most == pytest.approx(300.4, abs=0.2)
    assert [cone["load_w"] for cone in cones] == 2 * [115.0, 90.0]
    for cone in cones:
        half = np.deg2rad(cone["half_angle_deg"])
        if cone["calibrated"]:
            assert cone["half_angle_deg"] == pytest.approx(cone["paper_deg"], abs=0.2)
        else:
            assert np.sin(half) * most == pytest.approx(cone["load_w"])
        share = 1.0 - np.cos(half)
        # Five standard deviations, as a wrong share would miss by more.
        spread = np.sqrt(share * (1.0 - share) / SAMPLES)
        assert cone["sampled_fraction"] == pytest.approx(share, abs=5.0 * spread)


@pytest.mark.parametrize("flights", [3, 8])
@pytest.mark.parametrize("sigmas", [(1.0, 1.0, 1.0), (5.0, 1.0, 0.2)])
def test_intervals_of_dispersion_cover_the_truth(sigmas, flights):
    rng = np.random.default_rng(5)
    covariance = np.diag(np.square(sigmas))
    true = np.sqrt(np.trace(covariance))
    draws = multivariate_normal(cov=covariance).rvs((600, flights), random_state=rng)
    found = [dispersion(sample) for sample in draws]
    covered = np.mean([e.low <= true <= e.high for e in found])
    # Never too narrow, and somewhat too wide in three axes.
    assert 0.92 < covered < 0.999
    assert np.mean([e.value**2 for e in found]) == pytest.approx(true**2, rel=0.1)
