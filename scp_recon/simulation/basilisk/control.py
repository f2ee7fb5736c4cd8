"""Build the flight software: attitude control, choice of actuators, momentum dumping and burns.

Basilisk's algorithms do the control: MRP steering with a rate limit, a rate servo, wheel and thruster
allocation, a Schmitt trigger, momentum dumping. `Navigator` feeds them; `Allocator` and `Firer` join
them to the actuators.
"""

from __future__ import annotations

import numpy as np
from Basilisk.architecture import messaging, sysModel
from Basilisk.fswAlgorithms import (
    attTrackingError,
    mrpSteering,
    rateServoFullNonlinear,
    rwMotorTorque,
    thrFiringSchmitt,
    thrForceMapping,
    thrMomentumDumping,
    thrMomentumManagement,
)
from Basilisk.utilities import macros
from scipy.spatial.transform import Rotation

from formulations.arrays import Array
from scp_recon.mission.schedule import Mode
from scp_recon.physics.frames import unit
from scp_recon.simulation.basilisk.navigation import Navigator, Sensors
from scp_recon.simulation.basilisk.plant import STEP_S, Plant
from scp_recon.simulation.estimator import AttitudeFilter
from scp_recon.simulation.flight import Actuators
from scp_recon.simulation.guidance import CONTROL_PERIOD_S, FlightPlan
from scp_recon.simulation.vehicle import Vehicle

BANDWIDTH_RAD_S = 0.02
"""Natural frequency about the axis of largest inertia, critically damped: a flip settles in 15 min."""

SLEW_RATE_RAD_S = np.deg2rad(0.4)

HAND_OVER_RAD = 0.1
"""Attitude error above which the micro-thrusters control; MuSCAT's."""

DUMP_PAUSE = 20
"""Control periods between two pulses of a momentum dump, in which the wheels settle the attitude."""


def build_flight_software(
    plan: FlightPlan,
    commands: Rotation,
    plant: Plant,
    sensors: Sensors,
    attitude_filter: AttitudeFilter,
    times_s: Array,
    pulse_error: Array,
    burn_error: Array,
) -> tuple[list[sysModel.SysModel], Navigator, Allocator, Firer]:
    """Build modules in the order of their execution, and those that keep a record.

    Commands are attitudes from the body to J2000, one for each of n control periods. `pulse_error` is
    each micro-thruster's in each period, N, shape (n, thrusters); `burn_error` each burn's, relative,
    shape (m,).
    """
    vehicle = plan.vehicle
    config = _mass_properties(vehicle)
    navigator = Navigator(plan, commands, sensors, attitude_filter, times_s)
    tracking, steering, servo = _controller(plant, vehicle, navigator, config)
    management, impulses, dumping = _momentum_dumping(plant, vehicle, config)
    allocator = Allocator(plan, plant, times_s, management)
    allocator.guidance.subscribeTo(tracking.attGuidOutMsg)
    allocator.torque.subscribeTo(servo.cmdTorqueOutMsg)
    motors = _wheel_motors(plant, allocator.for_wheels)
    forces = _force_mapping(plant, config, allocator.for_thrusters)
    pulses = _trigger(plant, vehicle, forces)
    firer = Firer(plan, plant, allocator, servo, pulses, pulse_error, burn_error)
    firer.control.subscribeTo(pulses.onTimeOutMsg)
    firer.dumping.subscribeTo(dumping.thrusterOnTimeOutMsg)
    plant.micro.cmdsInMsg.subscribeTo(firer.micro)
    plant.chemical.cmdsInMsg.subscribeTo(firer.chemical)
    # fmt: off
    order = [navigator, tracking, steering, servo, allocator, motors, forces, pulses,
             management, impulses, dumping, firer]
    # fmt: on
    return order, navigator, allocator, firer


def _mass_properties(vehicle: Vehicle) -> messaging.VehicleConfigMsg:
    known = messaging.VehicleConfigMsgPayload(
        ISCPntB_B=vehicle.inertia.ravel().tolist(), massSC=vehicle.mass.mass_kg
    )
    return messaging.VehicleConfigMsg().write(known)


def _controller(
    plant: Plant, vehicle: Vehicle, navigator: Navigator, config: messaging.VehicleConfigMsg
) -> tuple[
    attTrackingError.attTrackingError,
    mrpSteering.mrpSteering,
    rateServoFullNonlinear.rateServoFullNonlinear,
]:
    """Gains for J (theta'' + 2 w theta' + w^2 theta) = 0, with MRPs of a quarter of the angle."""
    tracking = attTrackingError.attTrackingError()
    tracking.attNavInMsg.subscribeTo(navigator.navigation)
    tracking.attRefInMsg.subscribeTo(navigator.reference)
    steering = mrpSteering.mrpSteering()
    steering.K1, steering.K3 = 2.0 * BANDWIDTH_RAD_S, 0.0
    steering.omega_max = SLEW_RATE_RAD_S
    steering.ignoreOuterLoopFeedforward = True
    steering.guidInMsg.subscribeTo(tracking.attGuidOutMsg)
    servo = rateServoFullNonlinear.rateServoFullNonlinear()
    servo.P = 2.0 * BANDWIDTH_RAD_S * max(vehicle.mass.inertia_kg_m2)
    servo.Ki = -1.0
    servo.guidInMsg.subscribeTo(tracking.attGuidOutMsg)
    servo.rateSteeringInMsg.subscribeTo(steering.rateCmdOutMsg)
    servo.vehConfigInMsg.subscribeTo(config)
    servo.rwParamsInMsg.subscribeTo(plant.wheel_config)
    servo.rwSpeedsInMsg.subscribeTo(plant.wheels.rwSpeedOutMsg)
    return tracking, steering, servo


def _wheel_motors(plant: Plant, torque: messaging.CmdTorqueBodyMsg) -> rwMotorTorque.rwMotorTorque:
    """Module from a torque to the wheels' torques."""
    motors = rwMotorTorque.rwMotorTorque()
    motors.controlAxes_B = np.eye(3).ravel().tolist()
    motors.vehControlInMsg.subscribeTo(torque)
    motors.rwParamsInMsg.subscribeTo(plant.wheel_config)
    plant.wheels.rwMotorCmdInMsg.subscribeTo(motors.rwMotorTorqueOutMsg)
    return motors


def _force_mapping(
    plant: Plant, config: messaging.VehicleConfigMsg, torque: messaging.CmdTorqueBodyMsg
) -> thrForceMapping.thrForceMapping:
    """Module from a torque (or angular impulse) to forces (or impulses) of the micro-thrusters."""
    mapping = thrForceMapping.thrForceMapping()
    mapping.controlAxes_B = np.eye(3).ravel().tolist()
    mapping.thrForceSign = 1
    mapping.cmdTorqueInMsg.subscribeTo(torque)
    mapping.thrConfigInMsg.subscribeTo(plant.micro_config)
    mapping.vehConfigInMsg.subscribeTo(config)
    return mapping


def _trigger(
    plant: Plant, vehicle: Vehicle, forces: thrForceMapping.thrForceMapping
) -> thrFiringSchmitt.thrFiringSchmitt:
    """Module from forces of the micro-thrusters to pulses."""
    trigger = thrFiringSchmitt.thrFiringSchmitt()
    trigger.thrMinFireTime = vehicle.micro_thrusters.pulse_min_s
    trigger.level_on, trigger.level_off = 0.75, 0.25
    trigger.thrForceInMsg.subscribeTo(forces.thrForceCmdOutMsg)
    trigger.thrConfInMsg.subscribeTo(plant.micro_config)
    return trigger


def _momentum_dumping(
    plant: Plant, vehicle: Vehicle, config: messaging.VehicleConfigMsg
) -> tuple[
    thrMomentumManagement.thrMomentumManagement,
    thrForceMapping.thrForceMapping,
    thrMomentumDumping.thrMomentumDumping,
]:
    management = thrMomentumManagement.thrMomentumManagement()
    management.hs_min = 0.0
    management.rwSpeedsInMsg.subscribeTo(plant.wheels.rwSpeedOutMsg)
    management.rwConfigDataInMsg.subscribeTo(plant.wheel_config)
    impulses = _force_mapping(plant, config, management.deltaHOutMsg)
    dumping = thrMomentumDumping.thrMomentumDumping()
    dumping.maxCounterValue = 1
    dumping.thrMinFireTime = vehicle.micro_thrusters.pulse_min_s
    dumping.deltaHInMsg.subscribeTo(management.deltaHOutMsg)
    dumping.thrusterImpulseInMsg.subscribeTo(impulses.thrForceCmdOutMsg)
    dumping.thrusterConfInMsg.subscribeTo(plant.micro_config)
    return management, impulses, dumping


class Allocator(sysModel.SysModel):
    """Gives the commanded torque to the wheels or to the micro-thrusters, and starts dumps.

    The thrusters act during burns, while the attitude error is large, and while the torque exceeds the
    wheels'; otherwise the wheels do. A dump starts in sun-pointing mode when a wheel is near its
    largest speed, and ends when the wheels' momentum is small; the wheels hold the attitude meanwhile.
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
        self.in_use, self._times_s = np.zeros(len(times_s), dtype=np.int8), times_s
        self.follow(plan)
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

    def follow(self, plan: FlightPlan) -> None:
        """Take up a plan with other burns."""
        times = self._times_s
        self._burning, self._idle = np.zeros((2, len(times)), dtype=bool)
        for firing in plan.firings:
            self._burning |= (times >= firing.start_s) & (times < firing.end_s)
        for leg in plan.legs:
            if leg.mode is Mode.SUN_POINTING:
                self._idle |= (times >= leg.start_s) & (times < leg.end_s)

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
    """Adds the commands of control and dumping to the micro-thrusters, and fires the burns.

    Every pulse has its own error of thrust, a burn one error for its whole length. The burn's torque
    is fed forward one period after it begins and ends: pulses start with their period, and so cancel
    the burn's effect in the period before. Without the delay the error grows throughout the burn.
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
        self.plant, self.allocator, self.servo = plant, allocator, servo
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
        self.follow(plan)

    def follow(self, plan: FlightPlan) -> None:
        """Take up a plan with other burns."""
        self.plan = plan
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
