"""What the entries of a scenario may be: numbers within bounds, directions, names."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field


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
