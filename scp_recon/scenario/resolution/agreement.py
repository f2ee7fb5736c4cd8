"""Compare given values with computed ones, with one message where the two do not agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from scp_recon.errors import InputError


def fill(table: dict[str, Any], values: Mapping[str, Any]) -> None:
    """Enter values for entries that are not given."""
    for key, value in values.items():
        if table.get(key) is None:
            table[key] = value


def has(table: Mapping[str, Any], *keys: str) -> bool:
    """Whether all of these are given."""
    return all(table.get(key) is not None for key in keys)


def lacks(table: Mapping[str, Any], *keys: str) -> bool:
    """Whether none of these is given."""
    return all(table.get(key) is None for key in keys)


def check(entry: str, given: object, near: bool, computed: object, why: str) -> None:
    """Refuse a given value that is not `near` the computed one.

    Raises:
        InputError: if `near` is False.
    """
    if not near:
        raise InputError(entry, shown(given), f"must agree with {shown(computed)}, {why}")


def check_share(entry: str, given: float, computed: float, share: float, source: str) -> None:
    """Refuse a number that is off the computed one by more than a relative tolerance."""
    near = abs(given - computed) <= share * abs(computed)
    check(entry, given, near, computed, f"{source}, to {share:g}")


def angle_deg(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    """Angle between two vectors, deg."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def shown(value: object) -> str:
    """A number or a list of them, to six digits."""
    if isinstance(value, float | int):
        return f"{value:g}"
    if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str):
        return f"[{', '.join(f'{float(x):g}' for x in value)}]"
    return str(value)
