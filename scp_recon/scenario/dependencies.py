"""Inherit a base scenario's entries by the graph of dependencies among entries.

A file or an override that changes an entry does not inherit the base's alternative forms of that
entry, nor entries that followed from the old value: the Sun of another epoch, the normal of another
site, another body's spin. Messages do not list an entry as missing if it can still be computed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any, NamedTuple

from scp_recon.scenario.uncertainty import Navigation, OneWay, Uncertainty

Tables = dict[str, Any]

POLE = ("body.pole_ra_deg", "body.pole_dec_deg")
MERIDIAN = (
    "body.prime_meridian_deg",
    "body.prime_meridian_rate_deg_day",
    "body.prime_meridian_acceleration_deg_day2",
)
SPIN = ("body.rotation_period_h", "body.prime_meridian_at_epoch_deg")
FIELD = ("body.gm_m3_s2", "body.j2", "body.reference_radius_m", "body.gravity")
COORDINATES = ("site.latitude_deg", "site.longitude_deg")
PLACE = ("site.position_body_m", "site.normal_body")
ENDS = (
    *("boundary.initial_position_m", "boundary.initial_velocity_m_s"),
    *("boundary.final_position_m", "boundary.final_velocity_m_s"),
)
STATE = ("sun.body_position_km", "sun.body_velocity_km_s")


class Edge(NamedTuple):
    """A dependency between entries or whole tables: if a source changes, its followers are stale."""

    sources: tuple[str, ...]
    followers: tuple[str, ...]
    given: str = ""
    """Entry that the base has to give for that; none if empty."""


GRAPH = (
    Edge(("body.name",), ("body", "site", *STATE, "sun.spk_files")),
    Edge(("epoch.tdb",), (*STATE, "body.prime_meridian_at_epoch_deg", "epoch.utc")),
    Edge(("epoch.utc",), (*STATE, "body.prime_meridian_at_epoch_deg", "epoch.tdb")),
    Edge(("body.pck_file",), (*POLE, *MERIDIAN, *SPIN)),
    Edge(("body.attitude_file",), ("body.attitude", *POLE, *MERIDIAN, *SPIN)),
    Edge(("epoch.tdb", "body.attitude"), (*POLE, *MERIDIAN), "body.attitude"),
    Edge(("body.rotation_period_h",), MERIDIAN),
    Edge(("body.prime_meridian_at_epoch_deg",), MERIDIAN[:1]),
    Edge(MERIDIAN[:1], SPIN[1:]),
    Edge(MERIDIAN[1:2], SPIN[:1]),
    Edge(("body.gravity_file",), FIELD),
    Edge(("body.solid_file", "body.shape_unit"), ("body.solid",)),
    Edge(("sun.spk_files",), STATE),
    Edge(("boundary.home",), ENDS),
    Edge(ENDS, ("boundary.home",)),
    # The speed in a home orbit.
    Edge(("body.gm_m3_s2", "body.gravity_file", "body.name"), ENDS, "boundary.home"),
    Edge(PLACE[:1], ("site.normal_body", *COORDINATES)),
    Edge(COORDINATES, PLACE),
    Edge(("site.normal_radius_m",), PLACE[1:]),
    Edge(("body.shape_file", "body.shape_unit", "body.radii_m"), PLACE, COORDINATES[0]),
)
"""All that follows from something else."""
IN_ONE_WAY: dict[str, type[OneWay]] = {"uncertainty": Uncertainty, "navigation": Navigation}
"""Tables whose quantities are each given in one of several ways."""


def keys(entries: Sequence[str]) -> tuple[str, ...]:
    """Keys of the entries of one table, without the table's name."""
    return tuple(entry.partition(".")[2] for entry in entries)


def computed_from(tables: Iterable[str]) -> set[str]:
    """Entries that can be computed from those of some tables, directly or by way of other tables."""
    reached, before = set(tables), set[str]()
    while reached != before:
        before = set(reached)
        reached |= {_table(f) for edge in GRAPH if _tables(edge) & reached for f in edge.followers}
    return {f for edge in GRAPH if _tables(edge) & reached for f in edge.followers}


def _tables(edge: Edge) -> set[str]:
    return {_table(source) for source in edge.sources}


def _table(entry: str) -> str:
    return entry.partition(".")[0]


def inherit(base: Mapping[str, Any], changes: Mapping[str, Any]) -> Tables:
    """Nested tables of a base with changes applied; stale entries are dropped."""
    kept: Tables = {k: dict(v) if isinstance(v, Mapping) else v for k, v in base.items()}
    for name, schema in IN_ONE_WAY.items():
        given = changes.get(name)
        if isinstance(given, Mapping) and isinstance(kept.get(name), dict):
            kept[name] = schema.without_other_ways(kept[name], given)
    changed = {entry for entry in entries(changes) if differs(base, changes, entry)}
    stale = [
        edge.followers
        for edge in GRAPH
        if changed & set(edge.sources) and (not edge.given or found(base, edge.given) is not None)
    ]
    for entry in (entry for gone in stale for entry in gone):
        table, _, key = entry.partition(".")
        if not key:
            kept.pop(table, None)
        elif isinstance(kept.get(table), dict):
            kept[table].pop(key, None)
    return merge(kept, changes)


def merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> Tables:
    """Nested tables of a base with changes applied: tables are merged, other values replaced."""
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            merged[key] = merge(old, value)
        else:
            merged[key] = value
    return merged


def layer_of(values: Iterable[tuple[str, Any]]) -> Tables:
    """Nested tables of values by dotted entry; of two values for one entry the later wins."""
    layer: Tables = {}
    for entry, value in values:
        for key in reversed(entry.split(".")):
            value = {key: value}
        layer = merge(layer, value)
    return layer


def entries(tables: Mapping[str, Any]) -> Iterator[str]:
    """Dotted names of all entries, in tables and outside of them."""
    for table, content in tables.items():
        if isinstance(content, Mapping):
            yield from (f"{table}.{key}" for key in content)
        else:
            yield table


def found(tables: Mapping[str, Any], entry: str) -> Any:
    """Value of an entry; None if it is absent."""
    table, _, key = entry.partition(".")
    content = tables.get(table)
    return content.get(key) if isinstance(content, Mapping) else None


def differs(base: Mapping[str, Any], changes: Mapping[str, Any], entry: str) -> bool:
    """Whether an entry's value differs from the base's; dates compare as instants."""
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


OLDER_LEAD, OLDER_LEAD_S = "decision_lead_s", 1800.0
"""What once was in `[schedule]` and is `navigation.lead_s` today, and its default of then."""


def older_lead(stored: Mapping[str, Any]) -> Any:
    """The lead of a stored scenario that is older than `[navigation]`; None for a later one."""
    return None if "navigation" in stored else found(stored, f"schedule.{OLDER_LEAD}")


def with_todays_lead(stored: Mapping[str, Any]) -> Tables:
    """A stored scenario with its lead moved to today's entry.

    In a whole flight only later decisions depend on the lead, so today's default replaces the old
    default.
    """
    tables, lead = dict(stored), older_lead(stored)
    if lead is not None:
        rules = tables["schedule"]
        tables["schedule"] = {key: rules[key] for key in rules if key != OLDER_LEAD}
        if lead != OLDER_LEAD_S or tables.get("in_flight") is not None:
            tables["navigation"] = {"lead_s": lead}
    return tables
