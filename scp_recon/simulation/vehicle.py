"""Read the simulated vehicle: validated data with units in the key names."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from functools import cached_property
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from formulations.arrays import Array
from scp_recon.display import exact
from scp_recon.errors import InputError
from scp_recon.files import read_text
from scp_recon.physics.frames import unit
from scp_recon.scenario.fields import (
    NonNegative,
    NonZeroVector,
    Positive,
    ScenarioWarning,
    Section,
    Vector,
)
from scp_recon.scenario.schema import Scenario

Share = Annotated[float, Field(ge=0, le=1)]
PositiveShare = Annotated[float, Field(gt=0, le=1)]
SAME_MASS = 0.05
"""Relative tolerance of the vehicle's mass against the plan's, which is constant."""


class MassProperties(Section):
    """Mass and inertia of the whole vehicle, wheels at rest, about principal axes along x, y and z."""

    mass_kg: Positive
    centre_of_mass_m: Vector
    inertia_kg_m2: tuple[Positive, Positive, Positive]

    @model_validator(mode="after")
    def _of_a_body(self) -> Self:
        if 2.0 * max(self.inertia_kg_m2) > sum(self.inertia_kg_m2):
            raise ValueError("no moment of inertia may exceed the sum of the others")
        return self


class Panel(Section):
    """A solar panel."""

    name: str
    area_m2: Positive
    normal: NonZeroVector
    centre_m: Vector


class Face(Panel):
    """A flat plate under solar radiation pressure: a panel's cells, or any other."""

    specular: Share
    diffuse: Share = 0.0


class Panels(Section):
    """All panels, with cells of one kind."""

    efficiency: PositiveShare
    packing: PositiveShare
    specular: Share
    panel: Annotated[tuple[Panel, ...], Field(min_length=1, max_length=16)]
    """More would have too many subsets for `SolarArray`."""


class BatterySection(Section):
    """Equal batteries, charged from the last to the first and discharged from the first."""

    count: Annotated[int, Field(ge=1, le=16)]
    capacity_wh: Positive
    efficiency: PositiveShare
    initial_charge: Share
    floor_charge: Share


class Loads(Section):
    """Powers that modes and devices draw, distribution losses included."""

    quiescent_w: NonNegative
    attitude_control_w: NonNegative
    payload_w: NonNegative
    heater_w: NonNegative
    firing_w: NonNegative
    housekeeping_w: NonNegative


class Wheels(Section):
    """Equal reaction wheels.

    Momentum is dumped from `dump_start` of the largest speed on, until all wheels together hold less
    than `dump_end` of one wheel's largest momentum.

    `power_w` holds speeds in rad/s, ascending, and the power drawn at each.
    """

    axes: Annotated[tuple[NonZeroVector, ...], Field(min_length=3, max_length=16)]
    centre_m: Vector
    inertia_kg_m2: Positive
    speed_max_rad_s: Positive
    torque_max_n_m: Positive
    dump_start: PositiveShare
    dump_end: Share
    power_w: Annotated[tuple[tuple[NonNegative, NonNegative], ...], Field(min_length=2)]

    @model_validator(mode="after")
    def _usable(self) -> Self:
        if np.linalg.matrix_rank(unit(self.axes), tol=1e-3) < 3:
            raise ValueError("axes must span space")
        speeds = [speed for speed, _ in self.power_w]
        if any(a >= b for a, b in pairwise(speeds)):
            raise ValueError("power_w must have ascending speeds")
        return self


class MicroThrusters(Section):
    """Equal thrusters, offsets from the centre of mass and directions of the force."""

    offsets_m: Annotated[tuple[Vector, ...], Field(min_length=4, max_length=32)]
    directions: Annotated[tuple[NonZeroVector, ...], Field(min_length=4, max_length=32)]
    thrust_n: Positive
    specific_impulse_s: Positive
    pulse_min_s: Positive

    @model_validator(mode="after")
    def _as_many(self) -> Self:
        if len(self.offsets_m) != len(self.directions):
            raise ValueError("offsets_m and directions must be as many")
        return self


class ChemicalThruster(Section):
    """The fixed thruster of the burns; `direction` is that of the force."""

    position_m: Vector
    direction: NonZeroVector
    thrust_n: Positive
    specific_impulse_s: Positive
    heating_s: NonNegative


class Sensors(Section):
    """Boresights and fields of view of the sensors."""

    camera: NonZeroVector
    star_tracker: NonZeroVector
    star_tracker_sun_exclusion_deg: Annotated[float, Field(ge=0, le=180)]
    sun_sensors: Annotated[tuple[NonZeroVector, ...], Field(min_length=1)]
    sun_sensor_half_angle_deg: Annotated[float, Field(gt=0, le=90)]


class Errors(Section):
    """1-sigma of every source of uncertainty."""

    sun_sensor_rad: NonNegative
    star_tracker_arcsec: NonNegative
    imu_rad_s: NonNegative
    micro_thruster_n: NonNegative
    chemical_thruster: NonNegative
    initial_state: NonNegative


class Vehicle(Section):
    """A spacecraft. Vectors are in the structure frame, whose axes are the body's."""

    name: Annotated[str, Field(min_length=1)]
    mass: MassProperties
    faces: tuple[Face, ...]
    panels: Panels
    battery: BatterySection
    loads: Loads
    wheels: Wheels
    micro_thrusters: MicroThrusters
    chemical_thruster: ChemicalThruster
    sensors: Sensors
    errors: Errors

    @cached_property
    def centre_of_mass_m(self) -> Array:
        """Centre of mass in the structure frame, m, shape (3,)."""
        return np.array(self.mass.centre_of_mass_m)

    @cached_property
    def inertia(self) -> Array:
        """Inertia about the centre of mass, kg m^2, shape (3, 3)."""
        return np.diag(self.mass.inertia_kg_m2)

    @cached_property
    def plates(self) -> tuple[Face, ...]:
        """Every plate that sunlight falls on: the faces, and the panels' cells."""
        cells = (
            Face(specular=self.panels.specular, **panel.model_dump()) for panel in self.panels.panel
        )
        return (*self.faces, *cells)


def load_vehicle(path: Path | None = None) -> Vehicle:
    """Read a vehicle file (the packaged DARE without one).

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    if path is None:
        text = (files("scp_recon.simulation") / "data" / "dare.toml").read_text(encoding="utf-8")
    else:
        text = read_text(path, f"vehicle {path}", "vehicle file")
    try:
        return Vehicle.model_validate(tomllib.loads(text), strict=False)
    except tomllib.TOMLDecodeError as error:
        raise InputError(
            f"vehicle {path}", f"no TOML ({error})", "must be a vehicle file"
        ) from None
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        entry = ".".join(str(part) for part in first["loc"])
        raise InputError(f"vehicle: {entry}", repr(first["input"])[:80], first["msg"]) from None


def check_vehicle(vehicle: Vehicle, scenario: Scenario) -> Iterator[ScenarioWarning]:
    """Warn of a vehicle in `simulate` whose mass is 5 % or more off `spacecraft.mass_kg`."""
    planned, flown = scenario.spacecraft.mass_kg, vehicle.mass.mass_kg
    if abs(flown - planned) > SAME_MASS * planned:
        yield ScenarioWarning.of(
            "spacecraft.mass_kg",
            f"{exact(planned)} kg",
            f"{vehicle.name}, the vehicle that is flown, has {flown:g} kg: give your own by --vehicle",
        )
