"""Build the simulated spacecraft and its surroundings from Basilisk's modules.

The inertial frame is J2000 about the asteroid, which rests; the body frame has the vehicle's axes and
its origin at the centre of mass. The mass is constant: a flight uses some ten grams.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

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
from scp_recon.simulation.vehicle import ChemicalThruster, MicroThrusters, Vehicle

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
class Start:
    """Initial condition: state (6,), J2000, m and m/s; attitude from the body to J2000.

    The rate is in the body frame, rad/s, shape (3,); the wheels' speeds, rad/s, have shape (wheels,).
    """

    state: Array
    attitude: Rotation
    rate_rad_s: Array
    wheel_speeds_rad_s: Array


def module(model: Any, inputs: Mapping[str, Any], **settings: Any) -> Any:
    """Give one of Basilisk's modules its settings and the messages that it reads, and return it."""
    for name, value in settings.items():
        setattr(model, name, value)
    for name, message in inputs.items():
        getattr(model, name).subscribeTo(message)
    return model


class Plant:
    """Physics of the simulation: asteroid and Sun, and the rigid body with its effectors attached.

    `effectors` are in the order in which they must be updated before the hub. The thrusters' settings
    are kept so that their thrust can be changed; the flight software reads the configurations of
    wheels and micro-thrusters. Without a field, in the asteroid's frame, gravity is a point mass's.
    """

    def __init__(
        self,
        mission: Mission,
        vehicle: Vehicle,
        start: Start,
        *,
        field: HarmonicField | None,
        light: bool = True,
        gravity_gradient: bool = True,
    ) -> None:
        self.vehicle, self.surroundings = vehicle, Surroundings(mission)
        self.hub = spacecraft.Spacecraft()
        module(
            self.hub.hub,
            {},
            mHub=vehicle.mass.mass_kg,
            IHubPntBc_B=vehicle.inertia.tolist(),
            r_CN_NInit=start.state[:3].tolist(),
            v_CN_NInit=start.state[3:].tolist(),
            sigma_BNInit=start.attitude.as_mrp().tolist(),
            omega_BN_BInit=start.rate_rad_s.tolist(),
        )
        self.surroundings.states.subscribeTo(self.hub.scStateOutMsg)
        self._attach_gravity(mission, field)
        self.wheels, self.wheel_config = self._wheels(start.wheel_speeds_rad_s)
        micro, chemical = vehicle.micro_thrusters, vehicle.chemical_thruster
        self.micro, self.micro_thrusters, self.micro_config = self._thrusters(
            micro, micro.offsets_m, micro.directions
        )
        self.chemical, (self.chemical_thruster,), _ = self._thrusters(
            chemical, [self._arm(chemical.position_m)], [chemical.direction]
        )
        self.effectors = [self.surroundings, self.micro, self.chemical, self.wheels]
        if light:
            self.effectors.append(self._light(mission.scenario.sun.solar_constant_w_m2))
        if gravity_gradient:
            self.effectors.append(GravityGradientEffector.GravityGradientEffector())
            self.effectors[-1].addPlanetName(mission.scenario.body.name)
        for effector in self.effectors[4:]:
            self.hub.addDynamicEffector(effector)

    def _attach_gravity(self, mission: Mission, field: HarmonicField | None) -> None:
        body, factory = mission.scenario.body, simIncludeGravBody.gravBodyFactory()
        asteroid = factory.createCustomGravObject(body.name, mu=body.gm_m3_s2)
        asteroid.isCentralBody = True
        asteroid.radEquator = body.reference_radius_m if field is None else field.radius
        if field is not None:  # Basilisk's coefficients are fully normalised
            model = sphericalHarmonicsGravityModel.SphericalHarmonicsGravityModel()
            model.maxDeg, model.muBody, model.radEquator = len(field.c) - 1, field.gm, field.radius
            model.cBar, model.sBar = (
                [row[: n + 1].tolist() for n, row in enumerate(each)] for each in field.normalised()
            )
            asteroid.gravityModel = model
        factory.addBodiesTo(self.hub)
        asteroid.planetBodyInMsg.subscribeTo(self.surroundings.asteroid)

    def _wheels(self, speeds: Array) -> tuple[Any, messaging.RWArrayConfigMsg]:
        """Attach balanced wheels, whose mass and transverse inertia are counted with the hub."""
        wheels, factory = self.vehicle.wheels, simIncludeRW.rwFactory()
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
        factory.addToSpacecraft("wheels", effector, self.hub)
        return effector, factory.getConfigMessage()

    def _thrusters(
        self,
        kind: MicroThrusters | ChemicalThruster,
        offsets_m: Iterable[Sequence[float]],
        directions: Iterable[Sequence[float]],
    ) -> tuple[Any, list[Any], messaging.THRArrayConfigMsg]:
        """Attach thrusters of a kind: effector, the settings of each, and what software reads."""
        factory = simIncludeThruster.thrusterFactory()
        settings = {"MaxThrust": kind.thrust_n, "steadyIsp": kind.specific_impulse_s}
        each = [
            factory.create("Blank_Thruster", list(offset), list(direction), **settings)
            for offset, direction in zip(offsets_m, directions, strict=True)
        ]
        effector = thrusterDynamicEffector.ThrusterDynamicEffector()
        factory.addToSpacecraft(type(kind).__name__, effector, self.hub)
        return effector, each, factory.getConfigMessage()

    def _light(self, solar_constant_w_m2: float) -> facetSRPDynamicEffector.FacetSRPDynamicEffector:
        """Light on the plates, with areas scaled from Basilisk's solar constant to the scenario's."""
        light = module(
            facetSRPDynamicEffector.FacetSRPDynamicEffector(),
            {"sunInMsg": self.surroundings.sun, "sunEclipseInMsg": self.surroundings.shadow},
        )
        light.setNumFacets(len(self.vehicle.plates))
        for plate in self.vehicle.plates:
            light.addFacet(
                plate.area_m2 * solar_constant_w_m2 / SPEED_OF_LIGHT_M_S / BASILISK_PRESSURE,
                np.eye(3).tolist(),
                list(plate.normal),
                [1.0, 0.0, 0.0],
                self._arm(plate.centre_m),
                plate.diffuse,
                plate.specular,
            )
        return light

    def _arm(self, place_m: Sequence[float]) -> list[float]:
        """A place in the structure frame from the centre of mass, m."""
        arm: list[float] = (np.array(place_m) - self.vehicle.centre_of_mass_m).tolist()
        return arm
