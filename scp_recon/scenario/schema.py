"""What a scenario is: validated data, with units in the key names."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from scp_recon.errors import InputError
from scp_recon.scenario.messages import input_error


def _long_enough(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if math.hypot(*vector) < SHORTEST:
        raise ValueError(f"must not be zero or shorter than {SHORTEST:g}")
    return vector


SHORTEST = 1e-3
"""Of what has a direction: shorter vectors are slips, and their squares may vanish."""


def _none_or_some(share: float) -> float:
    if 0.0 < share < LEAST_SHARE:
        raise ValueError(f"must be 0 or at least {LEAST_SHARE:g}")
    return share


LEAST_SHARE = 1e-9
"""Of a component that errs; the squares of smaller ones are lost in rounding, or vanish."""


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("must be printable characters on one line")
    return text


Line = Annotated[str, AfterValidator(_printable)]
"""What may go to a terminal: no line breaks, no control sequences."""
Name = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_printable)]
Positive = Annotated[float, Field(ge=1e-9, le=1e12)]
"""Whatever its unit: beyond these bounds nothing is physical, and squares and quotients overflow."""
NonNegative = Annotated[float, Field(ge=0, le=1e12)]
Component = Annotated[float, Field(ge=-1e12, le=1e12)]
Vector = tuple[Component, Component, Component]
NonZeroVector = Annotated[Vector, AfterValidator(_long_enough)]
Speed = Annotated[float, Field(ge=-1e6, le=1e6)]
Velocity = tuple[Speed, Speed, Speed]
Angle = Annotated[float, Field(ge=-1e9, le=1e9)]
FlightTime = Annotated[float, Field(ge=0, le=1e7)]
Share = Annotated[float, Field(ge=0, lt=1), AfterValidator(_none_or_some)]
ConeAngle = Annotated[float, Field(gt=0, lt=90)]


class Section(BaseModel):
    """A table of the scenario: frozen, strict, nothing unknown, nothing infinite."""

    model_config = ConfigDict(
        frozen=True, strict=True, extra="forbid", allow_inf_nan=False, ser_json_inf_nan="null"
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
    """Probability asked of every joint constraint at every node."""

    p_chance: Annotated[float, Field(gt=0.5, le=1 - 1e-9)]


class PolytopeSection(Section):
    """What stands for balls and cones in P2."""

    ball: Literal["paper", "tangent"] | Annotated[int, Field(ge=4, le=512)]
    cone: Literal["paper"] | Annotated[int, Field(ge=3, le=512)]


class Grid(Section):
    """Longest spacing of the nodes; burns and window edges are nodes besides."""

    step_max_s: Annotated[float, Field(ge=1, le=1e7)]


class Scenario(Section):
    """Everything that defines a planning problem."""

    name: Name
    epoch: Epoch
    body: Body
    sun: Sun
    site: SiteSection
    spacecraft: Spacecraft
    boundary: Boundary
    burns: Burns
    observation: Observation
    safety: Safety
    battery: Battery
    schedule: ScheduleRules
    uncertainty: Uncertainty
    risk: Risk
    polytopes: PolytopeSection
    grid: Grid

    @property
    def duration_s(self) -> float:
        """Time of the last burn."""
        return self.burns.times_s[-1]

    @classmethod
    def validated(cls, data: Mapping[str, Any]) -> Self:
        """A scenario from nested tables.

        Raises:
            InputError: naming the entry, what was given and what is allowed.
        """
        try:
            return cls.model_validate_json(json.dumps(data, default=str))
        except ValidationError as error:
            raise input_error(error, cls) from None
        except (ValueError, RecursionError) as error:  # a number or a nesting beyond all bounds
            raise InputError("scenario", "values that cannot be read", str(error)[:120]) from None

    def replace(self, changes: Mapping[str, Any]) -> Self:
        """The same scenario with other values.

        Args:
            changes: values by entry, `{"risk.p_chance": 0.8}`, or nested as in the file.

        Raises:
            InputError: naming the entry, what was given and what is allowed.
        """
        data: dict[str, Any] = self.model_dump(mode="json")
        for entry, value in changes.items():
            data = merge(data, nested(entry.split("."), value))
        return self.validated(data)


def nested(keys: Sequence[str], value: Any) -> dict[str, Any]:
    """A value in the tables that some keys name, the outermost first."""
    first, *rest = keys
    return {first: nested(rest, value) if rest else value}


def merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Nested tables with some entries changed; tables are merged, everything else replaced."""
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            merged[key] = merge(old, value)
        else:
            merged[key] = value
    return merged
