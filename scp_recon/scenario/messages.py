"""Convert Pydantic's errors to one message: entry, value found, value expected by the JSON schema."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from typing import Any

from pydantic import BaseModel, ValidationError

from scp_recon.errors import InputError, shortened
from scp_recon.scenario.fields import unit_hint, unit_of, walk
from scp_recon.scenario.given import ENDS, derivable

Node = dict[str, Any]
"""Part of a JSON schema: what is allowed at one place."""
MAX_PROBLEMS_SHOWN = 5
INTEGER_BRANCHES = ("int", "constrained-int")
"""Pydantic's names of the whole-number alternative of an entry."""


def input_error(error: ValidationError, schema: type[BaseModel]) -> InputError:
    """One `InputError` for all of Pydantic's problems; its entry is the first problem's."""
    allowed: dict[tuple[str, str], list[str]] = {}
    found = [dict(problem) for problem in error.errors(include_url=False)]
    missing = _missing(found, schema)
    problems = [
        problem
        for problem in found
        if not _is_missing(problem) and not _follows_from_another(problem, found)
    ]
    if not problems:
        return InputError(missing[0], "nothing", _all_of(missing[1:], "required, as are", missing))
    entries = {tuple(_location(problem)) for problem in problems}
    # What may follow as soon as that is mended is not called missing before.
    computed = derivable({str(location[0]) for location in entries if location})
    missing = [entry for entry in missing if entry not in computed]
    for problem in problems:
        entry, given, rule = _describe(problem, schema)
        rules = allowed.setdefault((entry, given), [])
        if rule not in rules:
            rules.append(rule)
        if len(allowed) > MAX_PROBLEMS_SHOWN:  # the others are only counted
            break
    (entry, given), *others = allowed
    more = [f"{e}: got {g}; {', or '.join(allowed[e, g])}" for e, g in others]
    if len(more) >= MAX_PROBLEMS_SHOWN:
        more[MAX_PROBLEMS_SHOWN - 1 :] = [f"... and {len(entries) - MAX_PROBLEMS_SHOWN} more"]
    if missing:
        more.append(_all_of(missing, "missing:", missing))
    return InputError(entry, given, "\n".join([", or ".join(allowed[entry, given]), *more]))


INSTEAD: dict[str | tuple[str, ...], str] = {
    "epoch.": "epoch: utc will do in place of tdb.",
    "body.": "body: the name of a packaged body gives the rest; so do pck_file, attitude_file, "
    "gravity_file, and "
    "rotation_period_h with prime_meridian_at_epoch_deg. Another body inherits nothing.",
    "sun.": "sun: computed for packaged bodies, and from spk_files. Another epoch inherits no Sun.",
    (
        "boundary.initial",
        "boundary.final",
    ): "boundary: a home orbit, boundary.home, gives the states.",
    "site.": "site: latitude_deg and longitude_deg will do on a shape, which is body.radii_m, "
    "body.shape_file or a packaged body's. Another body inherits no site.",
}
"""Alternatives to missing entries, by how these begin."""


def _missing(problems: Iterable[dict[str, Any]], schema: type[BaseModel]) -> list[str]:
    """Every entry that is missing, those of missing tables one by one."""
    entries: list[str] = []
    for location in (problem["loc"] for problem in problems if _is_missing(problem)):
        entry = ".".join(map(str, location))
        keys = [key for table in _at(location, schema) for key in table.get("required", ())]
        entries += [f"{entry}.{key}" for key in keys] or [entry]
    if any(entry.startswith("boundary.home.") for entry in entries):  # which gives the states
        return [entry for entry in entries if entry not in ENDS]
    return entries


def _is_missing(problem: dict[str, Any]) -> bool:
    """Whether a problem is a missing entry, and not a missing item of a list of fixed length."""
    return problem["type"] == "missing" and not isinstance(problem["loc"][-1], int)


def _all_of(listed: Sequence[str], words: str, missing: Sequence[str]) -> str:
    """A list of missing entries, and the entries that would replace them."""
    sentence = f"{words} {', '.join(listed)}" if listed else "required"
    hints = [hint for table, hint in INSTEAD.items() if any(e.startswith(table) for e in missing)]
    return "\n".join([f"{sentence} (or name a base)", *hints])


def _describe(problem: dict[str, Any], schema: type[BaseModel]) -> tuple[str, str, str]:
    """Entry, what was given and what is allowed, from one of Pydantic's errors."""
    kind, location = problem["type"], _location(problem)
    if kind == "extra_forbidden":
        location = list(problem["loc"])
        entry = ".".join(map(str, location)) or "scenario"
        return entry, "an unknown entry", _suggestion(location, schema)
    if kind == "missing":  # of a list of fixed length
        location = location[:-1]
    entry = ".".join(map(str, location)) or "scenario"
    message = _rule(problem, _at(location, schema)) + _slip(problem, entry, _at(location, schema))
    return entry, _given(problem["input"]), message if "must" in message else f"must be {message}"


def _slip(problem: dict[str, Any], entry: str, allowed: Sequence[Node]) -> str:
    """The hint at a unit, if a number is out of its range."""
    value = problem["input"]
    if not isinstance(value, int | float) or not problem["type"].startswith(("greater", "less")):
        return ""
    ends = {end: node[key] for node in allowed for key, (end, _) in BOUNDS.items() if key in node}
    unit = unit_of(next(part for part in reversed(entry.split(".")) if not part.isdigit()))
    low, high = ends.get("low", -math.inf), ends.get("high", math.inf)
    return unit_hint(unit, value, low, high) if unit or high <= 1.0 else ""


def _given(value: object) -> str:
    """What was given in words; the entries of a table, if they fit into a line."""
    if not isinstance(value, dict):
        return shortened(value)
    words = ", ".join(f"{key} = {shortened(one)}" for key, one in value.items() if one is not None)
    return words if 0 < len(words) <= LINE else "these values"


def _location(problem: dict[str, Any]) -> list[str | int]:
    """Place of a problem without Pydantic's names of a union's branches, which no user wrote."""
    return [
        part
        for part in problem["loc"]
        if part not in INTEGER_BRANCHES and not str(part).startswith("literal[")
    ]


def _follows_from_another(problem: dict[str, Any], problems: list[dict[str, Any]]) -> bool:
    """Whether a list is called too short only because one of its items is invalid."""
    depth = len(problem["loc"])
    return problem["type"] == "too_short" and any(
        len(other["loc"]) > depth and other["loc"][:depth] == problem["loc"] for other in problems
    )


LINE = 100
"""Longest list of given entries in a message."""
DATE = "a date and time such as 2020-01-21T20:33:17.184"
WORDS = {
    "string_type": "text",
    "string_too_short": "text that is not empty",
    "string_too_long": "text of at most 200 characters",
    "float_type": "a number",
    "finite_number": "a finite number",
    "model_type": "a table",
    "json_invalid": "nested a few levels deep",
    "tuple_type": "a list",
    **dict.fromkeys(("datetime_type", "datetime_parsing", "datetime_from_date_parsing"), DATE),
}
"""Allowed values, by the type of Pydantic's error."""
BOUNDS = {
    "exclusiveMinimum": ("low", "greater than"),
    "minimum": ("low", "at least"),
    "exclusiveMaximum": ("high", "less than"),
    "maximum": ("high", "at most"),
}
"""End of a range, and its words, by the JSON schema's names."""


def _rule(problem: dict[str, Any], allowed: Sequence[Node]) -> str:
    """Describe the allowed values at a place: of a range both ends, where one alone was broken."""
    kind, context = problem["type"], problem.get("ctx", {})
    bounds = " and ".join(
        f"{words} {_number(node[key])}"
        for node in allowed
        for key, (_, words) in BOUNDS.items()
        if key in node
    )
    if kind == "too_short":
        return f"must have at least {context['min_length']} items"
    if kind in ("too_long", "missing"):
        most = context.get("max_length")
        lengths = [len(node["prefixItems"]) for node in allowed if "prefixItems" in node]
        return f"must have {[*lengths, f'at most {most}'][0]} items"
    if set(problem["loc"][-1:]) & set(INTEGER_BRANCHES):
        return f"a whole number, {bounds}"
    if kind.startswith(("greater_than", "less_than")):
        return bounds
    message: str = problem["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    return WORDS.get(kind, message)


def _number(value: float) -> str:
    """Shortest text of a number: 1e+07, and 0.999999999."""
    return short if float(short := f"{value:g}") == value else f"{value:.15g}"


def _suggestion(location: list[str | int], schema: type[BaseModel]) -> str:
    """Suggest the entry meant by an unknown one, else list the entries of its table."""
    paths = [path for path, table in walk(schema) if table is None and "." in path]
    key = str(location[-1])
    written = ".".join(str(part) for part in location)
    by_key = {path.rsplit(".", 1)[1]: path for path in paths}
    tables = [node for node in _at(location[:-1], schema) if "properties" in node]
    beside = (tables or [_whole(schema)])[0]["properties"]
    begun = [other for other in beside if other.startswith(f"{key}_")]
    near = [".".join([*written.split(".")[:-1], begun[0]])] if len(begun) == 1 else []
    if len(location) == 1:
        near = near or difflib.get_close_matches(key, beside, n=1, cutoff=0.7)
    near = near or difflib.get_close_matches(written, paths, n=1, cutoff=0.7)
    near = near or difflib.get_close_matches(key, by_key, n=1, cutoff=0.6)
    if not near:
        return f"must be one of {', '.join(beside)}"
    meant = near[0].rsplit(".", 1)[-1]
    lacks_unit = "_" in meant and (
        key.split("_")[:-1] == meant.split("_")[:-1] or meant.startswith(key)
    )
    units = " (units are part of the key)" if lacks_unit else ""
    return f"did you mean {by_key.get(near[0], near[0])}?{units}"


# --- the JSON schema --------------------------------------------------------------------------------


@cache
def _whole(schema: type[BaseModel]) -> Node:
    return schema.model_json_schema()


def _at(location: Sequence[str | int], schema: type[BaseModel]) -> list[Node]:
    """Alternatives at a place of the schema; none where there is no such entry."""
    found = [_whole(schema)]
    for part in location:
        inner = []
        for node in found:
            if isinstance(part, str):
                inner.append(node.get("properties", {}).get(part))
            else:
                fixed = node.get("prefixItems", [])
                inner.append(fixed[part] if part < len(fixed) else node.get("items"))
        found = [one for node in inner if node for one in _alternatives(node, schema)]
    return found


def _alternatives(node: Node, schema: type[BaseModel]) -> Iterator[Node]:
    """A node, or those it stands for: the table that it names, and the branches of a union."""
    if "$ref" in node:
        node = _whole(schema)["$defs"][node["$ref"].rpartition("/")[2]]
    if "anyOf" not in node:
        yield node
    for branch in node.get("anyOf", ()):
        yield from _alternatives(branch, schema)
