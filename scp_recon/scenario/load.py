"""Read and write scenarios in TOML: complete files, or a `base` and the entries that differ."""

from __future__ import annotations

import errno
import json
import os
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache, reduce
from importlib.resources import files
from pathlib import Path
from typing import Any

from scp_recon.errors import InputError, nearest, option, shortened
from scp_recon.files import read_text
from scp_recon.scenario.derive import derive
from scp_recon.scenario.given import anchored, inherit, tables_of
from scp_recon.scenario.schema import Scenario

BYTES_MAX = 1_000_000
"""Three hundred times the packaged scenario; TOML of many keys takes its time to read."""
SHORT = re.compile(r"[+-]?(?:\d+\.|\.\d+)(?:[eE][+-]?\d+)?")
"""Numbers that begin or end with their point."""
DOTS_MAX = 200
"""Beside those of numbers, in a line: what has more nests without end."""
NUMBER = re.compile(r"(?<![\w.])[+-]?\d[\d_]*\.\d[\d_]*(?:[eE][+-]?\d+)?(?![\w.])")
PARTS_MAX = 4
"""Most parts of a dotted entry: knowledge.body.companion.gm_m3_s2."""
NO_FILE = os.strerror(errno.ENOENT).lower()
BASES_MAX = 8
"""Most files that are each the base of the one before."""


def load_scenario(path: Path | str | None = None, overrides: Sequence[str] = ()) -> Scenario:
    """Read a scenario and apply `section.entry=value` overrides.

    Args:
        path: a file, or the name of a packaged scenario; `recon_b` if not given.
        overrides: each with its value in TOML.

    Returns:
        The scenario, checked; `replace` changes entries.

    Raises:
        InputError: naming the entry, what was given and what is allowed.

    Examples:
        >>> import scp_recon as sr
        >>> sr.load_scenario("recon_b").replace({"risk.p_chance": 0.8}).risk.p_chance
        0.8
    """
    if path is not None and not isinstance(path, str | Path):
        raise InputError(
            "scenario", shortened(path), "must be a file, or a packaged scenario's name"
        )
    name = "recon_b" if path is None else str(path)
    if name in base_names():
        return _validated(packaged(name), None, overrides)
    file = Path(name)
    with naming_files(file, overrides):
        return _validated(_read(file), file, overrides)


@contextmanager
def naming_files(scenario: object, overrides: Sequence[str] = ()) -> Iterator[None]:
    """Context in which errors and warnings of a scenario name the file that holds the entry.

    Entries of overrides and of packaged scenarios get no file.

    Args:
        scenario: its file; other forms of a scenario have no file to name.
        overrides: that were applied to it.
    """
    try:
        yield
    except InputError as error:
        if not isinstance(scenario, str | Path) or str(scenario) in base_names() or error.file:
            raise
        layer, sources = _layer(overrides), list[tuple[Path, Mapping[str, Any]]]()
        with suppress(InputError):  # bases are named as far as they can be read
            for file, tables in _layers(_read(Path(scenario)), Path(scenario)):
                sources += [] if file is None else [(file, tables)]

        def file_of(entry: str) -> str:
            if _holds(layer, entry) or not sources:
                return ""
            if entry in ("base", "scenario"):  # of the file at which the chain ends
                return str(sources[-1][0])
            held = [str(file) for file, tables in sources if _holds(tables, entry)]
            known = entry.partition(".")[0] in Scenario.model_fields
            return held[0] if held else str(sources[0][0]) if known else ""

        raise error.in_files(file_of) from None


def _holds(tables: Mapping[str, Any], entry: str) -> bool:
    """Whether some tables have an entry, or a value in which it is an item."""
    inside: Any = tables
    for key in entry.split("."):
        if not isinstance(inside, Mapping):
            return True
        if key not in inside:
            return False
        inside = inside[key]
    return True


def validate_scenario(data: Mapping[str, Any], overrides: Sequence[str] = ()) -> Scenario:
    """Validate a scenario given as nested tables, after merging its base and the overrides.

    Files that they name are relative to the current folder.
    """
    return _validated(data, None, overrides)


def override(scenario: Scenario, overrides: Sequence[str]) -> Scenario:
    """A scenario with other values and everything computed from them.

    An override is `section.entry=value`, the value in TOML. Entries that do not depend on the
    override are kept and not computed again, because their files may no longer exist.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    return scenario.replace(_layer(overrides)) if overrides else scenario


def _validated(data: Mapping[str, Any], file: Path | None, overrides: Sequence[str]) -> Scenario:
    given = [_layer(overrides), *(tables for _, tables in _layers(data, file))]
    return Scenario.validated(derive(reduce(inherit, reversed(given))))


def _layer(overrides: Sequence[str]) -> dict[str, Any]:
    """Nested tables of all overrides."""
    return anchored(tables_of(map(_parse_override, overrides)), Path())


def base_names() -> list[str]:
    """Names of the scenarios in the package."""
    folder = files("scp_recon") / "data"
    return sorted(
        f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml")
    )


def packaged(name: str) -> dict[str, Any]:
    """Tables of a scenario in the package."""
    return tomllib.loads((files("scp_recon") / "data" / f"{name}.toml").read_text(encoding="utf-8"))


@cache
def packaged_scenario(name: str) -> Scenario:
    """A scenario in the package, resolved."""
    return load_scenario(name)


def _read(path: Path) -> dict[str, Any]:
    again = "must be a scenario file in TOML; solve plans a solution's scenario again with --init"
    if path.is_dir():
        raise InputError(f"scenario {path}", "a folder", again)
    try:
        text = read_text(path, f"scenario {path}", "scenario file in TOML", BYTES_MAX)
    except InputError as error:
        if error.given != NO_FILE:
            raise
        names, meant = ", ".join(base_names()), nearest(path, base_names())
        allowed = f"{meant}{error.allowed}, or a packaged scenario: {names}"
        raise InputError(error.entry, error.given, allowed) from None
    if text.lstrip().startswith("{"):  # TOML never does: likely a solution
        raise InputError(f"scenario {path}", "JSON", again)
    dotted = (line for line in text.splitlines() if line.count(".") > DOTS_MAX)
    if any(NUMBER.sub("", line).count(".") > DOTS_MAX for line in dotted):
        raise InputError(f"scenario {path}", "a line of many dots", f"must have at most {DOTS_MAX}")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"scenario {path}", f"no TOML ({str(error)[:120]})", "must be a scenario file"
        ) from None


def _layers(
    data: Mapping[str, Any], file: Path | None
) -> Iterator[tuple[Path | None, dict[str, Any]]]:
    """A scenario's own tables and those of each base in turn, with their files if they have one."""
    above: list[Path] = []
    while True:
        folder = Path() if file is None else file.parent
        yield file, anchored({key: data[key] for key in data if key != "base"}, folder)
        if not {"base", *Scenario.model_fields} & set(data):
            rule = 'must be complete or have base = "recon_b"'
            raise InputError("scenario", "none of its entries", rule)
        if "base" not in data:
            return
        name, names = data["base"], base_names()
        if isinstance(name, str) and name in names:
            file, data = None, packaged(name)
            continue
        if not isinstance(name, str) or not (folder / name).is_file():
            rule = (
                f"must be one of {', '.join(names)}, or a scenario file, relative to the one that "
            )
            raise InputError("base", repr(name)[:80], f"{rule}names it")
        above += [] if file is None else [file.absolute()]
        file = folder / name
        if any(file.samefile(other) for other in above) or len(above) >= BASES_MAX:
            chain = " -> ".join(other.name for other in (*above, file))
            rule = f"must come to an end, after {BASES_MAX} files at most"
            raise InputError("base", chain, rule)
        data = _read(file)


def _parse_override(text: str) -> tuple[str, Any]:
    path, separator, given = text.partition("=")
    keys = path.strip().split(".")
    if not separator or not all(keys) or len(keys) > PARTS_MAX or not text.isprintable():
        raise InputError(
            option("overrides"), repr(text)[:80], "must read section.entry=value, on one line"
        )
    try:
        value = tomllib.loads(f"value = {given}")["value"]
    except tomllib.TOMLDecodeError:
        # A bare word is a string, boundary.frame=j2000, but for numbers that TOML has not, as .8.
        value = float(given) if SHORT.fullmatch(given.strip()) else given
    except (ValueError, RecursionError) as error:
        raise InputError(option("overrides"), repr(text)[:80], str(error)[:120]) from None
    return ".".join(keys), value


def scenario_text(scenario: Scenario) -> str:
    """A scenario as a TOML file. JSON's text, numbers and lists are valid TOML."""
    tables = scenario.model_dump(mode="json", exclude_none=True)
    return "\n".join(_lines("", tables)) + "\n"


def _lines(name: str, table: Mapping[str, Any]) -> Iterator[str]:
    inner = {key: value for key, value in table.items() if isinstance(value, dict)}
    if name:
        yield f"\n[{name}]"
    yield from (f"{key} = {json.dumps(table[key])}" for key in table if key not in inner)
    for key, value in inner.items():
        yield from _lines(f"{name}.{key}" if name else key, value)
