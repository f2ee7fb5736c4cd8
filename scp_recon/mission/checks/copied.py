"""Entries that follow from others and were left as the base has them while those were changed.

Entries are compared by value, so that it makes no difference whether they were inherited, copied from
the base by hand, or left alone by an override.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from scp_recon.errors import InputError

SUN_MOVED_DEG = 0.01
"""Below it another epoch may keep the Sun: a quarter of an hour, of a body at 1 au."""
SITE_MOVED_DEG = 1.0
"""As seen from the body's centre; below it another position may be on the same slope."""

Tables = Mapping[str, Any]


def check_inherited(base: Tables, changed: Tables) -> None:
    """Refuse a Sun of another epoch and a normal of another site.

    Args:
        base: tables of a valid scenario.
        changed: the same with some entries changed.

    Raises:
        InputError: naming the entry that has to be given as well.
    """
    _check_sun(base, changed)
    _check_normal(base, changed)


def _check_sun(base: Tables, changed: Tables) -> None:
    entries = ("body_position_km", "body_velocity_km_s")
    kept = [f"sun.{entry}" for entry in entries if _kept(base, changed, "sun", entry)]
    if not kept:
        return
    before, after = (tables["epoch"]["tdb"] for tables in (base, changed))
    moved = abs((after - before).total_seconds()) * _sun_rate(base)
    if math.degrees(moved) > SUN_MOVED_DEG:
        was, now = (moment.isoformat(timespec="seconds") for moment in (before, after))
        raise InputError(
            kept[0],
            f"the Sun of {was} TDB at the epoch {now} TDB",
            f"must be given for the new epoch: the Sun has moved by {_turn(moved)} about the body",
        )


def _check_normal(base: Tables, changed: Tables) -> None:
    if not _kept(base, changed, "site", "normal_body"):
        return
    before, after = (np.array(t["site"]["position_body_m"], dtype=float) for t in (base, changed))
    sizes = np.linalg.norm(before) * np.linalg.norm(after)
    moved = math.degrees(math.acos(np.clip(before @ after / sizes, -1.0, 1.0))) if sizes else 180.0
    if moved > SITE_MOVED_DEG:
        raise InputError(
            "site.normal_body",
            f"the normal of a site {moved:.1f} deg away",
            "must be given with site.position_body_m: the other site has a slope of its own",
        )


def _kept(base: Tables, changed: Tables, table: str, entry: str) -> bool:
    """Whether an entry is given and the same in both."""
    value = changed[table].get(entry)
    return value is not None and value == base[table].get(entry)


def _sun_rate(tables: Tables) -> float:
    """How fast the Sun's direction turns as seen from the body, rad/s: |r x v| / r^2."""
    position = np.array(tables["sun"]["body_position_km"], dtype=float)
    velocity = np.array(tables["sun"]["body_velocity_km_s"], dtype=float)
    return float(np.linalg.norm(np.cross(position, velocity)) / (position @ position))


def _turn(angle: float) -> str:
    """An angle in degrees; the mean motion says nothing beyond half a turn."""
    degrees = math.degrees(angle)
    return f"{degrees:.3g} deg" if degrees < 180.0 else "more than half a turn"
