"""The plant against forces and flows written apart, and errors as large as was drawn."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from formulations.arrays import Array

pytest.importorskip("Basilisk", reason="needs the extra [sim]")

from Basilisk.utilities import SimulationBaseClass, macros

from experiments.left_out import light_force, plates_of
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import Leg, Mode
from scp_recon.physics.flow import propagate
from scp_recon.physics.frames import unit
from scp_recon.physics.harmonics import HarmonicField
from scp_recon.simulation.basilisk.control import Sensors
from scp_recon.simulation.basilisk.plant import STEP_S, Plant, Start
from scp_recon.simulation.basilisk.simulation import Draws, Simulator, Source, sensor_sigmas
from scp_recon.simulation.guidance import FlightPlan, irradiance
from scp_recon.simulation.vehicle import Vehicle

pytestmark = pytest.mark.slow

DURATION_S = 17_421.0


def coast(
    plant: Plant, times_s: Sequence[float] | Array, step_s: float = STEP_S
) -> Iterator[Array]:
    """Fly without flight software, and stop with the state, J2000, at each of the ascending times."""
    sim = SimulationBaseClass.SimBaseClass()
    process = sim.CreateNewProcess("flight")
    process.addTask(sim.CreateNewTask("dynamics", macros.sec2nano(step_s)))
    for model in (*plant.effectors, plant.hub):
        sim.AddModelToTask("dynamics", model)
    sim.InitializeSimulation()
    for time in times_s:
        sim.ConfigureStopTime(macros.sec2nano(float(time)))
        sim.ExecuteSimulation()
        now = plant.hub.scStateOutMsg.read()
        yield np.array([*now.r_CN_N, *now.v_CN_N])


def push(mission: Mission, vehicle: Vehicle, attitude: Rotation, time_s: float) -> Array:
    """Acceleration by light on the plates, by their own formula, in J2000."""
    pressure = irradiance(mission.scenario) / 299_792_458.0
    sun = attitude.inv().apply(mission.sun_direction(time_s))
    force = pressure * light_force(sun, *plates_of(vehicle))
    return attitude.apply(force) / vehicle.mass.mass_kg


def test_point_mass_arc_matches_planner_to_millimetre(mission, vehicle, solution):
    """Half as long as the plan, without light and torques."""
    forces = replace(mission.forces, j2_strength=0.0, srp=np.zeros(3))
    state = np.array(solution.nodes.state[0])
    start = Start(state, Rotation.identity(), np.zeros(3), np.zeros(4))
    plant = Plant(mission, vehicle, start, field=None, light=False, gravity_gradient=False)
    (end,) = coast(plant, [DURATION_S], step_s=3.0)
    error = end - propagate(state, DURATION_S, forces, substeps=1000)
    assert np.linalg.norm(error[:3]) < 1e-3
    assert np.linalg.norm(error[3:]) < 1e-7


def test_field_turns_with_the_bodys_rotation(mission, vehicle, solution):
    """Basilisk's acceleration against ours, after half a turn of the asteroid."""
    field = HarmonicField.bennu(mission.scenario.body.gm_m3_s2, 8)
    state = np.array(solution.nodes.state[70])
    start = Start(state, Rotation.identity(), np.zeros(3), np.zeros(4))
    plant = Plant(mission, vehicle, start, field=field, light=False, gravity_gradient=False)
    half = 7732.0
    first, last = coast(plant, [half, half + 2.0], step_s=2.0)
    mean = (last[3:] - first[3:]) / 2.0
    middle = 0.5 * (first[:3] + last[:3])
    to_j2000 = mission.rotation.body_to_j2000(half + 1.0)
    expected = to_j2000 @ np.stack(field.acceleration(*(to_j2000.T @ middle)))
    point_mass = -field.gm * middle / np.linalg.norm(middle) ** 3
    assert np.linalg.norm(expected - point_mass) > 1e-8
    np.testing.assert_allclose(mean, expected, atol=2e-11)


def test_plates_feel_light_by_their_formula(mission, vehicle):
    """Far from the asteroid nothing but light moves the spacecraft."""
    far = np.array([0.0, 1e6, 0.0, 0.0, 0.0, 0.0])
    attitude = Rotation.from_euler("xyz", [0.3, -0.5, 1.1])
    begin = Start(far, attitude, np.zeros(3), np.zeros(4))
    plant = Plant(mission, vehicle, begin, field=None, gravity_gradient=False)
    (end,) = coast(plant, [10.0])
    gravity = mission.scenario.body.gm_m3_s2 / 1e12
    acceleration = end[3:] / 10.0 + gravity * np.array([0.0, 1.0, 0.0])
    expected = push(mission, vehicle, attitude, 5.0)
    np.testing.assert_allclose(acceleration, expected, rtol=2e-5, atol=2e-13)


def test_coasting_has_degree_eight_field_and_light(short_mission, vehicle):
    """Forty seconds at 400 m, where the degrees from five on still pull as much as light pushes."""
    state = short_mission.initial_state
    state = np.concatenate([400.0 * unit(state[:3]), state[3:]])
    attitude, times = Rotation.from_euler("xyz", [0.3, -0.5, 1.1]), np.arange(41.0)
    plan = FlightPlan(short_mission, vehicle, (), (Leg(Mode.SUN_POINTING, 0.0, 40.0),), ())
    draws = Draws.of(plan, np.zeros((6, 6)), len(times), 0, ())
    start = Start(state, attitude, np.zeros(3), np.zeros(4))
    sim = Simulator(plan, Rotation.concatenate([attitude] * 41), start, draws, times)
    sim.run()
    flight = sim.flight()
    assert not flight.micro_on_s.any()
    gm, expected = short_mission.scenario.body.gm_m3_s2, {}
    for degree in (8, 4):
        field, total = HarmonicField.bennu(gm, degree), np.zeros(3)
        for k, weight in ((0, 1.0), (20, 4.0), (40, 1.0)):  # Simpson's rule
            to_j2000 = short_mission.rotation.body_to_j2000(times[k])
            here = to_j2000.T @ flight.states[k, :3]
            light = push(short_mission, vehicle, flight.attitudes[k], times[k])
            total += weight * (to_j2000 @ np.stack(field.acceleration(*here)) + light)
        expected[degree] = total / 6.0
    gained = (flight.states[-1, 3:] - flight.states[0, 3:]) / 40.0
    off = {degree: np.linalg.norm(gained - mean) for degree, mean in expected.items()}
    assert off[8] < 2e-10 < 1e-8 < min(off[4], np.linalg.norm(light))


def test_sensors_err_as_their_sigmas_say(short_mission, vehicle):
    """Two thousand readings on a slow turn; a Sun sensor's are cosines, at any distance."""
    n, sigmas = 2000, sensor_sigmas(vehicle.errors, frozenset(Source))
    sun = short_mission.sun_direction(0.0)
    begin = Rotation.align_vectors([sun], [unit([0.5, 0.6, 0.62])])[0]
    start = Start(short_mission.initial_state, begin, np.array([1e-5, -2e-5, 1e-5]), np.zeros(4))
    plant = Plant(short_mission, vehicle, start, field=None, light=False)
    seeds = {"star_tracker": 1, "imu": 2, "sun_sensor": 3}
    states, sensors = plant.hub.scStateOutMsg, Sensors(plant, sigmas, seeds)
    sim = SimulationBaseClass.SimBaseClass()
    process = sim.CreateNewProcess("flight")
    process.addTask(sim.CreateNewTask("all", macros.sec2nano(1.0)))
    suns = [s.cssDataOutMsg.recorder() for s in sensors.suns]
    hub, stars, gyro = (
        message.recorder()
        for message in (states, sensors.star_tracker.sensorOutMsg, sensors.gyro.sensorOutMsg)
    )
    for model in (*plant.effectors, plant.hub, *sensors.models, hub, stars, gyro, *suns):
        sim.AddModelToTask("all", model)
    sim.InitializeSimulation()
    sim.ConfigureStopTime(macros.sec2nano(float(n)))
    sim.ExecuteSimulation()
    attitudes = Rotation.from_mrp(hub.sigma_BN)
    off = (attitudes.inv() * Rotation.from_quat(stars.qInrtl2Case, scalar_first=True)).as_rotvec()
    turned = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec()
    read = {
        sigmas.star_tracker: off[1:],
        sigmas.gyro: gyro.DRFramePlatform[1:] - turned,
        sigmas.sun_sensor: np.stack([s.OutputData for s in suns], axis=1)[1:, [0, 2, 4]]
        - attitudes[1:].inv().apply(sun),
    }
    for sigma, error in read.items():
        np.testing.assert_allclose(error.std(axis=0), sigma, rtol=0.06)
        assert np.abs(error.mean(axis=0)).max() < 0.1 * sigma
