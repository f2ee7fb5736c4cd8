"""Flight software: estimation, attitude control, choice of actuators, momentum dumping and burns.

Basilisk's algorithms do the control: MRP steering with a rate limit, a rate servo, wheel and thruster
allocation, a Schmitt trigger, momentum dumping. The modules of `navigation` and `actuation` feed and
join them.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
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
from scipy.spatial.transform import Rotation

from scp_recon.spacecraft.basilisk.actuation import Allocator, Firer
from scp_recon.spacecraft.basilisk.navigation import Navigator
from scp_recon.spacecraft.basilisk.plant import Plant
from scp_recon.spacecraft.basilisk.sensors import Sensors
from scp_recon.spacecraft.estimator import AttitudeFilter
from scp_recon.spacecraft.guidance import FlightPlan
from scp_recon.spacecraft.vehicle import Vehicle

Array = npt.NDArray[np.float64]

BANDWIDTH_RAD_S = 0.02
"""Natural frequency about the axis of largest inertia, critically damped: a flip settles in 15 min."""

SLEW_RATE_RAD_S = np.deg2rad(0.4)


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
    """Modules in the order of their execution, and those that keep a record.

    Args:
        plan: modes and burns.
        commands: attitudes in every control period, from the body to J2000.
        plant: what is controlled; its actuators are connected.
        sensors: what is known of it.
        attitude_filter: first estimate.
        times_s: control periods, shape (n,).
        pulse_error: of each micro-thruster in each period, N, shape (n, thrusters).
        burn_error: of each burn, relative, shape (m,).
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
    """From a torque to those of the wheels."""
    motors = rwMotorTorque.rwMotorTorque()
    motors.controlAxes_B = np.eye(3).ravel().tolist()
    motors.vehControlInMsg.subscribeTo(torque)
    motors.rwParamsInMsg.subscribeTo(plant.wheel_config)
    plant.wheels.rwMotorCmdInMsg.subscribeTo(motors.rwMotorTorqueOutMsg)
    return motors


def _force_mapping(
    plant: Plant, config: messaging.VehicleConfigMsg, torque: messaging.CmdTorqueBodyMsg
) -> thrForceMapping.thrForceMapping:
    """From a torque (or an angular impulse) to forces (or impulses) of the micro-thrusters."""
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
    """From forces of the micro-thrusters to pulses."""
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
