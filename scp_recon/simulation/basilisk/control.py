"""Build sensors and flight software: navigation, attitude control, momentum dumping and burns.

Basilisk's algorithms do the control: MRP steering with a rate limit, a rate servo, wheel and thruster
allocation, a Schmitt trigger, momentum dumping. `Navigator` reads the sensors, estimates the attitude
and feeds them; `Allocator` and `Firer` join them to the actuators.
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
from Basilisk.simulation import coarseSunSensor, imuSensor, starTracker
from Basilisk.utilities import macros
from scipy.spatial.transform import Rotation

from formulations.arrays import Array
from scp_recon.bodies.catalogue import AU_KM
from scp_recon.mission.schedule import Mode
from scp_recon.physics.frames import unit
from scp_recon.simulation.basilisk.plant import STEP_S, Plant, module
from scp_recon.simulation.estimator import AttitudeFilter, SensorSigmas
from scp_recon.simulation.flight import Actuators
from scp_recon.simulation.guidance import CONTROL_PERIOD_S, Firing, FlightPlan
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
    vehicle, wheels, micro = plan.vehicle, plant.wheels, plant.micro_config
    inertia, eye = vehicle.inertia.ravel().tolist(), np.eye(3).ravel().tolist()
    known = messaging.VehicleConfigMsgPayload(ISCPntB_B=inertia, massSC=vehicle.mass.mass_kg)
    config = messaging.VehicleConfigMsg().write(known)
    navigator = Navigator(plan, commands, sensors, attitude_filter, times_s)
    tracking, steering, servo = _pointing(vehicle, plant, navigator, config)
    management = module(
        thrMomentumManagement.thrMomentumManagement(),
        {"rwSpeedsInMsg": wheels.rwSpeedOutMsg, "rwConfigDataInMsg": plant.wheel_config},
        hs_min=0.0,
    )
    allocator = Allocator(plan, plant, times_s, management)
    allocator.guidance.subscribeTo(tracking.attGuidOutMsg)
    allocator.torque.subscribeTo(servo.cmdTorqueOutMsg)
    motors = module(
        rwMotorTorque.rwMotorTorque(),
        {"vehControlInMsg": allocator.for_wheels, "rwParamsInMsg": plant.wheel_config},
        controlAxes_B=eye,
    )
    wheels.rwMotorCmdInMsg.subscribeTo(motors.rwMotorTorqueOutMsg)
    # From a torque to forces of the micro-thrusters, and from an angular impulse to impulses.
    forces, impulses = (
        module(
            thrForceMapping.thrForceMapping(),
            {"cmdTorqueInMsg": torque, "thrConfigInMsg": micro, "vehConfigInMsg": config},
            controlAxes_B=eye,
            thrForceSign=1,
        )
        for torque in (allocator.for_thrusters, management.deltaHOutMsg)
    )
    pulses = module(
        thrFiringSchmitt.thrFiringSchmitt(),
        {"thrForceInMsg": forces.thrForceCmdOutMsg, "thrConfInMsg": micro},
        thrMinFireTime=vehicle.micro_thrusters.pulse_min_s,
        level_on=0.75,
        level_off=0.25,
    )
    dumping = module(
        thrMomentumDumping.thrMomentumDumping(),
        {
            "deltaHInMsg": management.deltaHOutMsg,
            "thrusterImpulseInMsg": impulses.thrForceCmdOutMsg,
            "thrusterConfInMsg": micro,
        },
        maxCounterValue=1,
        thrMinFireTime=vehicle.micro_thrusters.pulse_min_s,
    )
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


def _pointing(
    vehicle: Vehicle, plant: Plant, navigator: Navigator, config: messaging.VehicleConfigMsg
) -> tuple[sysModel.SysModel, sysModel.SysModel, sysModel.SysModel]:
    """Build the modules from the attitude's error to the torque: tracking, steering and servo."""
    tracking = module(
        attTrackingError.attTrackingError(),
        {"attNavInMsg": navigator.navigation, "attRefInMsg": navigator.reference},
    )
    # Gains for J (theta'' + 2 w theta' + w^2 theta) = 0, with MRPs of a quarter of the angle.
    steering = module(
        mrpSteering.mrpSteering(),
        {"guidInMsg": tracking.attGuidOutMsg},
        K1=2.0 * BANDWIDTH_RAD_S,
        K3=0.0,
        omega_max=SLEW_RATE_RAD_S,
        ignoreOuterLoopFeedforward=True,
    )
    servo = module(
        rateServoFullNonlinear.rateServoFullNonlinear(),
        {
            "guidInMsg": tracking.attGuidOutMsg,
            "rateSteeringInMsg": steering.rateCmdOutMsg,
            "vehConfigInMsg": config,
            "rwParamsInMsg": plant.wheel_config,
            "rwSpeedsInMsg": plant.wheels.rwSpeedOutMsg,
        },
        P=2.0 * BANDWIDTH_RAD_S * max(vehicle.mass.inertia_kg_m2),
        Ki=-1.0,
    )
    return tracking, steering, servo


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
        self.plan, self.dump, self._times_s = plan, dump, times_s
        self.wheels, self.dumping, self.dumps = plan.vehicle.wheels, False, 0
        self.in_use = np.zeros(len(times_s), dtype=np.int8)
        self.for_wheels = messaging.CmdTorqueBodyMsg()
        self.for_thrusters = messaging.CmdTorqueBodyMsg()
        self.guidance = messaging.AttGuidMsgReader()
        self.torque = messaging.CmdTorqueBodyMsgReader()
        self.speeds = plant.wheels.rwSpeedOutMsg.addSubscriber()
        self._payload = messaging.CmdTorqueBodyMsgPayload()
        self._axes = unit(self.wheels.axes)
        self._share = np.linalg.pinv(self._axes.T)

    def UpdateState(self, now: int) -> None:  # noqa: N802, D102 -- as Basilisk names it
        k = round(now * macros.NANO2SEC / CONTROL_PERIOD_S)
        time, legs = self._times_s[k], self.plan.legs
        burning = any(firing.start_s <= time < firing.end_s for firing in self.plan.firings)
        idle = any(
            leg.start_s <= time < leg.end_s and leg.mode is Mode.SUN_POINTING for leg in legs
        )
        error = 4.0 * np.arctan(np.linalg.norm(self.guidance().sigma_BR))
        torque = np.array(self.torque().torqueRequestBody)
        speeds = np.array(self.speeds().wheelSpeeds[: len(self.wheels.axes)])
        share = np.abs(speeds).max() / self.wheels.speed_max_rad_s
        too_much = np.abs(self._share @ torque).max() > self.wheels.torque_max_n_m
        rough = burning or error > HAND_OVER_RAD or (too_much and not self.dumping)
        momentum = np.linalg.norm(self._axes.T @ speeds) / self.wheels.speed_max_rad_s
        if not self.dumping and share >= self.wheels.dump_start and idle and not rough:
            self.dumping, self.dumps = True, self.dumps + 1
        elif self.dumping and (momentum < self.wheels.dump_end or not idle):
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
        self.plan, self.plant, self.allocator, self.servo = plan, plant, allocator, servo
        self.pulses, self.pulse_error, self.burn_error = pulses, pulse_error, burn_error
        self.on_time_s = np.zeros((len(pulse_error), len(plant.micro_thrusters)))
        self.micro, self.chemical = (messaging.THRArrayOnTimeCmdMsg() for _ in range(2))
        self.control, self.dumping = (messaging.THRArrayOnTimeCmdMsgReader() for _ in range(2))

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
        for firing, error in zip(self.plan.firings, self.burn_error, strict=True):
            if k == round(firing.end_s / CONTROL_PERIOD_S):
                self.servo.knownTorquePntB_B = [0.0, 0.0, 0.0]
            if k == round(firing.start_s / CONTROL_PERIOD_S) and firing.duration_s:
                self._ignite(firing, error, now)

    def _ignite(self, firing: Firing, error: float, now: int) -> None:
        vehicle = self.plan.vehicle
        impulse = vehicle.mass.mass_kg * float(np.linalg.norm(firing.dv_m_s))
        # A command that ends just short of a step lets the last of its four stages pass, a sixth of it.
        thrust = impulse / (firing.duration_s - STEP_S / 6.0)
        self.plant.chemical_thruster.MaxThrust = thrust * (1.0 + error)
        on_time = firing.duration_s - 0.01 * STEP_S
        self.chemical.write(messaging.THRArrayOnTimeCmdMsgPayload(OnTimeRequest=[on_time]), now)
        chemical = vehicle.chemical_thruster
        arm = np.array(chemical.position_m) - vehicle.centre_of_mass_m
        self.servo.knownTorquePntB_B = (thrust * np.cross(arm, unit(chemical.direction))).tolist()


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
