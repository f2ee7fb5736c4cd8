"""Hold the entries of a scenario as they are given, and inherit them from a base.

Given entries are nested tables, a base's with changes on top. Two kinds of entries of the base do
not survive a change: other ways to give the same quantity (a period beside W1), and values that
belong to the old value of another entry (the Sun of another epoch, the normal of another site,
another body's spin). `derive` computes them anew or the schema reports them as missing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from scp_recon.display import digits, exact
from scp_recon.errors import InputError
from scp_recon.scenario.uncertainty import Navigation, OneWay, Uncertainty

Given = dict[str, Any]
"""Entries as given, in nested tables; `Scenario` is the type of a complete set."""

POLE = ("body.pole_ra_deg", "body.pole_dec_deg")
MERIDIAN = (
    "body.prime_meridian_deg",
    "body.prime_meridian_rate_deg_day",
    "body.prime_meridian_acceleration_deg_day2",
)
FIELD = ("body.gm_m3_s2", "body.j2", "body.reference_radius_m", "body.gravity")
COORDINATES = ("site.latitude_deg", "site.longitude_deg")
PLACE = ("site.position_body_m", "site.normal_body")
ENDS = (
    *("boundary.initial_position_m", "boundary.initial_velocity_m_s"),
    *("boundary.final_position_m", "boundary.final_velocity_m_s"),
)
STATE = ("sun.body_position_km", "sun.body_velocity_km_s")
DERIVED = {
    "epoch": ("epoch.tdb",),
    "body": (*POLE, *MERIDIAN, *FIELD),
    "sun": STATE,
    "site": PLACE,
    "boundary": ENDS,
}
"""Entries that `derive` may enter, by table."""
ONE_WAY: dict[str, type[OneWay]] = {"uncertainty": Uncertainty, "navigation": Navigation}
"""Tables whose quantities are each given in one of several ways."""
FILES = (
    *("body.shape_file", "body.solid_file"),
    *("body.pck_file", "body.attitude_file", "body.gravity_file"),
    *("sun.spk_files", "boundary.home.ephemeris_file"),
)
"""Entries that name files, or lists of files, relative to the scenario's own."""


def inherit(base: Mapping[str, Any], changes: Mapping[str, Any]) -> Given:
    """Given entries of a base with changes applied.

    An entry that `changes` gives stays, whatever else changes beside it.
    """
    kept = copied(base)
    for name, schema in ONE_WAY.items():
        given = changes.get(name)
        if isinstance(given, Mapping) and isinstance(kept.get(name), dict):
            kept[name] = schema.without_other_ways(kept[name], given)
    changed = {entry for entry in entries(changes) if _differs(base, changes, entry)}

    def drop(*dropped: str, after: Iterable[str]) -> None:
        """Drop entries, or whole tables, of the base if one of others has changed."""
        if changed.isdisjoint(after):
            return
        for entry in dropped:
            table, _, key = entry.partition(".")
            if not key:
                kept.pop(table, None)
            elif isinstance(kept.get(table), dict):
                kept[table].pop(key, None)

    rate, period, angle = MERIDIAN[1], "body.rotation_period_h", "body.prime_meridian_at_epoch_deg"
    epoch, spin = ("epoch.tdb", "epoch.utc"), (*POLE, *MERIDIAN, period, angle)
    drop("body", "site", *STATE, "sun.spk_files", after=["body.name"])
    drop(*STATE, "sun.state_tdb", angle, after=epoch)
    drop("epoch.utc", after=["epoch.tdb"])
    drop("epoch.tdb", after=["epoch.utc"])
    drop(*spin, after=["body.pck_file", "body.attitude_file"])
    drop("body.attitude", after=["body.attitude_file"])
    if value_of(base, "body.attitude") is not None:  # a body that tumbles
        drop(*POLE, *MERIDIAN, after=["epoch.tdb", "body.attitude"])
    drop(*MERIDIAN, after=[period])
    drop(MERIDIAN[0], after=[angle])
    drop(angle, after=[MERIDIAN[0]])
    drop(period, after=[rate])
    drop(*FIELD, after=["body.gravity_file"])
    drop("body.solid", after=["body.solid_file", "body.shape_unit"])
    drop(*STATE, after=["sun.spk_files"])
    drop(*ENDS, after=["boundary.home"])
    if value_of(base, "boundary.home") is not None:  # whose speed is by GM
        drop(*ENDS, after=["body.gm_m3_s2", "body.gravity_file", "body.name"])
    drop("boundary.home", after=ENDS)
    drop(PLACE[1], *COORDINATES, after=PLACE[:1])
    drop(*PLACE, after=COORDINATES)
    drop(PLACE[1], after=["site.normal_radius_m"])
    if value_of(base, COORDINATES[0]) is not None:
        drop(*PLACE, after=["body.shape_file", "body.shape_unit", "body.radii_m"])
    return _merged(kept, changes)


def derivable(tables: Iterable[str]) -> set[str]:
    """Entries that may be derived once some tables are mended: every table needs epoch and body."""
    wanted = set(tables)
    if "epoch" in wanted:
        wanted = {*DERIVED}
    elif "body" in wanted:
        wanted = {*DERIVED} - {"epoch"}
    return {entry for table in wanted for entry in DERIVED.get(table, ())}


def copied(tables: Mapping[str, Any]) -> Given:
    """A copy whose tables can be changed."""
    return {k: dict(v) if isinstance(v, Mapping) else v for k, v in tables.items()}


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> Given:
    """Nested tables of a base with changes applied: tables are merged, other values replaced."""
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            value = _merged(old, value)
        merged[key] = value
    return merged


def tables_of(values: Iterable[tuple[str, Any]]) -> Given:
    """Nested tables of values by dotted entry; of two values for one entry the later wins."""
    tables: Given = {}
    for entry, value in values:
        for key in reversed(entry.split(".")):
            value = {key: value}
        tables = _merged(tables, value)
    return tables


def entries(tables: Mapping[str, Any]) -> Iterator[str]:
    """Dotted names of all entries, in tables and outside of them."""
    for table, content in tables.items():
        if isinstance(content, Mapping):
            yield from (f"{table}.{key}" for key in content)
        else:
            yield table


def value_of(tables: Mapping[str, Any], entry: str) -> Any:
    """Value of an entry; None if it is absent."""
    table, _, key = entry.partition(".")
    content = tables.get(table)
    return content.get(key) if isinstance(content, Mapping) else None


def keys(entries: Sequence[str]) -> tuple[str, ...]:
    """Keys of the entries of one table, without the table's name."""
    return tuple(entry.partition(".")[2] for entry in entries)


def anchored(tables: Mapping[str, Any], folder: Path) -> Given:
    """Nested tables whose file names, relative to a folder, are made absolute."""

    def anchor(entry: str, value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: anchor(f"{entry}.{key}", inner) for key, inner in value.items()}
        if entry not in FILES:
            return value
        if isinstance(value, list | tuple):
            return [anchor(entry, name) for name in value]
        return str((folder / value).absolute()) if isinstance(value, str) and value else value

    return {key: anchor(key, value) for key, value in tables.items()}


def _differs(base: Mapping[str, Any], changes: Mapping[str, Any], entry: str) -> bool:
    """Whether an entry's value differs from the base's; dates compare as instants."""
    old, new = value_of(base, entry), value_of(changes, entry)
    if entry == "body.name":
        return str(old).casefold() != str(new).casefold()
    with suppress(ValueError):
        if entry == "epoch.tdb":
            return datetime.fromisoformat(str(old)) != datetime.fromisoformat(str(new))
    return bool(old != new)


# --- one table, and what can be computed of it ------------------------------------------------------


def fill(table: Given, values: Mapping[str, Any]) -> None:
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
        raise InputError(entry, shown(given), f"must agree with {shown(computed, digits)}, {why}")


def check_share(entry: str, given: float, computed: float, share: float, source: str) -> None:
    """Refuse a number that is off the computed one by more than a relative tolerance."""
    near = abs(given - computed) <= share * abs(computed)
    check(entry, given, near, computed, f"{source}, to {share:g}")


def shown(value: object, number: Callable[[float], str] = exact) -> str:
    """A number or a list of them, each as a text that a function makes."""
    if isinstance(value, float | int):
        return number(value)
    if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str):
        return f"[{', '.join(number(float(x)) for x in value)}]"
    return str(value)
