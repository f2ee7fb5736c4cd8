"""The scenario: validated data, with units in the key names.

A scenario file is TOML. It is either complete, or names a `base` and holds only what differs.
"""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Mapping, Sequence
from datetime import datetime
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic.fields import FieldInfo

from scp_recon.errors import InputError

Vector = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
ConeAngle = Annotated[float, Field(gt=0, lt=90)]
MAX_PROBLEMS_SHOWN = 5


class Section(BaseModel):
    """A table of the scenario: frozen, strict, nothing unknown, nothing infinite."""

    model_config = ConfigDict(
        frozen=True, strict=True, extra="forbid", allow_inf_nan=False, ser_json_inf_nan="null"
    )


class Epoch(Section):
    """Time zero of the flight."""

    tdb: Annotated[datetime, Field(description="ISO 8601, TDB, no offset")]

    @model_validator(mode="after")
    def _no_offset(self) -> Self:
        if self.tdb.tzinfo is not None:
            raise ValueError("must have no time zone, it is TDB")
        return self


class Body(Section):
    """The asteroid: gravity and IAU rotation."""

    name: str
    gm_m3_s2: Positive
    j2: float
    reference_radius_m: Positive
    pole_ra_deg: float
    pole_dec_deg: Annotated[float, Field(ge=-90, le=90)]
    prime_meridian_deg: float
    prime_meridian_rate_deg_day: float
    prime_meridian_acceleration_deg_day2: float


class Sun(Section):
    """Heliocentric state of the body at the epoch, J2000, and the solar constant at 1 au."""

    body_position_km: Vector
    body_velocity_km_s: Vector
    solar_constant_w_m2: Positive

    @model_validator(mode="after")
    def _away_from_sun(self) -> Self:
        if not any(self.body_position_km):
            raise ValueError("body_position_km must not be zero")
        return self


class SiteSection(Section):
    """What is observed; body-fixed."""

    name: str
    position_body_m: Vector
    normal_body: Vector

    @model_validator(mode="after")
    def _has_normal(self) -> Self:
        if not any(self.normal_body):
            raise ValueError("normal_body must not be zero")
        return self


class Spacecraft(Section):
    """Cannonball for solar radiation pressure."""

    mass_kg: Positive
    srp_area_m2: NonNegative
    reflectivity_coefficient: NonNegative


class Boundary(Section):
    """Mean states before the first and after the last burn, body-centred."""

    frame: Literal["sun_north", "j2000"]
    initial_position_m: Vector
    initial_velocity_m_s: Vector
    final_position_m: Vector
    final_velocity_m_s: Vector

    @model_validator(mode="after")
    def _off_centre(self) -> Self:
        if not any(self.initial_position_m) or not any(self.final_position_m):
            raise ValueError("a position must not be at the body's centre")
        return self


class Burns(Section):
    """Firing times, the first at zero and the last at the end of the flight."""

    times_s: Annotated[tuple[NonNegative, ...], Field(min_length=2, max_length=64)]
    dv_max_m_s: Positive

    @model_validator(mode="after")
    def _ascending_from_zero(self) -> Self:
        if self.times_s[0] != 0.0:
            raise ValueError("times_s must start at 0")
        if any(b <= a for a, b in zip(self.times_s, self.times_s[1:], strict=False)):
            raise ValueError("times_s must be strictly ascending")
        return self


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

    attitude_s: NonNegative
    heating_s: NonNegative
    recharge_s: NonNegative


class Uncertainty(Section):
    """Initial 1-sigma as a fraction of each J2000 component, and of each burn component."""

    initial_sigma_fraction: Annotated[float, Field(ge=0, lt=1)]
    execution_error: Annotated[float, Field(ge=0, lt=1)]


class Risk(Section):
    """Probability asked of every joint constraint at every node."""

    p_chance: Annotated[float, Field(gt=0.5, lt=1)]


class PolytopeSection(Section):
    """What stands for balls and cones in P2."""

    ball: Literal["paper", "tangent"] | Annotated[int, Field(ge=4, le=512)]
    cone: Literal["paper"] | Annotated[int, Field(ge=3, le=512)]


class Grid(Section):
    """Longest spacing of the nodes; burns and window edges are nodes besides."""

    step_max_s: Annotated[float, Field(ge=1)]


class Scenario(Section):
    """Everything that defines a planning problem."""

    name: Annotated[str, Field(min_length=1)]
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


def load_scenario(path: Path | None = None, overrides: Sequence[str] = ()) -> Scenario:
    """Read a scenario file (the packaged `recon_b` without one) and apply `path=value` overrides.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    data = _packaged("recon_b") if path is None else _read(path)
    return validate_scenario(data, overrides)


def validate_scenario(data: Mapping[str, Any], overrides: Sequence[str] = ()) -> Scenario:
    """Validate a scenario given as nested tables, after merging its base and the overrides."""
    if not {"base", *Scenario.model_fields} & set(data):
        raise InputError(
            "scenario", "none of its entries", 'must be complete or have base = "recon_b"'
        )
    merged = _with_base(data)
    for override in overrides:
        merged = _merge(merged, _parse_override(override))
    try:
        return Scenario.model_validate_json(json.dumps(merged, default=str))
    except ValidationError as error:
        raise _input_error(error) from None


def base_names() -> list[str]:
    """Names of the scenarios in the package."""
    folder = files("scp_recon") / "data"
    return sorted(
        f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml")
    )


def _packaged(name: str) -> dict[str, Any]:
    return tomllib.loads((files("scp_recon") / "data" / f"{name}.toml").read_text(encoding="utf-8"))


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = error.strerror or "unreadable"
        raise InputError(f"scenario {path}", reason.lower(), "must be a readable file") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(
            f"scenario {path}", f"no TOML ({error})", "must be a scenario file"
        ) from None


def _with_base(data: Mapping[str, Any]) -> dict[str, Any]:
    own = {key: value for key, value in data.items() if key != "base"}
    if "base" not in data:
        return own
    if data["base"] not in base_names():
        raise InputError("base", repr(data["base"]), f"must be one of {', '.join(base_names())}")
    return _merge(_packaged(data["base"]), own)


def _merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        merged[key] = (
            _merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
        )
    return merged


def _parse_override(override: str) -> dict[str, Any]:
    path, separator, text = override.partition("=")
    if not separator or not all(path.split(".")):
        raise InputError("--set", repr(override), "must read section.entry=value")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text  # a bare word is a string: boundary.frame=j2000
    first, *rest = path.strip().split(".")
    for key in reversed(rest):
        value = {key: value}
    return {first: value}


def _input_error(error: ValidationError) -> InputError:
    """One message for everything that is wrong, the first problem giving the entry."""
    allowed: dict[tuple[str, str], list[str]] = {}
    for problem in error.errors(include_url=False):
        entry, given, rule = _describe(dict(problem))
        rules = allowed.setdefault((entry, given), [])
        if rule not in rules:
            rules.append(rule)
    (entry, given), *others = allowed
    more = [f"{e}: got {g}; {', or '.join(allowed[e, g])}" for e, g in others]
    if len(more) >= MAX_PROBLEMS_SHOWN:
        more[MAX_PROBLEMS_SHOWN - 1 :] = [f"... and {len(more) - MAX_PROBLEMS_SHOWN + 1} more"]
    return InputError(entry, given, "\n".join([", or ".join(allowed[entry, given]), *more]))


def _describe(problem: dict[str, Any]) -> tuple[str, str, str]:
    """Entry, what was given and what is allowed, from one of Pydantic's errors."""
    kind = problem["type"]
    location = [part for part in problem["loc"] if not _is_union_branch(part)]
    entry = ".".join(str(part) for part in location) or "scenario"
    if kind == "extra_forbidden":
        return entry, "an unknown entry", _suggestion(location)
    if kind == "missing":
        return entry, "nothing", "this entry is required (or name a base)"
    given = "these values" if isinstance(problem["input"], dict) else repr(problem["input"])[:80]
    bounds = _bounds(location) if kind.startswith(("greater_than", "less_than")) else ""
    message = bounds or problem["msg"].removeprefix("Value error, ")
    message = message.removeprefix("Input should be ").replace("an object", "a table")
    return entry, given, message if "must" in message else f"must be {message}"


def _is_union_branch(part: str | int) -> bool:
    """Pydantic names the branch of a union in the location; the user did not write it."""
    return isinstance(part, str) and ("[" in part or part in ("int", "constrained-int"))


def _field(location: list[str | int]) -> FieldInfo | None:
    """The scenario's field at a location, if it is a plain one."""
    model: Any = Scenario
    field = None
    for part in location:
        field = getattr(model, "model_fields", {}).get(part)
        model = field.annotation if field else None
    return field


def _bounds(location: list[str | int]) -> str:
    """Both ends of a field's range, where one end alone was broken."""
    words = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}
    field = _field(location)
    rules = [
        f"{words[name]} {getattr(rule, name):g}"
        for rule in (field.metadata if field else [])
        for name in words
        if hasattr(rule, name)
    ]
    return " and ".join(rules)


def _suggestion(location: list[str | int]) -> str:
    """The entry that an unknown one may have been meant for, else those beside it."""
    tables = {name: field.annotation for name, field in Scenario.model_fields.items()}
    paths = [
        f"{table}.{key}"
        for table, model in tables.items()
        for key in getattr(model, "model_fields", {})
    ]
    written = ".".join(str(part) for part in location)
    by_key = {path.split(".")[1]: path for path in paths}
    near = difflib.get_close_matches(written, paths, n=1, cutoff=0.7)
    near = near or difflib.get_close_matches(str(location[-1]), by_key, n=1, cutoff=0.6)
    if near:
        return f"did you mean {by_key.get(near[0], near[0])}? (units are part of the key)"
    beside = getattr(tables.get(str(location[0])), "model_fields", None) if location[1:] else tables
    return f"must be one of {', '.join(beside or tables)}"
