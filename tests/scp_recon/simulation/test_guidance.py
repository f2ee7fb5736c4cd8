from __future__ import annotations

import numpy as np
import pytest

from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import Mode
from scp_recon.physics import geometry
from scp_recon.results.solution import Solution
from scp_recon.simulation.guidance import FlightPlan
from scp_recon.simulation.vehicle import Vehicle
from tests.scp_recon.support import fly


@pytest.fixture(scope="module")
def plan(solution: Solution, mission: Mission, vehicle: Vehicle) -> FlightPlan:
    return FlightPlan.of(solution, mission, vehicle)


def test_burns_keep_their_attitude_to_the_end(plan: FlightPlan) -> None:
    thrust, mass = plan.vehicle.chemical_thruster.thrust_n, plan.vehicle.mass.mass_kg
    for firing in plan.firings:
        least = mass * np.linalg.norm(firing.dv_m_s) / thrust
        assert least <= firing.duration_s < least + 1.0
        (leg,) = [leg for leg in plan.legs if leg.end_s == firing.end_s]
        assert leg.mode is Mode.DELTA_V
    assert plan.legs[0].start_s == 0.0
    assert all(a.end_s == b.start_s for a, b in zip(plan.legs, plan.legs[1:], strict=False))


def test_the_nominal_path_is_the_planned_mean_between_the_nodes(
    plan: FlightPlan, solution: Solution, mission: Mission
) -> None:
    times = np.union1d(np.arange(0.0, 34842.0, 971.0), mission.scenario.burns.times_s)
    truth = fly(mission, solution.burns_m_s, times)[:, :3]
    assert np.abs(plan.position(times) - truth).max() < 0.01


def test_every_mode_points_what_it_serves_and_rolls_for_power(
    plan: FlightPlan, mission: Mission
) -> None:
    times = np.arange(0.0, plan.end_s, 61.0)
    attitudes = plan.attitudes(times)
    sun = mission.sun_direction(times)
    power = plan.panels.generation(attitudes.inv().apply(sun)).sum(axis=1)
    position = plan.position(times)
    bottom = attitudes.apply([0.0, 0.0, -1.0])
    site = geometry.track(mission.site, mission.rotation, times).position
    best = np.linalg.norm(plan.panels.best_direction())
    for leg in plan.legs:
        k = (times >= leg.start_s) & (times < leg.end_s)
        if leg.mode is Mode.SUN_POINTING:
            np.testing.assert_allclose(power[k], best, rtol=1e-9)
            # The bottom looks down as far as it can, across the Sun line.
            down = np.einsum("ni,ni->n", bottom[k], -position[k])
            across = np.linalg.norm(np.cross(position[k], sun[k]), axis=1)
            np.testing.assert_allclose(down, across, rtol=1e-9)
            continue
        target = site[k] - position[k]
        if leg.mode is Mode.DELTA_V:
            firing = next(f for f in plan.firings if f.end_s == leg.end_s)
            target = np.broadcast_to(firing.dv_m_s, target.shape)
        assert geometry.angle(target, bottom[k]).max() < 1e-9
        most = plan.panels.best_about(np.array([0.0, 0.0, -1.0]), geometry.angle(target, sun[k]))
        np.testing.assert_allclose(power[k], most, rtol=1e-9)


def test_commands_are_continuous_within_a_mode(plan: FlightPlan) -> None:
    for leg in plan.legs:
        times = np.arange(np.ceil(leg.start_s), leg.end_s)
        attitudes = plan.attitudes(times)
        assert (attitudes[1:] * attitudes[:-1].inv()).magnitude().max() < np.deg2rad(0.05)


def test_a_burn_of_zero_keeps_the_panels_on_the_sun(plan: FlightPlan) -> None:
    """Whatever the others are: turned away for an hour or more, they would not charge."""
    burns = np.array([firing.dv_m_s for firing in plan.firings])
    burns[1] = 0.0
    idle = plan.with_burns(burns)
    assert idle.firings[1].duration_s == 0.0
    before = next(leg for leg in idle.legs if leg.end_s == idle.firings[1].end_s)
    times = np.arange(before.start_s, before.end_s)
    sun = idle.mission.sun_direction(times)
    facing = idle.attitudes(times).apply(idle.panels.best_direction())
    assert geometry.angle(facing, sun).max() < 1e-6
    turned = plan.attitudes(times).apply(plan.panels.best_direction())
    assert geometry.angle(turned, sun).min() > 0.1


def test_a_burn_longer_than_its_mode_is_refused(
    solution: Solution, mission: Mission, vehicle: Vehicle
) -> None:
    weak = vehicle.chemical_thruster.model_copy(update={"thrust_n": 1e-3})
    with pytest.raises(InputError, match="chemical_thruster"):
        FlightPlan.of(solution, mission, vehicle.model_copy(update={"chemical_thruster": weak}))
