"""Which actuators act: wheels or micro-thrusters, momentum dumping, and the burns."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from Basilisk.architecture import messaging, sysModel
from Basilisk.fswAlgorithms import rateServoFullNonlinear, thrFiringSchmitt, thrMomentumManagement
from Basilisk.utilities import macros

from scp_recon.mission.schedule import Mode
from scp_recon.physics.frames import unit
from scp_recon.spacecraft.basilisk.plant import STEP_S, Plant
from scp_recon.spacecraft.flight import Actuators
from scp_recon.spacecraft.guidance import CONTROL_PERIOD_S, FlightPlan

Array = npt.NDArray[np.float64]

HAND_OVER_RAD = 0.1
"""Attitude error above which the micro-thrusters control; MuSCAT's."""

DUMP_PAUSE = 20
"""Control periods between two pulses of a momentum dump, in which the wheels settle the attitude."""


class Allocator(sysModel.SysModel):
    """Gives the commanded torque to the wheels or to the micro-thrusters, and starts dumps.

    The thrusters take it during burns, while the attitude error is large, and while the torque is more
    than the wheels can give; otherwise the wheels. A dump starts in sun-pointing mode when a wheel is
    near its largest speed, and ends when their momentum is small; it leaves the attitude to the wheels.
    """

    def __init__(
        self,
        plan: FlightPlan,
        plant: Plant,
        times_s: Array,
        dump: thrMomentumManagement.thrMomentumManagement,
    ) -> None:
        super().__init__()
        self.dump = dump
        self.wheels, self.dumping, self.dumps = plan.vehicle.wheels, False, 0
        self.in_use = np.zeros(len(times_s), dtype=np.int8)
        self._burning, self._idle = np.zeros((2, len(times_s)), dtype=bool)
        for firing in plan.firings:
            self._burning |= (times_s >= firing.start_s) & (times_s < firing.end_s)
        for leg in plan.legs:
            if leg.mode is Mode.SUN_POINTING:
                self._idle |= (times_s >= leg.start_s) & (times_s < leg.end_s)
        self.for_wheels = messaging.CmdTorqueBodyMsg()
        self.for_thrusters = messaging.CmdTorqueBodyMsg()
        self.guidance, self.torque = (
            messaging.AttGuidMsgReader(),
            messaging.CmdTorqueBodyMsgReader(),
        )
        self.speeds = plant.wheels.rwSpeedOutMsg.addSubscriber()
        self._payload = messaging.CmdTorqueBodyMsgPayload()
        self._axes = unit(self.wheels.axes)
        self._share = np.linalg.pinv(self._axes.T)

    def UpdateState(self, now: int) -> None:  # noqa: N802, D102 -- as Basilisk names it
        k = round(now * macros.NANO2SEC / CONTROL_PERIOD_S)
        error = 4.0 * np.arctan(np.linalg.norm(self.guidance().sigma_BR))
        torque = np.array(self.torque().torqueRequestBody)
        speeds = np.array(self.speeds().wheelSpeeds[: len(self.wheels.axes)])
        share = np.abs(speeds).max() / self.wheels.speed_max_rad_s
        too_much = np.abs(self._share @ torque).max() > self.wheels.torque_max_n_m
        rough = self._burning[k] or error > HAND_OVER_RAD or (too_much and not self.dumping)
        momentum = np.linalg.norm(self._axes.T @ speeds) / self.wheels.speed_max_rad_s
        if not self.dumping and share >= self.wheels.dump_start and self._idle[k] and not rough:
            self.dumping, self.dumps = True, self.dumps + 1
        elif self.dumping and (momentum < self.wheels.dump_end or not self._idle[k]):
            self.dumping = False
        # The allocation limits an impulse to what one control period can give: ask again and again.
        if self.dumping and k % DUMP_PAUSE == 0:
            self.dump.Reset(now)
        rough = rough or (share >= 1.0 and not self.dumping)
        none = np.zeros(3)
        self._write(self.for_wheels, none if rough else torque, now)
        self._write(self.for_thrusters, torque if rough else none, now)
        self.in_use[k] = (
            Actuators.THRUSTERS if rough else Actuators.BOTH if self.dumping else Actuators.WHEELS
        )

    def _write(self, message: messaging.CmdTorqueBodyMsg, torque: Array, now: int) -> None:
        self._payload.torqueRequestBody = torque.tolist()
        message.write(self._payload, now)


class Firer(sysModel.SysModel):
    """Joins what control and dumping ask of the micro-thrusters, and fires the burns.

    Every pulse has its own error of thrust. A burn has one error for its whole length. Its torque is
    fed forward one period after it begins and ends: pulses start with their period, so that each
    undoes what the burn did in the last; without the delay the error grows all through the burn.
    """

    def __init__(
        self,
        plan: FlightPlan,
        plant: Plant,
        allocator: Allocator,
        servo: rateServoFullNonlinear.rateServoFullNonlinear,
        pulses: thrFiringSchmitt.thrFiringSchmitt,
        pulse_error: Array,
        burn_error: Array,
    ) -> None:
        super().__init__()
        self.plan, self.plant, self.allocator, self.servo = plan, plant, allocator, servo
        self.pulses, self.pulse_error, self.burn_error = pulses, pulse_error, burn_error
        self.on_time_s = np.zeros((len(pulse_error), len(plant.micro_thrusters)))
        self.micro, self.chemical = (
            messaging.THRArrayOnTimeCmdMsg(),
            messaging.THRArrayOnTimeCmdMsg(),
        )
        self.control, self.dumping = (
            messaging.THRArrayOnTimeCmdMsgReader(),
            messaging.THRArrayOnTimeCmdMsgReader(),
        )
        self._starts = {round(f.start_s / CONTROL_PERIOD_S): i for i, f in enumerate(plan.firings)}
        self._ends = {round(f.end_s / CONTROL_PERIOD_S) for f in plan.firings}

    def UpdateState(self, now: int) -> None:  # noqa: N802, D102 -- as Basilisk names it
        k = round(now * macros.NANO2SEC / CONTROL_PERIOD_S)
        if k == 0:
            # The trigger takes a call at time zero for none, and would rest in its second call too.
            self.pulses.prevCallTime = 1
        thrusters = self.plant.micro_thrusters
        n = len(thrusters)
        on_time = np.array(self.control().OnTimeRequest[:n])
        if self.allocator.dumping:
            on_time += np.array(self.dumping().OnTimeRequest[:n])
        self.on_time_s[k] = np.clip(on_time, 0.0, CONTROL_PERIOD_S)
        if on_time.any():
            nominal = self.plan.vehicle.micro_thrusters.thrust_n
            for thruster, error in zip(thrusters, self.pulse_error[k], strict=True):
                thruster.MaxThrust = nominal + error
        request = messaging.THRArrayOnTimeCmdMsgPayload(OnTimeRequest=self.on_time_s[k].tolist())
        self.micro.write(request, now)
        if k in self._ends:
            self.servo.knownTorquePntB_B = [0.0, 0.0, 0.0]
        if k in self._starts:
            self._ignite(self._starts[k], now)

    def _ignite(self, index: int, now: int) -> None:
        firing, vehicle = self.plan.firings[index], self.plan.vehicle
        if not firing.duration_s:
            return
        impulse = vehicle.mass.mass_kg * float(np.linalg.norm(firing.dv_m_s))
        # A command that ends just short of a step lets the last of its four stages pass, a sixth of it.
        thrust = impulse / (firing.duration_s - STEP_S / 6.0)
        self.plant.chemical_thruster.MaxThrust = thrust * (1.0 + self.burn_error[index])
        on_time = firing.duration_s - 0.01 * STEP_S
        self.chemical.write(messaging.THRArrayOnTimeCmdMsgPayload(OnTimeRequest=[on_time]), now)
        chemical = vehicle.chemical_thruster
        arm = np.array(chemical.position_m) - vehicle.centre_of_mass_m
        self.servo.knownTorquePntB_B = (thrust * np.cross(arm, unit(chemical.direction))).tolist()
