"""The tables of a scenario, each frozen and validated, with units in the key names."""

from __future__ import annotations

import itertools
from datetime import datetime
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from scp_recon.scenario.fields import (
    Angle,
    ConeAngle,
    FlightTime,
    Name,
    NonNegative,
    NonZeroVector,
    Positive,
    Section,
    Share,
    Vector,
    Velocity,
)


class Epoch(Section):
    """Time zero of the flight."""

    tdb: datetime

    @field_validator("tdb")
    @classmethod
    def _no_offset(cls, tdb: datetime) -> datetime:
        if tdb.tzinfo is not None:
            raise ValueError("must have no time zone, it is TDB")
        return tdb


class Body(Section):
    """The asteroid: gravity and IAU rotation."""

    name: Name
    gm_m3_s2: Annotated[float, Field(ge=1e-6, le=1e20)]
    j2: Annotated[float, Field(ge=-1, le=1)]
    reference_radius_m: Positive
    pole_ra_deg: Angle
    pole_dec_deg: Annotated[float, Field(ge=-90, le=90)]
    prime_meridian_deg: Angle
    prime_meridian_rate_deg_day: Angle
    prime_meridian_acceleration_deg_day2: Angle


class Sun(Section):
    """Heliocentric state of the body at the epoch, J2000, and the solar constant at 1 au."""

    body_position_km: NonZeroVector
    body_velocity_km_s: Velocity
    solar_constant_w_m2: Positive


class SiteSection(Section):
    """What is observed; body-fixed."""

    name: Name
    position_body_m: Vector
    normal_body: NonZeroVector


class Spacecraft(Section):
    """Cannonball for solar radiation pressure."""

    mass_kg: Positive
    srp_area_m2: NonNegative
    reflectivity_coefficient: NonNegative


class Boundary(Section):
    """Mean states before the first and after the last burn, body-centred."""

    frame: Literal["sun_north", "j2000"]
    initial_position_m: NonZeroVector
    initial_velocity_m_s: Velocity
    final_position_m: NonZeroVector
    final_velocity_m_s: Velocity


class Burns(Section):
    """Firing times, the first at zero and the last at the end of the flight."""

    times_s: Annotated[tuple[FlightTime, ...], Field(min_length=2, max_length=64)]
    dv_max_m_s: Annotated[float, Field(ge=1e-9, le=1e6)]

    @field_validator("times_s")
    @classmethod
    def _ascending_from_zero(cls, times: tuple[float, ...]) -> tuple[float, ...]:
        if times[0] != 0.0 or any(b <= a for a, b in itertools.pairwise(times)):
            raise ValueError("must start at 0 and be strictly ascending")
        return times


class Observation(Section):
    """Limits on the observation geometry; those without a bound are left out."""

    site_distance_min_m: Positive
    site_distance_max_m: Positive
    emission_min_deg: ConeAngle
    emission_max_deg: ConeAngle
    phase_min_deg: ConeAngle
    phase_max_deg: ConeAngle | None = None
    incidence_max_deg: Annotated[float, Field(gt=0, le=180)]
    local_solar_time_min_h: Annotated[float, Field(ge=0, le=24)]
    local_solar_time_max_h: Annotated[float, Field(ge=0, le=24)]
    window_s: tuple[float, float] | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in ("site_distance", "emission", "phase", "local_solar_time"):
            low, high = (
                next(v for k, v in self if k.startswith(f"{name}_{end}")) for end in ("min", "max")
            )
            if high is not None and low >= high:
                raise ValueError(f"{name}: the minimum {low} must be below the maximum {high}")
        return self


class Safety(Section):
    """Distance from the body's centre throughout the flight."""

    radius_min_m: Positive


class Battery(Section):
    """Half-angles about the Sun line: of burns (both ways) and, from the site, while observing."""

    delta_v_cone_deg: ConeAngle
    observation_cone_deg: ConeAngle


class ScheduleRules(Section):
    """Worst-case durations: slew to steady state, thruster heating, recharge from empty."""

    attitude_s: FlightTime
    heating_s: FlightTime
    recharge_s: FlightTime


class Uncertainty(Section):
    """Initial 1-sigma as a fraction of each J2000 component, and of each burn component."""

    initial_sigma_fraction: Share
    execution_error: Share


class Risk(Section):
    """What probability is asked of what, and how it is spent.

    With the scope `node` every joint constraint at every node has to hold with `p_chance`; with
    `flight` all of them together, throughout the flight. `uniform` splits a risk evenly over polytopes'
    facets by Boole's inequality; `exact` spends the probability of the sets themselves.
    """

    p_chance: Annotated[float, Field(gt=0.5, le=1 - 1e-9)]
    allocation: Literal["uniform", "exact"] = "uniform"
    scope: Literal["node", "flight"] = "node"

    @model_validator(mode="after")
    def _flights_are_exact(self) -> Self:
        if self.scope == "flight" and self.allocation != "exact":
            raise ValueError('scope = "flight" must have allocation = "exact"')
        return self


class PolytopeSection(Section):
    """What stands for balls and cones in P2."""

    ball: Literal["paper", "tangent"] | Annotated[int, Field(ge=4, le=512)]
    cone: Literal["paper"] | Annotated[int, Field(ge=3, le=512)]


class Grid(Section):
    """Longest spacing of the nodes; burns and window edges are nodes besides, and so are `nodes_s`."""

    step_max_s: Annotated[float, Field(ge=1, le=1e7)]
    nodes_s: Annotated[tuple[FlightTime, ...], Field(max_length=1000)] = ()
