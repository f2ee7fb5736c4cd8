"""Write the reference pages from the code: `python -m scp_recon.reference docs/reference`.

Commands come from their parsers. Entries and keys come from the types that validate them, with the
descriptions beside their fields. Warnings come from the rows and functions that raise them.
"""

from __future__ import annotations

import argparse
import inspect
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from formulations.risk import strata
from scp_recon.cli.command import EXIT_STATUSES, SCRIPT, add_output_options
from scp_recon.cli.commands import COMMANDS
from scp_recon.cli.options import DESCRIBED
from scp_recon.errors import InputError
from scp_recon.files import check_own, check_writable, write_atomically
from scp_recon.mission import checks, scene
from scp_recon.mission.intervals import INTERVALS, PLANNER_INTERVALS, STATE_INTERVALS, Interval
from scp_recon.planning import primer, records
from scp_recon.results import facts, figures, policy, verification
from scp_recon.results.solution import HASH, SCHEMA
from scp_recon.scenario.json_schema import field_descriptions, json_schema
from scp_recon.simulation.vehicle import check_vehicle

Schema = Mapping[str, Any]
VAST = 1e9
"""Bounds from here on only keep squares finite."""
OF_HASH = "`scenario`, `burns` and corrections"
HEAD = "<!-- Written by `make reference` from the code: do not edit. -->\n\n"


def commands_page() -> str:
    """Every command with its arguments and options, and the exit statuses."""
    shared = argparse.ArgumentParser(add_help=False)
    add_output_options(shared)
    parts = [
        "# Commands",
        f"`{SCRIPT} NAME ...` or `python -m scp_recon NAME ...`; `python -m scp_recon.solve` is "
        f"`{SCRIPT} solve`.",
        table(("exit status", "means"), EXIT_STATUSES.items()),
        "## Options of every command",
        table(("option", "means"), _options(shared)),
    ]
    for name, command in COMMANDS.items():
        parser = command.parser()
        parts += [f"## {name}", str(parser.description)]
        rows = list(_options(parser))
        parts += [table(("argument or option", "means"), rows)] if rows else []
    return _page(parts)


def _options(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    """Each argument as it is typed, and its help."""
    formatter = parser._get_formatter()
    for action in parser._actions:
        if action.dest != "help":
            metavar = action.metavar if isinstance(action.metavar, str) else ""
            metavar += " ..." if action.nargs == "+" else ""
            words = f"{action.option_strings[-1]} {metavar}" if action.option_strings else metavar
            required = "; required" if action.option_strings and action.required else ""
            yield f"`{words.strip()}`", formatter._expand_help(action) + required


def scenario_page() -> str:
    """Every entry of a scenario file."""
    schema = json_schema()
    parts = [
        "# Entries of a scenario",
        f"{schema['description']} [scenario.md](../scenario.md) says what has to be given, and what "
        "follows from it.",
    ]
    for path, entries in _tables(schema, schema["definitions"]):
        rows = []
        for key, entry in entries["properties"].items():
            text, kind, default = _flowing(entry["description"]), _kind(entry), entry.get("default")
            if "table" in kind:  # it stands there in full
                text = text.split(". ")[0].removesuffix(".") + "."
            shown = "" if default is None or isinstance(default, dict) else f"`{default}`"
            rows.append((f"`{key}`", kind, shown, text))
        parts.append(f"## `[{path}]`" if path else "## Above all tables")
        parts += [_flowing(entries["description"])] if path else []
        parts.append(table(("entry", "value", "default", "means"), rows))
    return _page(parts)


def solution_page() -> str:
    """Every key of a solution file."""
    modules = (records, strata, primer, scene, policy, facts, verification, figures)
    kinds = {name: kind for module in modules for name, kind in vars(module).items()}
    head, means = (
        ("key", "value", "means"),
        f"SHA-256 of {OF_HASH} as they were written; see there.",
    )
    rows = [("`schema`", "text", f"`{SCHEMA}`."), (f"`{HASH}`", "text", means)]
    parts = []
    for root in (figures.Figures, facts.Facts):
        schema = facts.adapter(root).json_schema()
        schema["properties"].pop("scenario", None)
        for path, entries in _tables(schema, schema["$defs"]):
            kind = kinds[entries["title"]] if path else root
            properties = zip(entries["properties"].items(), _fields(kind), strict=False)
            found = [(f"`{key}`", _kind(entry), text) for (key, entry), text in properties]
            if path:
                parts += [f"## `{path}`", _summary(kind), table(head, found)]
            else:
                rows += found
    rows.append(("`scenario`", "table", _fields(facts.Facts)[-1]))
    begin = (
        "# Keys of a solution file",
        "SI, J2000, body-centred. [solution_file.md](../solution_file.md) says which follow from "
        "others, and what the verification is.",
    )
    return _page([*begin, table(head, rows), *parts])


def _fields(kind: Any) -> list[str]:
    """Descriptions of a type's fields in order, by their keys in the file."""
    if issubclass(kind, BaseModel):
        descriptions = field_descriptions(kind)
        return [descriptions[name] for name in kind.model_fields]
    descriptions = {}
    for each in reversed(kind.__mro__[:-1]):
        _, _, block = (inspect.getdoc(each) or "").partition("Attributes:\n")
        descriptions |= DESCRIBED.findall(block)
        descriptions |= field_descriptions(each)
    return [descriptions[field.name] for field in fields(kind)]


def warnings_page() -> str:
    """Every check that refuses a scenario or warns about it."""
    rows = (_row(row) for row in (*PLANNER_INTERVALS, *INTERVALS, *STATE_INTERVALS))
    every = (*checks.CHECKS, *checks.STATE_CHECKS)
    functions = [check for check in every if inspect.isfunction(check)]
    parts = [
        "# What is refused, and what is warned about",
        inspect.cleandoc(checks.__doc__ or "").partition("\n\n")[2],
        "## Quantities held to an interval",
        "Outside what is allowed an entry is refused, outside what is expected it is warned about. "
        "Of a vector its length counts.",
        table(("entries", "quantity", "allowed", "expected"), rows),
        "## Other checks",
        "\n".join(
            f"- {_summary(each)}" for each in (*functions, checks.check_window, check_vehicle)
        ),
    ]
    return _page(parts)


def _row(row: Interval) -> tuple[str, ...]:
    entries = ", ".join(f"`{entry}`" for entry in row.entries.split())
    ends = (row.within(ends) if ends else "" for ends in (row.refuse, row.warn))
    return entries, row.quantity or "itself", *ends


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    cells = [[_flowing(cell).replace("|", "\\|") for cell in line] for line in lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


def _tables(schema: Schema, definitions: Schema) -> Iterator[tuple[str, Schema]]:
    """Every table with its dotted path, the outermost with an empty one first."""
    open_tables: list[tuple[str, Schema]] = [("", schema)]
    while open_tables:
        path, entries = open_tables.pop(0)
        yield path, entries
        open_tables[:0] = [
            (f"{path}.{key}".lstrip("."), definitions[name])
            for key, entry in entries["properties"].items()
            for name in dict.fromkeys(re.findall(r"'#/\$?\w+/(\w+)'", str(entry)))
        ]


def _kind(entry: Schema) -> str:
    """The values that an entry may have, in words."""
    if "$ref" in entry:
        return "table"
    if "anyOf" in entry:
        kinds = [_kind(one) for one in entry["anyOf"] if one.get("type") != "null"]
        return " or ".join(dict.fromkeys(kinds))
    if "enum" in entry or "const" in entry:
        return " or ".join(f"`{one}`" for one in entry.get("enum", [entry.get("const")]))
    if entry["type"] == "array":
        each = entry.get("prefixItems") or entry.get("items", {})
        if isinstance(each, list):
            kinds = [_kind(one) for one in each]
            same = len(set(kinds)) == 1
            return f"{len(kinds)} times {kinds[0]}" if same else f"[{', '.join(kinds)}]"
        ends = " to ".join(str(entry[key]) for key in ("minItems", "maxItems") if key in entry)
        return f"list{f' of {ends}' if ends else ''}: {_kind(each)}"
    if entry["type"] == "object":
        return f"by name: {_kind(entry['additionalProperties'])}"
    names = {"string": "text", "boolean": "true or false"}
    signs = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
    bounds = [
        f"{sign} {entry[key]:.8g}"
        for key, sign in signs.items()
        if abs(entry.get(key, VAST)) < VAST
    ]
    return f"{names.get(entry['type'], entry['type'])} {', '.join(bounds)}".strip()


def _summary(thing: object) -> str:
    """A docstring without its sections, in one line."""
    return _flowing(re.split(r"\n\n(?:Attributes|Args|Raises):\n", inspect.getdoc(thing) or "")[0])


def _flowing(text: str) -> str:
    return " ".join(text.split())


def _page(parts: Iterable[str]) -> str:
    return HEAD + "\n\n".join(parts) + "\n"


PAGES = {
    "commands": commands_page,
    "scenario": scenario_page,
    "solution": solution_page,
    "warnings": warnings_page,
}
"""Names of the pages, and what makes them."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Write every page into the folder that is named."""
    parser = argparse.ArgumentParser("python -m scp_recon.reference", description=main.__doc__)
    parser.add_argument("folder", type=Path, help="such as docs/reference")
    folder = parser.parse_args(arguments).folder
    try:
        for name, page in PAGES.items():
            check_writable(folder, f"{name}.md", "folder")
            check_own(folder / f"{name}.md", "folder", HEAD.strip().encode())
            write_atomically(folder / f"{name}.md", page())
    except InputError as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    sys.exit(main())
