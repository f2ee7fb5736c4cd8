"""What the checks of a mission work on, and how they put what they find."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from scp_recon.errors import InputError
from scp_recon.physics import geometry
from scp_recon.physics.frames import Rotation
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.warning import ScenarioWarning

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Given:
    """What a scenario says of its body and site, before its window is known.

    Attributes:
        scenario: as given.
        rotation: attitude of the body.
        site: body-fixed.
    """

    scenario: Scenario
    rotation: Rotation
    site: geometry.Site


def between(
    entry: str,
    value: float,
    given: str,
    why: str,
    expected: tuple[float, float],
    allowed: tuple[float, float],
    unit_name: str,
) -> Iterator[ScenarioWarning]:
    """Refuse what is outside one interval, and warn of what is outside a narrower one.

    Args:
        entry: dotted path of the entry.
        value: what the intervals bound.
        given: what was found, in words.
        why: where the intervals come from.
        expected: ends between which nothing is said.
        allowed: ends beyond which it is refused.
        unit_name: of all of these.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    if not allowed[0] <= value <= allowed[1]:
        low, high = allowed
        raise InputError(entry, given, f"must be {low:g} to {high:g} {unit_name} {why}")
    if not expected[0] <= value <= expected[1]:
        low, high = expected
        rule = f"{low:g} to {high:g} {unit_name} would be no surprise {why}"
        yield ScenarioWarning.of(entry, given, rule)


def angle_deg(vector: Array, direction: Array) -> float:
    """From a unit direction to a vector."""
    return float(np.rad2deg(geometry.angle(np.asarray(vector), direction)))


@cache
def packaged_tables(name: str) -> dict[str, Any]:
    """Tables of a packaged scenario, validated."""
    return load_scenario(name).model_dump()
