"""Convert Pydantic's errors to one message: entry, value found, value expected."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from scp_recon.errors import InputError, shortened
from scp_recon.scenario.given import derivable

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


INSTEAD = {
    "epoch.": "epoch: utc will do in place of tdb.",
    "body.": "body: the name of a packaged body gives the rest; so do pck_file, attitude_file, "
    "gravity_file, and "
    "rotation_period_h with prime_meridian_at_epoch_deg. Another body inherits nothing.",
    "sun.": "sun: computed for packaged bodies, and from spk_files. Another epoch inherits no Sun.",
    "boundary.": "boundary: a home orbit, boundary.home, gives the states.",
    "site.": "site: latitude_deg and longitude_deg will do on a shape, which is body.radii_m, "
    "body.shape_file or a packaged body's. Another body inherits no site.",
}
"""Alternatives to missing entries, by how these begin."""


def _missing(problems: Iterable[dict[str, Any]], schema: type[BaseModel]) -> list[str]:
    """Every entry that is missing, those of missing tables one by one."""
    entries: list[str] = []
    for location in (problem["loc"] for problem in problems if _is_missing(problem)):
        field = _field(list(location), schema)
        model = field.annotation if field else None
        inside = getattr(model, "model_fields", {})
        keys = [key for key, item in inside.items() if item.is_required()]
        entry = ".".join(map(str, location))
        entries += [f"{entry}.{key}" for key in keys] or [entry]
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
    kind = problem["type"]
    if kind == "extra_forbidden":
        location = list(problem["loc"])
        return (
            ".".join(map(str, location)) or "scenario",
            "an unknown entry",
            _suggestion(location, schema),
        )
    location = _location(problem)
    if kind == "missing":  # of a list of fixed length
        location = location[:-1]
    entry = ".".join(map(str, location)) or "scenario"
    given = _given(problem["input"])
    message = _rule(problem, location, schema)
    return entry, given, message if "must" in message else f"must be {message}"


def _given(value: object) -> str:
    """What was given in words; the entries of a table, if they fit into a line."""
    if not isinstance(value, dict):
        return shortened(value)
    words = ", ".join(f"{key} = {shortened(one)}" for key, one in value.items() if one is not None)
    return words if 0 < len(words) <= LINE else "these values"


def _location(problem: dict[str, Any]) -> list[str | int]:
    return [part for part in problem["loc"] if not _is_union_branch(part)]


def _follows_from_another(problem: dict[str, Any], problems: list[dict[str, Any]]) -> bool:
    """Whether a list is called too short only because one of its items is invalid."""
    depth = len(problem["loc"])
    return problem["type"] == "too_short" and any(
        len(other["loc"]) > depth and other["loc"][:depth] == problem["loc"] for other in problems
    )


LINE = 100
"""Longest list of given entries in a message."""
WORDS = {
    "string_type": "text",
    "string_too_short": "text that is not empty",
    "string_too_long": "text of at most 200 characters",
    "float_type": "a number",
    "finite_number": "a finite number",
    "model_type": "a table",
    "json_invalid": "nested a few levels deep",
    "tuple_type": "a list",
    "datetime_type": "a date and time such as 2020-01-21T20:33:17.184",
    "datetime_parsing": "a date and time such as 2020-01-21T20:33:17.184",
    "datetime_from_date_parsing": "a date and time such as 2020-01-21T20:33:17.184",
}
"""Allowed values, by the type of Pydantic's error."""


def _rule(problem: dict[str, Any], location: list[str | int], schema: type[BaseModel]) -> str:
    """Describe the allowed values at a location."""
    kind, context = problem["type"], problem.get("ctx", {})
    if kind == "too_short":
        return f"must have at least {context['min_length']} items"
    if kind in ("too_long", "missing"):
        length = _fixed_length(location, schema)
        return f"must have {length or 'at most ' + str(context['max_length'])} items"
    if set(problem["loc"][-1:]) & set(INTEGER_BRANCHES):
        return f"a whole number, {_bounds(location, schema)}"
    if kind.startswith(("greater_than", "less_than")):
        return _bounds(location, schema)
    message: str = problem["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    return WORDS.get(kind, message)


def _is_union_branch(part: str | int) -> bool:
    """Whether a part of a location is Pydantic's name of a union's branch, which no user wrote."""
    return isinstance(part, str) and (part.startswith("literal[") or part in INTEGER_BRANCHES)


def _field(location: list[str | int], schema: type[BaseModel]) -> FieldInfo | None:
    """The schema's field at a location, or that of the list which the location is in."""
    model: Any = schema
    field = None
    for part in location:
        if isinstance(part, str):
            field = getattr(model, "model_fields", {}).get(part)
            model = _table(field.annotation) if field else None
    return field


def _declared(annotation: object) -> Iterator[object]:
    """All annotations of a type, those of its items and alternatives included."""
    for part in getattr(annotation, "__metadata__", ()):
        yield from getattr(part, "metadata", ())
    for inner in get_args(annotation):
        yield from _declared(inner)


def _bounds(location: list[str | int], schema: type[BaseModel]) -> str:
    """Both ends of an entry's range, where one end alone was broken."""
    words = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}
    field = _field(location, schema)
    declared = [*field.metadata, *_declared(field.annotation)] if field else []
    rules = [
        f"{words[name]} {_number(getattr(rule, name))}"
        for rule in declared
        for name in words
        if hasattr(rule, name)
    ]
    return " and ".join(dict.fromkeys(rules))  # the same for every item of a list


def _number(value: float) -> str:
    """Shortest text of a number: 1e+07, and 0.999999999."""
    return short if float(short := f"{value:g}") == value else f"{value:.15g}"


def _fixed_length(location: list[str | int], schema: type[BaseModel]) -> int | None:
    """Items of a list whose number is fixed."""
    field = _field(location, schema)
    for kind in (field.annotation, *get_args(field.annotation)) if field else ():
        items = get_args(kind) if getattr(kind, "__origin__", None) is tuple else ()
        if items and items[-1] is not Ellipsis:
            return len(items)
    return None


def _suggestion(location: list[str | int], schema: type[BaseModel]) -> str:
    """Suggest the entry meant by an unknown one, else list the entries of its table."""
    paths = list(_entries(schema))
    written = ".".join(str(part) for part in location)
    by_key = {path.rsplit(".", 1)[1]: path for path in paths}
    near = difflib.get_close_matches(written, paths, n=1, cutoff=0.7)
    near = near or difflib.get_close_matches(str(location[-1]), by_key, n=1, cutoff=0.6)
    if near:
        return f"did you mean {by_key.get(near[0], near[0])}? (units are part of the key)"
    field = _field(location[:-1], schema)
    beside = (_table(field.annotation) if field else None) or schema
    return f"must be one of {', '.join(beside.model_fields)}"


def _entries(schema: type[BaseModel], above: str = "") -> Iterator[str]:
    """Paths of all entries in tables, and in tables of those."""
    for name, field in schema.model_fields.items():
        table = _table(field.annotation)
        if table is not None:
            yield from _entries(table, f"{above}{name}.")
        elif above:
            yield above + name


def _table(annotation: object) -> type[BaseModel] | None:
    """The table among an entry's types, if any."""
    choices = get_args(annotation) or (annotation,)
    tables = (one for one in choices if isinstance(one, type) and issubclass(one, BaseModel))
    return next(tables, None)
