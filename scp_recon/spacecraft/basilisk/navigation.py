"""Flight software that knows where the spacecraft points and where it should."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from Basilisk.architecture import messaging, sysModel
from Basilisk.utilities import macros
from scipy.spatial.transform import Rotation

from scp_recon.physics.frames import unit
from scp_recon.spacecraft.basilisk.sensors import Sensors
from scp_recon.spacecraft.estimator import AttitudeFilter
from scp_recon.spacecraft.guidance import CONTROL_PERIOD_S, FlightPlan

Array = npt.NDArray[np.float64]

JUMP_RAD_S = 0.01
"""A command that turns faster has jumped to another mode; within a mode it turns at some 1e-4 rad/s."""


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
        self.plan, self.commands, self.filter = plan, commands, attitude_filter
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
        self._mrps = self.commands.as_mrp().tolist()
        self._rates = _rates(self.commands).tolist()
        self._navigation = messaging.NavAttMsgPayload()
        self._reference = messaging.AttRefMsgPayload()
        self._sun = plan.mission.sun_direction(times_s)

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
