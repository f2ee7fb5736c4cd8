"""What a file, or an override, takes over from what it is based on.

Where it says something anew, what the base says of the same thing in other words, and what followed
from it, is not taken over: the Sun of another epoch, the normal of another site, another body's spin.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any

from scp_recon.scenario.uncertainty import without_other_ways

Tables = dict[str, Any]

POLE = ("body.pole_ra_deg", "body.pole_dec_deg")
MERIDIAN = (
    "body.prime_meridian_deg",
    "body.prime_meridian_rate_deg_day",
    "body.prime_meridian_acceleration_deg_day2",
)
SPIN = ("body.rotation_period_h", "body.prime_meridian_at_epoch_deg")
COORDINATES = ("site.latitude_deg", "site.longitude_deg")
ENDS = (
    *("boundary.initial_position_m", "boundary.initial_velocity_m_s"),
    *("boundary.final_position_m", "boundary.final_velocity_m_s"),
)
STATE = ("sun.body_position_km", "sun.body_velocity_km_s")

FOLLOWS: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = (
    (("body.name",), ("body", "site", *STATE, "sun.spk_files")),
    (("epoch.tdb",), (*STATE, "body.prime_meridian_at_epoch_deg")),
    (("body.pck_file",), (*POLE, *MERIDIAN, *SPIN)),
    (("body.rotation_period_h",), MERIDIAN),
    (("body.prime_meridian_at_epoch_deg",), MERIDIAN[:1]),
    (MERIDIAN[:1], SPIN[1:]),
    (MERIDIAN[1:2], SPIN[:1]),
    (
        ("body.gravity_file",),
        ("body.gm_m3_s2", "body.j2", "body.reference_radius_m", "body.gravity"),
    ),
    (("sun.spk_files",), STATE),
    (("boundary.home",), ENDS),
    (ENDS, ("boundary.home",)),
    (("site.position_body_m",), ("site.normal_body", *COORDINATES)),
    (COORDINATES, ("site.position_body_m", "site.normal_body")),
    (("site.normal_radius_m",), ("site.normal_body",)),
)
"""Entries that a file may say anew, and what it then does not take over from its base."""
GM = ("body.gm_m3_s2", "body.gravity_file", "body.name")
"""From which the speed in a home orbit follows."""
SURFACE = ("body.shape_file", "body.shape_unit", "body.radii_m")
"""From which the position of a site follows that is said by its coordinates."""


def inherit(base: Mapping[str, Any], changes: Mapping[str, Any]) -> Tables:
    """What is based on some tables and changes them.

    Args:
        base: nested tables.
        changes: nested tables, only what is said anew.

    Returns:
        New nested tables; those of `base` are not changed.
    """
    kept: Tables = {k: dict(v) if isinstance(v, Mapping) else v for k, v in base.items()}
    given = changes.get("uncertainty")
    if isinstance(given, Mapping) and isinstance(kept.get("uncertainty"), dict):
        kept["uncertainty"] = without_other_ways(kept["uncertainty"], given)
    changed = {entry for entry in entries(changes) if differs(base, changes, entry)}
    followers = [gone for said, gone in FOLLOWS if changed & set(said)]
    if changed & set(SURFACE) and found(base, COORDINATES[0]) is not None:
        followers.append(("site.position_body_m", "site.normal_body"))
    if found(base, "boundary.home") is not None and changed & set(GM):
        followers.append(ENDS)
    for entry in (entry for gone in followers for entry in gone):
        table, _, key = entry.partition(".")
        if not key:
            kept.pop(table, None)
        elif isinstance(kept.get(table), dict):
            kept[table].pop(key, None)
    return merge(kept, changes)


def merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> Tables:
    """Nested tables with some entries changed; tables are merged, everything else replaced."""
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            merged[key] = merge(old, value)
        else:
            merged[key] = value
    return merged


def nested(keys: Sequence[str], value: Any) -> Tables:
    """A value in the tables that some keys name, the outermost first."""
    first, *rest = keys
    return {first: nested(rest, value) if rest else value}


def entries(tables: Mapping[str, Any]) -> Iterator[str]:
    """Dotted names of what stands in tables and outside of them."""
    for table, content in tables.items():
        if isinstance(content, Mapping):
            yield from (f"{table}.{key}" for key in content)
        else:
            yield table


def found(tables: Mapping[str, Any], entry: str) -> Any:
    """What an entry holds; None if it is absent."""
    table, _, key = entry.partition(".")
    content = tables.get(table)
    return content.get(key) if isinstance(content, Mapping) else None


def differs(base: Mapping[str, Any], changes: Mapping[str, Any], entry: str) -> bool:
    """Whether an entry says something that the base does not, however dates are written."""
    old, new = found(base, entry), found(changes, entry)
    if entry == "epoch.tdb":
        return _date(old) != _date(new)
    if entry == "body.name":
        return str(old).casefold() != str(new).casefold()
    return bool(old != new)


def _date(value: object) -> object:
    try:
        return datetime.fromisoformat(str(value))
    except ValueError:
        return value
