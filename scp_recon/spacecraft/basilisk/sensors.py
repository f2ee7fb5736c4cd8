"""Basilisk's models of star tracker, gyro and Sun sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from Basilisk.architecture import messaging, sysModel
from Basilisk.simulation import coarseSunSensor, imuSensor, starTracker

from scp_recon.mission.mission import AU_KM
from scp_recon.spacecraft.basilisk.surroundings import Surroundings
from scp_recon.spacecraft.estimator import SensorSigmas
from scp_recon.spacecraft.guidance import CONTROL_PERIOD_S
from scp_recon.spacecraft.vehicle import Vehicle


@dataclass(frozen=True)
class Sensors:
    """Basilisk's sensor models, each with its own seed."""

    star_tracker: starTracker.StarTracker
    gyro: imuSensor.ImuSensor
    suns: tuple[coarseSunSensor.CoarseSunSensor, ...]

    @property
    def models(self) -> list[sysModel.SysModel]:
        """Star tracker, gyro and Sun sensors, as Basilisk's tasks take them."""
        return [self.star_tracker, self.gyro, *self.suns]


def build_sensors(
    states: messaging.SCStatesMsg,
    surroundings: Surroundings,
    vehicle: Vehicle,
    sigmas: SensorSigmas,
    seeds: dict[str, int],
) -> Sensors:
    """Sensors of a hub with these states, whose noise is white with the given sigmas."""
    white = np.zeros((3, 3)).tolist()
    tracker = starTracker.StarTracker()
    tracker.scStateInMsg.subscribeTo(states)
    tracker.PMatrix = (sigmas.star_tracker * np.eye(3)).tolist()
    tracker.setAMatrix(white)
    tracker.setWalkBounds([[np.pi]] * 3)
    tracker.RNGSeed = seeds["star_tracker"]
    gyro = imuSensor.ImuSensor()
    gyro.scStateInMsg.subscribeTo(states)
    gyro.PMatrixGyro = (sigmas.gyro / CONTROL_PERIOD_S * np.eye(3)).tolist()
    gyro.setAMatrixGyro(white)
    gyro.setWalkBoundsGyro(np.full(3, np.pi))
    gyro.RNGSeed = seeds["imu"]
    # Basilisk's are as bright as the Sun; of that a sensor's cosine must not depend, nor its noise.
    sun_km = np.linalg.norm(surroundings.mission.scenario.sun.body_position_km)
    scale = float(sun_km / AU_KM) ** 2
    suns = []
    for index, boresight in enumerate(vehicle.sensors.sun_sensors):
        sun = coarseSunSensor.CoarseSunSensor()
        sun.stateInMsg.subscribeTo(states)
        sun.sunInMsg.subscribeTo(surroundings.sun)
        sun.sunEclipseInMsg.subscribeTo(surroundings.shadow)
        sun.nHat_B = [[x] for x in boresight]
        sun.fov = np.deg2rad(vehicle.sensors.sun_sensor_half_angle_deg)
        sun.scaleFactor, sun.senNoiseStd = scale, sigmas.sun_sensor / scale
        sun.minOutput, sun.maxOutput = -10.0, 10.0
        sun.RNGSeed = (seeds["sun_sensor"] + index) % 2**32
        suns.append(sun)
    return Sensors(tracker, gyro, tuple(suns))
