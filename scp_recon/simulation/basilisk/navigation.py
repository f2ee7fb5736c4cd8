"""Build star tracker, gyro and Sun sensors, and the software that estimates the attitude from them."""

from __future__ import annotations

import numpy as np
from Basilisk.architecture import messaging, sysModel
from Basilisk.simulation import coarseSunSensor, imuSensor, starTracker
from Basilisk.utilities import macros
from scipy.spatial.transform import Rotation

from formulations.arrays import Array
from scp_recon.bodies.catalogue import AU_KM
from scp_recon.physics.frames import unit
from scp_recon.simulation.basilisk.plant import Plant, module
from scp_recon.simulation.estimator import AttitudeFilter, SensorSigmas
from scp_recon.simulation.guidance import CONTROL_PERIOD_S, FlightPlan

JUMP_RAD_S = 0.01
"""A command that turns faster has jumped to another mode; within a mode it turns at some 1e-4 rad/s."""


class Sensors:
    """Star tracker, gyro and Sun sensors of a plant, each with its own seed; their noise is white."""

    def __init__(self, plant: Plant, sigmas: SensorSigmas, seeds: dict[str, int]) -> None:
        state, around, white = (
            plant.hub.scStateOutMsg,
            plant.surroundings,
            np.zeros((3, 3)).tolist(),
        )
        self.star_tracker = module(
            starTracker.StarTracker(),
            {"scStateInMsg": state},
            PMatrix=(sigmas.star_tracker * np.eye(3)).tolist(),
            RNGSeed=seeds["star_tracker"],
        )
        self.star_tracker.setAMatrix(white)
        self.star_tracker.setWalkBounds([[np.pi]] * 3)
        self.gyro = module(
            imuSensor.ImuSensor(),
            {"scStateInMsg": state},
            PMatrixGyro=(sigmas.gyro / CONTROL_PERIOD_S * np.eye(3)).tolist(),
            RNGSeed=seeds["imu"],
        )
        self.gyro.setAMatrixGyro(white)
        self.gyro.setWalkBoundsGyro(np.full(3, np.pi))
        # Basilisk's are as bright as the Sun; of that a sensor's cosine must not depend, nor its noise.
        sun_km = np.linalg.norm(around.mission.scenario.sun.body_position_km)
        scale, known = float(sun_km / AU_KM) ** 2, plant.vehicle.sensors
        self.suns = [
            module(
                coarseSunSensor.CoarseSunSensor(),
                {"stateInMsg": state, "sunInMsg": around.sun, "sunEclipseInMsg": around.shadow},
                nHat_B=[[x] for x in boresight],
                fov=np.deg2rad(known.sun_sensor_half_angle_deg),
                scaleFactor=scale,
                senNoiseStd=sigmas.sun_sensor / scale,
                minOutput=-10.0,
                maxOutput=10.0,
                RNGSeed=(seeds["sun_sensor"] + index) % 2**32,
            )
            for index, boresight in enumerate(known.sun_sensors)
        ]

    @property
    def models(self) -> list[sysModel.SysModel]:
        """Star tracker, gyro and Sun sensors, as Basilisk's tasks take them."""
        return [self.star_tracker, self.gyro, *self.suns]


class Navigator(sysModel.SysModel):
    """Reads the sensors, estimates the attitude, and looks up the command of the moment."""

    def __init__(
        self,
        plan: FlightPlan,
        commands: Rotation,
        sensors: Sensors,
        attitude_filter: AttitudeFilter,
        times_s: Array,
    ) -> None:
        super().__init__()
        self.filter = attitude_filter
        self.estimates = np.empty((len(times_s), 4))
        self.navigation, self.reference = messaging.NavAttMsg(), messaging.AttRefMsg()
        self._tracker = sensors.star_tracker.sensorOutMsg.addSubscriber()
        self._gyro = sensors.gyro.sensorOutMsg.addSubscriber()
        self._suns = [sun.cssDataOutMsg.addSubscriber() for sun in sensors.suns]
        vehicle = plan.vehicle.sensors
        self._boresights = unit(vehicle.sun_sensors)
        self._tracker_axis = unit(vehicle.star_tracker)
        self._blind = np.cos(np.deg2rad(vehicle.star_tracker_sun_exclusion_deg))
        self._seen = np.cos(np.deg2rad(vehicle.sun_sensor_half_angle_deg))
        self.follow(commands)
        self._navigation = messaging.NavAttMsgPayload()
        self._reference = messaging.AttRefMsgPayload()
        self._sun = plan.mission.sun_direction(times_s)

    def follow(self, commands: Rotation) -> None:
        """Look up other commands from now on."""
        self.commands = commands
        self._mrps = commands.as_mrp().tolist()
        self._rates = _rates(commands).tolist()

    def UpdateState(self, now: int) -> None:  # noqa: N802, D102 -- as Basilisk names it
        k = round(now * macros.NANO2SEC / CONTROL_PERIOD_S)
        gyro, estimate = self._gyro(), self.filter
        if k > 0:
            estimate.turn(np.array(gyro.DRFramePlatform))
            sun_body = estimate.to_j2000.T @ self._sun[k]
            stars = None
            if self._tracker_axis @ sun_body < self._blind:
                stars = np.array(self._tracker().qInrtl2Case)
            lit = self._boresights @ sun_body > self._seen
            cosines = np.array([self._suns[i]().OutputData for i in np.flatnonzero(lit)])
            estimate.see(stars, cosines, self._boresights[lit], self._sun[k])
        self.estimates[k] = estimate.quaternion
        self._navigation.sigma_BN = estimate.mrp.tolist()
        self._navigation.omega_BN_B = gyro.AngVelPlatform
        self.navigation.write(self._navigation, now)
        self._reference.sigma_RN = self._mrps[k]
        self._reference.omega_RN_N = self._rates[k]
        self.reference.write(self._reference, now)


def _rates(commands: Rotation) -> Array:
    """Rates of the commands between their jumps, J2000, rad/s, shape (n, 3)."""
    steps = (commands[1:] * commands[:-1].inv()).as_rotvec() / CONTROL_PERIOD_S
    steps[np.linalg.norm(steps, axis=1) > JUMP_RAD_S] = 0.0
    return np.concatenate([steps, steps[-1:]])
