"""Build the simulated spacecraft and its surroundings from Basilisk's modules.

The inertial frame is J2000 about the asteroid, which rests; the body frame has the vehicle's axes and
its origin at the centre of mass. The mass is constant: a flight uses some ten grams.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from Basilisk.architecture import messaging, sysModel
from Basilisk.simulation import (
    GravityGradientEffector,
    facetSRPDynamicEffector,
    reactionWheelStateEffector,
    spacecraft,
    sphericalHarmonicsGravityModel,
    thrusterDynamicEffector,
)
from Basilisk.utilities import macros, simIncludeGravBody, simIncludeRW, simIncludeThruster
from scipy.spatial.transform import Rotation

from formulations.arrays import Array
from scp_recon.mission.mission import Mission
from scp_recon.physics.forces import SPEED_OF_LIGHT_M_S
from scp_recon.physics.harmonics import HarmonicField
from scp_recon.simulation.estimator import cross_matrix
from scp_recon.simulation.vehicle import Vehicle

STEP_S = 0.1
"""Step of the Runge-Kutta integration: the shortest pulse of a micro-thruster."""

SURROUNDINGS_S = 10.0
"""Interval, s, at which the asteroid's attitude is renewed; Basilisk extrapolates it to 8e-6 rad in
between."""

BASILISK_PRESSURE = 1368.0 / SPEED_OF_LIGHT_M_S
"""Pressure of sunlight at 1 au that facetSRPDynamicEffector has built in, N/m^2."""


class Surroundings(sysModel.SysModel):
    """Attitude of the asteroid, position of the Sun, and the asteroid's shadow as messages.

    The shadow is a cylinder of the reference radius.
    """

    def __init__(self, mission: Mission) -> None:
        super().__init__()
        self.mission = mission
        self.asteroid = messaging.SpicePlanetStateMsg()
        self.sun = messaging.SpicePlanetStateMsg()
        self.shadow = messaging.EclipseMsg()
        self.states = messaging.SCStatesMsgReader()

    def Reset(self, now: int) -> None:  # noqa: N802, D102 -- as Basilisk names it
        self.UpdateState(now)

    def UpdateState(self, now: int) -> None:  # noqa: N802, D102 -- as Basilisk names it
        time = now * macros.NANO2SEC
        rotation = self.mission.rotation
        to_body = rotation.body_to_j2000(time).T
        rate = rotation.rate + rotation.acceleration * time
        asteroid = messaging.SpicePlanetStateMsgPayload()
        asteroid.J20002Pfix = to_body.tolist()
        asteroid.J20002Pfix_dot = (
            -rate * cross_matrix(np.array([0.0, 0.0, 1.0])) @ to_body
        ).tolist()
        self.asteroid.write(asteroid, now)
        direction = self.mission.sun_direction(time)
        distance = np.linalg.norm(self.mission.scenario.sun.body_position_km) * 1e3
        sun = messaging.SpicePlanetStateMsgPayload()
        sun.PositionVector = (distance * direction).tolist()
        self.sun.write(sun, now)
        position = np.array(self.states().r_BN_N)
        along = float(position @ direction)
        across = np.linalg.norm(position - along * direction)
        dark = along < 0.0 and across < self.mission.scenario.body.reference_radius_m
        self.shadow.write(messaging.EclipseMsgPayload(illuminationFactor=float(not dark)), now)


@dataclass(frozen=True)
class Plant:
    """Physics of the simulation: asteroid and Sun, and the rigid body with its effectors attached.

    Effectors are in the order in which they must be updated before the hub. The thrusters' settings
    are kept so that their thrust can be changed; the flight software reads the configurations of
    wheels and micro-thrusters.
    """

    surroundings: Surroundings
    hub: spacecraft.Spacecraft
    wheels: reactionWheelStateEffector.ReactionWheelStateEffector
    micro: thrusterDynamicEffector.ThrusterDynamicEffector
    chemical: thrusterDynamicEffector.ThrusterDynamicEffector
    micro_thrusters: tuple[thrusterDynamicEffector.THRSimConfig, ...]
    chemical_thruster: thrusterDynamicEffector.THRSimConfig
    effectors: tuple[sysModel.SysModel, ...]
    wheel_config: messaging.RWArrayConfigMsg
    micro_config: messaging.THRArrayConfigMsg


@dataclass(frozen=True)
class Start:
    """Initial condition: state (6,), J2000, m and m/s; attitude from the body to J2000.

    The rate is in the body frame, rad/s, shape (3,); the wheels' speeds, rad/s, have shape (wheels,).
    """

    state: Array
    attitude: Rotation
    rate_rad_s: Array
    wheel_speeds_rad_s: Array


def build_plant(
    mission: Mission,
    vehicle: Vehicle,
    start: Start,
    *,
    field: HarmonicField | None,
    light: bool = True,
    gravity_gradient: bool = True,
) -> Plant:
    """Assemble a spacecraft; without a field, in the asteroid's frame, gravity is a point mass's."""
    surroundings = Surroundings(mission)
    hub = _hub(vehicle, start)
    surroundings.states.subscribeTo(hub.scStateOutMsg)
    asteroid = _attach_gravity(hub, mission, field)
    asteroid.planetBodyInMsg.subscribeTo(surroundings.asteroid)
    wheels, wheel_config = _attach_wheels(hub, vehicle, start.wheel_speeds_rad_s)
    micro, micro_thrusters, micro_config = _attach_micro_thrusters(hub, vehicle)
    chemical, chemical_thruster = _attach_chemical_thruster(hub, vehicle)
    effectors = [surroundings, micro, chemical, wheels]
    if light:
        effectors.append(_attach_light(hub, surroundings, vehicle))
    if gravity_gradient:
        gradient = GravityGradientEffector.GravityGradientEffector()
        gradient.addPlanetName(asteroid.planetName)
        hub.addDynamicEffector(gradient)
        effectors.append(gradient)
    return Plant(
        surroundings=surroundings,
        hub=hub,
        wheels=wheels,
        micro=micro,
        chemical=chemical,
        micro_thrusters=micro_thrusters,
        chemical_thruster=chemical_thruster,
        effectors=tuple(effectors),
        wheel_config=wheel_config,
        micro_config=micro_config,
    )


def _hub(vehicle: Vehicle, start: Start) -> spacecraft.Spacecraft:
    """The rigid body alone."""
    hub = spacecraft.Spacecraft()
    hub.ModelTag = vehicle.name
    hub.hub.mHub = vehicle.mass.mass_kg
    hub.hub.IHubPntBc_B = vehicle.inertia.tolist()
    hub.hub.r_CN_NInit = start.state[:3].tolist()
    hub.hub.v_CN_NInit = start.state[3:].tolist()
    hub.hub.sigma_BNInit = start.attitude.as_mrp().tolist()
    hub.hub.omega_BN_BInit = start.rate_rad_s.tolist()
    return hub


def _attach_gravity(
    hub: spacecraft.Spacecraft, mission: Mission, field: HarmonicField | None
) -> simIncludeGravBody.gravityEffector.GravBodyData:
    body = mission.scenario.body
    factory = simIncludeGravBody.gravBodyFactory()
    asteroid = factory.createCustomGravObject(body.name, mu=body.gm_m3_s2)
    asteroid.isCentralBody = True
    asteroid.radEquator = body.reference_radius_m
    if field is not None:
        asteroid.radEquator = field.radius
        asteroid.gravityModel = harmonic_gravity(field)
    factory.addBodiesTo(hub)
    return asteroid


def harmonic_gravity(
    field: HarmonicField,
) -> sphericalHarmonicsGravityModel.SphericalHarmonicsGravityModel:
    """Basilisk's model of a gravity field; its coefficients are fully normalised."""
    model = sphericalHarmonicsGravityModel.SphericalHarmonicsGravityModel()
    model.maxDeg = len(field.c) - 1
    model.muBody, model.radEquator = field.gm, field.radius
    c_bar, s_bar = field.normalised()
    model.cBar = [row[: n + 1].tolist() for n, row in enumerate(c_bar)]
    model.sBar = [row[: n + 1].tolist() for n, row in enumerate(s_bar)]
    return model


def _attach_wheels(
    hub: spacecraft.Spacecraft, vehicle: Vehicle, speeds: Array
) -> tuple[reactionWheelStateEffector.ReactionWheelStateEffector, messaging.RWArrayConfigMsg]:
    """Attach balanced wheels, whose mass and transverse inertia are counted with the hub."""
    wheels, factory = vehicle.wheels, simIncludeRW.rwFactory()
    for axis, speed in zip(wheels.axes, speeds.tolist(), strict=True):
        factory.create(
            "custom",
            list(axis),
            Js=wheels.inertia_kg_m2,
            Omega=speed / macros.RPM,
            Omega_max=wheels.speed_max_rad_s / macros.RPM,
            u_max=wheels.torque_max_n_m,
            RWModel=messaging.BalancedWheels,
        )
    effector = reactionWheelStateEffector.ReactionWheelStateEffector()
    factory.addToSpacecraft("wheels", effector, hub)
    return effector, factory.getConfigMessage()


def _attach_micro_thrusters(
    hub: spacecraft.Spacecraft, vehicle: Vehicle
) -> tuple[
    thrusterDynamicEffector.ThrusterDynamicEffector,
    tuple[thrusterDynamicEffector.THRSimConfig, ...],
    messaging.THRArrayConfigMsg,
]:
    micro, factory = vehicle.micro_thrusters, simIncludeThruster.thrusterFactory()
    thrusters = tuple(
        factory.create(
            "Blank_Thruster",
            list(offset),
            list(direction),
            MaxThrust=micro.thrust_n,
            steadyIsp=micro.specific_impulse_s,
        )
        for offset, direction in zip(micro.offsets_m, micro.directions, strict=True)
    )
    effector = thrusterDynamicEffector.ThrusterDynamicEffector()
    factory.addToSpacecraft("micro-thrusters", effector, hub)
    return effector, thrusters, factory.getConfigMessage()


def _attach_chemical_thruster(
    hub: spacecraft.Spacecraft, vehicle: Vehicle
) -> tuple[thrusterDynamicEffector.ThrusterDynamicEffector, thrusterDynamicEffector.THRSimConfig]:
    chemical, factory = vehicle.chemical_thruster, simIncludeThruster.thrusterFactory()
    thruster = factory.create(
        "Blank_Thruster",
        (np.array(chemical.position_m) - vehicle.centre_of_mass_m).tolist(),
        list(chemical.direction),
        MaxThrust=chemical.thrust_n,
        steadyIsp=chemical.specific_impulse_s,
    )
    effector = thrusterDynamicEffector.ThrusterDynamicEffector()
    factory.addToSpacecraft("chemical thruster", effector, hub)
    return effector, thruster


def _attach_light(
    hub: spacecraft.Spacecraft, surroundings: Surroundings, vehicle: Vehicle
) -> facetSRPDynamicEffector.FacetSRPDynamicEffector:
    """Attach the plates, with areas scaled from Basilisk's solar constant to the scenario's."""
    constant = surroundings.mission.scenario.sun.solar_constant_w_m2 / SPEED_OF_LIGHT_M_S
    light = facetSRPDynamicEffector.FacetSRPDynamicEffector()
    light.setNumFacets(len(vehicle.plates))
    for plate in vehicle.plates:
        light.addFacet(
            plate.area_m2 * constant / BASILISK_PRESSURE,
            np.eye(3).tolist(),
            list(plate.normal),
            [1.0, 0.0, 0.0],
            (np.array(plate.centre_m) - vehicle.centre_of_mass_m).tolist(),
            plate.diffuse,
            plate.specular,
        )
    light.sunInMsg.subscribeTo(surroundings.sun)
    light.sunEclipseInMsg.subscribeTo(surroundings.shadow)
    hub.addDynamicEffector(light)
    return light
