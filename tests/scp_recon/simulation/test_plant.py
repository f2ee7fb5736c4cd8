from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from formulations.arrays import Array

pytest.importorskip("Basilisk", reason="needs the extra [sim]")

from experiments.model_fidelity.models import Plates
from scp_recon.mission.mission import Mission
from scp_recon.physics.flow import propagate
from scp_recon.physics.forces import ForceModel
from scp_recon.physics.harmonics import HarmonicField
from scp_recon.simulation.basilisk.plant import Start, build_plant
from scp_recon.simulation.panels import irradiance
from scp_recon.simulation.vehicle import Vehicle

from .support import coast

DURATION_S = 17_421.0


def start(state: Array) -> Start:
    return Start(state, Rotation.identity(), np.zeros(3), np.zeros(4))


def flown(mission: Mission, vehicle: Vehicle, state: Array, field: HarmonicField | None) -> Array:
    """Final state of a ballistic flight half as long as the plan, without light and torques."""
    plant = build_plant(
        mission, vehicle, start(state), field=field, light=False, gravity_gradient=False
    )
    (end,) = coast(plant, [DURATION_S], step_s=3.0)
    return end.state


def planned(forces: ForceModel, state: Array) -> Array:
    return propagate(state, DURATION_S, forces, substeps=1000)


def test_a_point_mass_arc_is_the_planners_to_a_millimetre(mission, vehicle, solution):
    forces = replace(mission.forces, j2_strength=0.0, srp=np.zeros(3))
    state = np.array(solution.nodes.state[0])
    error = flown(mission, vehicle, state, None) - planned(forces, state)
    assert np.linalg.norm(error[:3]) < 1e-3
    assert np.linalg.norm(error[3:]) < 1e-7


def test_the_whole_field_turns_as_the_bodys_rotation_says(mission, vehicle, solution):
    """Basilisk's acceleration against ours, after half a turn of the asteroid."""
    field = HarmonicField.bennu(mission.scenario.body.gm_m3_s2, 8)
    state = np.array(solution.nodes.state[70])
    plant = build_plant(
        mission, vehicle, start(state), field=field, light=False, gravity_gradient=False
    )
    half = 7732.0
    first, last = coast(plant, [half, half + 2.0], step_s=2.0)
    mean = (last.state[3:] - first.state[3:]) / 2.0
    middle = 0.5 * (first.state[:3] + last.state[:3])
    to_j2000 = mission.rotation.body_to_j2000(half + 1.0)
    expected = to_j2000 @ np.stack(field.acceleration(*(to_j2000.T @ middle)))
    point_mass = -field.gm * middle / np.linalg.norm(middle) ** 3
    assert np.linalg.norm(expected - point_mass) > 1e-8
    np.testing.assert_allclose(mean, expected, atol=2e-11)


def test_light_pushes_on_the_plates_as_their_formula_says(mission, vehicle):
    """Far from the asteroid nothing but light moves the spacecraft."""
    far = np.array([0.0, 1e6, 0.0, 0.0, 0.0, 0.0])
    attitude = Rotation.from_euler("xyz", [0.3, -0.5, 1.1])
    begin = Start(far, attitude, np.zeros(3), np.zeros(4))
    plant = build_plant(mission, vehicle, begin, field=None, gravity_gradient=False)
    (end,) = coast(plant, [10.0])
    pressure = irradiance(mission.scenario) / 299_792_458.0
    force = pressure * Plates.of(vehicle).force_per_pressure(
        attitude.inv().apply(mission.sun_direction(5.0))
    )
    gravity = mission.scenario.body.gm_m3_s2 / 1e12
    acceleration = end.state[3:] / 10.0 + gravity * np.array([0.0, 1.0, 0.0])
    expected = attitude.apply(force) / vehicle.mass.mass_kg
    np.testing.assert_allclose(acceleration, expected, rtol=2e-5, atol=2e-13)
