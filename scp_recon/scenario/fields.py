"""Define the kinds of entries (bounded numbers, directions, names), and warnings about entries."""

from __future__ import annotations

import math
from collections.abc import Iterator
from datetime import datetime
from inspect import isclass
from typing import Annotated, Any, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
)

from scp_recon.errors import Named, Value, printable


def _long_enough(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if math.hypot(*vector) < SHORTEST:
        raise ValueError(f"must not be zero or shorter than {SHORTEST:g}")
    return vector


SHORTEST = 1e-3
"""Least length of a vector with a direction: shorter ones are slips, and their squares may vanish."""


SLIPS: dict[str, tuple[tuple[float, str], ...]] = {
    "": ((0.01, "; a share, not per cent?"),),
    "m": ((1e3, "; metres, not kilometres?"), (1e-3, "; metres, not millimetres?")),
    "km": ((1e-3, "; kilometres, not metres?"),),
    "m/s": ((1e-3, "; m/s, not mm/s?"), (1e3, "; m/s, not km/s?")),
    "deg": ((math.degrees(1.0), "; degrees?"),),
    "s": ((60.0, "; seconds, not minutes?"), (3600.0, "; seconds, not hours?")),
    "h": ((1.0 / 60.0, "; hours, not minutes?"), (1.0 / 3600.0, "; hours, not seconds?")),
    "m^3/s^2": ((1e9, "; m^3/s^2, not km^3/s^2?"),),
    "kg/m^3": ((1e-9, "; the radius in metres?"), (1e9, "; GM in m^3/s^2?")),
    "m^2/kg": ((1e3, "; kilograms, not grams?"), (1e-4, "; m^2, not cm^2?")),
}
"""Likely slips of a unit: what a value has to be multiplied by, and the question."""
SUFFIXES = {"m3_s2": "m^3/s^2", "m_s": "m/s"} | {
    unit: unit for unit in ("km", "m", "deg", "s", "h")
}
"""Units by the end of an entry's name."""


def unit_of(entry: str) -> str:
    """The unit by an entry's name; empty for a share, and where it has another."""
    name = entry.removesuffix("_min").removesuffix("_max")
    return next((unit for end, unit in SUFFIXES.items() if name.endswith(f"_{end}")), "")


def unit_hint(unit: str, value: float, low: float, high: float) -> str:
    """Question whether another unit was meant; empty if that does not explain a value out of a range.

    In the other unit it must be within the range; of a range with one end also nearer to that end.

    Args:
        unit: that the value should have.
        value: that was given.
        low: end of the range, -inf for none.
        high: likewise.
    """
    if low <= value <= high:
        return ""
    end, bounded = (low if value < low else high), unit == "" or 0.0 < low < high < math.inf
    for factor, hint in SLIPS.get(unit, ()):
        meant = factor * value
        nearer = end * value > 0.0 and abs(math.log(meant / end)) < abs(math.log(value / end))
        if low <= meant <= high and (bounded or nearer):
            return hint
    return ""


def zero_or_at_least(least: float) -> AfterValidator:
    """Validate a number that is not negative: zero, or at least as large as this."""

    def check(value: float) -> float:
        if 0.0 < value < least:
            raise ValueError(f"must be 0 or at least {least:g}")
        return value

    return AfterValidator(check)


LEAST_SHARE = 1e-9
"""Least relative error but zero; the squares of smaller ones are lost in rounding, or vanish."""


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("must be printable characters on one line")
    return text


Line = Annotated[str, AfterValidator(_printable)]
"""Text that may go to a terminal: no line breaks, no control sequences."""
Name = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_printable)]
ByName = Annotated[dict[Line, Value], AfterValidator(Named)]
"""Results by name, which say what there is where a name is misspelt."""
Positive = Annotated[float, Field(ge=1e-9, le=1e12)]
"""In any unit: beyond these bounds nothing is physical, and squares and quotients overflow."""
NonNegative = Annotated[float, Field(ge=0, le=1e12)]
Number = Annotated[float, Field(ge=-1e30, le=1e30)]
"""A number to compute with: small enough that its square and quotients stay finite."""
Component = Annotated[float, Field(ge=-1e12, le=1e12)]
Vector = tuple[Component, Component, Component]
NonZeroVector = Annotated[Vector, AfterValidator(_long_enough)]
Speed = Annotated[float, Field(ge=-1e6, le=1e6)]
Velocity = tuple[Speed, Speed, Speed]
Angle = Annotated[float, Field(ge=-1e9, le=1e9)]
FlightTime = Annotated[float, Field(ge=0, le=1e7)]


def _no_offset(tdb: datetime) -> datetime:
    if tdb.tzinfo is not None:
        raise ValueError("must have no time zone, it is TDB")
    if not 1000 <= tdb.year <= 9000:
        raise ValueError("must be in the years 1000 to 9000")
    return tdb


Tdb = Annotated[datetime, AfterValidator(_no_offset)]
Share = Annotated[float, Field(ge=0, lt=1), zero_or_at_least(LEAST_SHARE)]
Probability = Annotated[float, Field(ge=0, le=1)]
ConeAngle = Annotated[float, Field(gt=0, lt=90)]


class Section(BaseModel):
    """A table of a scenario or of a file: frozen, strict, nothing unknown, nothing infinite."""

    model_config = ConfigDict(
        frozen=True, strict=True, extra="forbid", allow_inf_nan=False, ser_json_inf_nan="null"
    )

    def __dir__(self) -> list[str]:
        """Names of the class's own, without pydantic's methods."""
        return [name for name in super().__dir__() if name not in dir(BaseModel)]


class Sparse(Section):
    """A table that is written, and hashed, without the entries that are not given."""

    @model_serializer(mode="wrap")
    def _what_is_given(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in handler(self).items() if value is not None}


def walk(table: type[BaseModel], above: str = "") -> Iterator[tuple[str, type[BaseModel] | None]]:
    """Paths of a table's entries, and of those in its tables; with its type where one is a table."""
    for key, field in table.model_fields.items():
        kinds = field.annotation, *get_args(field.annotation)
        inside = next((k for k in kinds if isclass(k) and issubclass(k, BaseModel)), None)
        yield f"{above}{key}", inside
        if inside is not None:
            yield from walk(inside, f"{above}{key}.")


class ScenarioWarning(Section):
    """An entry whose value is allowed but unlikely to be intended."""

    entry: Line
    """Dotted path of the entry."""
    given: Line
    """The value found, in words."""
    expected: Line
    """Value that would give no warning, and why."""

    @classmethod
    def of(cls, entry: str, given: str, expected: str) -> ScenarioWarning:
        """Make a warning; control characters in the texts, which a user may have typed, are escaped."""
        given, expected = (printable(text.replace("\n", " ")) for text in (given, expected))
        return cls(entry=entry, given=given, expected=expected)

    def __str__(self) -> str:
        """One line."""
        return f"{self.entry}: got {self.given}; {self.expected}"
