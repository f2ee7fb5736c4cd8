"""What is wrong with a scenario, in the user's words."""

from __future__ import annotations

import difflib
from typing import Any

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from scp_recon.errors import InputError
from scp_recon.scenario_schema import Scenario

MAX_PROBLEMS_SHOWN, SHOWN = 5, 80


def input_error(error: ValidationError) -> InputError:
    """One message for everything that is wrong, the first problem giving the entry."""
    allowed: dict[tuple[str, str], list[str]] = {}
    for problem in error.errors(include_url=False):
        entry, given, rule = _describe(dict(problem))
        rules = allowed.setdefault((entry, given), [])
        if rule not in rules:
            rules.append(rule)
    (entry, given), *others = allowed
    more = [f"{e}: got {g}; {', or '.join(allowed[e, g])}" for e, g in others]
    if len(more) >= MAX_PROBLEMS_SHOWN:
        more[MAX_PROBLEMS_SHOWN - 1 :] = [f"... and {len(more) - MAX_PROBLEMS_SHOWN + 1} more"]
    return InputError(entry, given, "\n".join([", or ".join(allowed[entry, given]), *more]))


def _describe(problem: dict[str, Any]) -> tuple[str, str, str]:
    """Entry, what was given and what is allowed, from one of Pydantic's errors."""
    kind = problem["type"]
    if kind == "extra_forbidden":
        location = list(problem["loc"])
        return ".".join(map(str, location)) or "scenario", "an unknown entry", _suggestion(location)
    location = [part for part in problem["loc"] if not _is_union_branch(part)]
    entry = ".".join(map(str, location)) or "scenario"
    if kind == "missing":
        return entry, "nothing", "this entry is required (or name a base)"
    given = "these values" if isinstance(problem["input"], dict) else _shown(problem["input"])
    bounds = _bounds(location) if kind.startswith(("greater_than", "less_than")) else ""
    message = bounds or problem["msg"].removeprefix("Value error, ")
    message = message.removeprefix("Input should be ").replace("an object", "a table")
    return entry, given, message if "must" in message else f"must be {message}"


def _is_union_branch(part: str | int) -> bool:
    """Pydantic names the branch of a union in the location; the user did not write it."""
    return isinstance(part, str) and (
        part.startswith("literal[") or part in ("int", "constrained-int")
    )


def _field(location: list[str | int]) -> FieldInfo | None:
    """The scenario's field at a location, if it is a plain one."""
    model: Any = Scenario
    field = None
    for part in location:
        field = getattr(model, "model_fields", {}).get(part)
        model = field.annotation if field else None
    return field


def _bounds(location: list[str | int]) -> str:
    """Both ends of a field's range, where one end alone was broken."""
    words = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}
    field = _field(location)
    rules = [
        f"{words[name]} {getattr(rule, name):g}"
        for rule in (field.metadata if field else [])
        for name in words
        if hasattr(rule, name)
    ]
    return " and ".join(rules)


def _suggestion(location: list[str | int]) -> str:
    """The entry that an unknown one may have been meant for, else those beside it."""
    tables = {name: field.annotation for name, field in Scenario.model_fields.items()}
    paths = [
        f"{table}.{key}"
        for table, model in tables.items()
        for key in getattr(model, "model_fields", {})
    ]
    written = ".".join(str(part) for part in location)
    by_key = {path.split(".")[1]: path for path in paths}
    near = difflib.get_close_matches(written, paths, n=1, cutoff=0.7)
    near = near or difflib.get_close_matches(str(location[-1]), by_key, n=1, cutoff=0.6)
    if near:
        return f"did you mean {by_key.get(near[0], near[0])}? (units are part of the key)"
    beside = getattr(tables.get(str(location[0])), "model_fields", None) if location[1:] else tables
    return f"must be one of {', '.join(beside or tables)}"


def _shown(value: object) -> str:
    """A value as the user may know it, but not at any length."""
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."
