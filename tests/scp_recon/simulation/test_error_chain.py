"""Errors of a simulated flight are as large as was drawn, and nothing else moves it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("Basilisk", reason="needs the extra [sim]")

from Basilisk.utilities import SimulationBaseClass, macros

from experiments.model_fidelity.models import Plates
from scp_recon.mission.schedule import Leg, Mode
from scp_recon.physics.frames import unit
from scp_recon.physics.harmonics import HarmonicField
from scp_recon.simulation.basilisk.navigation import build_sensors
from scp_recon.simulation.basilisk.plant import Start, build_plant
from scp_recon.simulation.basilisk.simulation import Draws, Simulator, Source, sensor_sigmas
from scp_recon.simulation.guidance import FlightPlan
from scp_recon.simulation.panels import irradiance


def test_coasting_is_the_field_of_degree_eight_and_light_on_the_plates(short_mission, vehicle):
    """Forty seconds at 400 m, where the degrees from five on still pull as much as light pushes."""
    state = short_mission.initial_state
    state = np.concatenate([400.0 * unit(state[:3]), state[3:]])
    attitude, times = Rotation.from_euler("xyz", [0.3, -0.5, 1.1]), np.arange(41.0)
    plan = FlightPlan(short_mission, vehicle, (), (Leg(Mode.SUN_POINTING, 0.0, 40.0),), ())
    draws = Draws.of(plan, np.zeros((6, 6)), len(times), 0, ())
    start = Start(state, attitude, np.zeros(3), np.zeros(4))
    sigmas = sensor_sigmas(vehicle.errors, ())
    sim = Simulator(plan, Rotation.concatenate([attitude] * 41), start, draws, sigmas, times)
    sim.run()
    flight = sim.flight()
    assert not flight.micro_on_s.any()
    gm, expected = short_mission.scenario.body.gm_m3_s2, {}
    pressure = irradiance(short_mission.scenario) / 299_792_458.0
    for degree in (8, 4):
        field, total = HarmonicField.bennu(gm, degree), np.zeros(3)
        for k, weight in ((0, 1.0), (20, 4.0), (40, 1.0)):  # Simpson's rule
            to_j2000 = short_mission.rotation.body_to_j2000(times[k])
            here = to_j2000.T @ flight.states[k, :3]
            sun = flight.attitudes[k].inv().apply(short_mission.sun_direction(times[k]))
            push = pressure * Plates.of(vehicle).force_per_pressure(sun) / vehicle.mass.mass_kg
            total += weight * to_j2000 @ np.stack(field.acceleration(*here))
            total += weight * flight.attitudes[k].apply(push)
        expected[degree] = total / 6.0
    gained = (flight.states[-1, 3:] - flight.states[0, 3:]) / 40.0
    off = {degree: np.linalg.norm(gained - mean) for degree, mean in expected.items()}
    assert off[8] < 2e-10 < 1e-8 < min(off[4], np.linalg.norm(push))


def test_sensors_err_as_their_sigmas_say(short_mission, vehicle):
    """Two thousand readings on a slow turn; a Sun sensor's are cosines, at any distance."""
    n, sigmas = 2000, sensor_sigmas(vehicle.errors, frozenset(Source))
    sun = short_mission.sun_direction(0.0)
    begin = Rotation.align_vectors([sun], [unit([0.5, 0.6, 0.62])])[0]
    start = Start(short_mission.initial_state, begin, np.array([1e-5, -2e-5, 1e-5]), np.zeros(4))
    plant = build_plant(short_mission, vehicle, start, field=None, light=False)
    seeds = {"star_tracker": 1, "imu": 2, "sun_sensor": 3}
    states = plant.hub.scStateOutMsg
    sensors = build_sensors(states, plant.surroundings, vehicle, sigmas, seeds)
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
