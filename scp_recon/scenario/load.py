"""Reading scenarios: a complete TOML file, or one that names a `base` and holds what differs."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from scp_recon.errors import InputError
from scp_recon.files import read_text
from scp_recon.scenario.inheritance import check_inherited
from scp_recon.scenario.schema import Scenario, merge, nested

BYTES_MAX = 1_000_000
"""Three hundred times the packaged scenario; TOML of many keys takes its time to read."""
DOTS_MAX = 200
"""In a line: a list of 64 firing times has a third, and what has more nests without end."""
PARTS_MAX = 3
"""Of a dotted entry: section.entry.item."""


def load_scenario(path: Path | str | None = None, overrides: Sequence[str] = ()) -> Scenario:
    """Read a scenario and apply `path=value` overrides.

    Args:
        path: of a file, or the name of a packaged scenario; `recon_b` if not given.
        overrides: `section.entry=value` each, the value in TOML.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    name = "recon_b" if path is None else str(path)
    data = packaged(name) if name in base_names() else _read(Path(name))
    return validate_scenario(data, overrides)


def validate_scenario(data: Mapping[str, Any], overrides: Sequence[str] = ()) -> Scenario:
    """Validate a scenario given as nested tables, after merging its base and the overrides."""
    if not {"base", *Scenario.model_fields} & set(data):
        raise InputError(
            "scenario", "none of its entries", 'must be complete or have base = "recon_b"'
        )
    merged = _with_base(data)
    for override in overrides:
        merged = merge(merged, _parse_override(override))
    scenario = Scenario.validated(merged)
    if (base := _before(data)) is not None:
        check_inherited(base.model_dump(), scenario.model_dump())
    return scenario


def base_names() -> list[str]:
    """Names of the scenarios in the package."""
    folder = files("scp_recon") / "data"
    return sorted(
        f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml")
    )


def packaged(name: str) -> dict[str, Any]:
    """Tables of a scenario in the package."""
    return tomllib.loads((files("scp_recon") / "data" / f"{name}.toml").read_text(encoding="utf-8"))


def _read(path: Path) -> dict[str, Any]:
    text = read_text(path, f"scenario {path}", "scenario file in TOML", BYTES_MAX)
    if any(line.count(".") > DOTS_MAX for line in text.splitlines()):
        raise InputError(f"scenario {path}", "a line of many dots", f"must have at most {DOTS_MAX}")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"scenario {path}", f"no TOML ({str(error)[:120]})", "must be a scenario file"
        ) from None


def _with_base(data: Mapping[str, Any]) -> dict[str, Any]:
    own = {key: value for key, value in data.items() if key != "base"}
    if "base" not in data:
        return own
    if data["base"] not in base_names():
        raise InputError("base", repr(data["base"]), f"must be one of {', '.join(base_names())}")
    return merge(packaged(data["base"]), own)


def _before(data: Mapping[str, Any]) -> Scenario | None:
    """What overrides and a derived file change: the base, or the file's own scenario if it is whole."""
    if "base" in data:
        return Scenario.validated(packaged(data["base"]))
    try:
        return Scenario.validated(data)
    except InputError:
        return None


def _parse_override(override: str) -> dict[str, Any]:
    path, separator, text = override.partition("=")
    keys = path.strip().split(".")
    if not separator or not all(keys) or len(keys) > PARTS_MAX or not override.isprintable():
        raise InputError("--set", repr(override)[:80], "must read section.entry=value, on one line")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text  # a bare word is a string: boundary.frame=j2000
    except (ValueError, RecursionError) as error:
        raise InputError("--set", repr(override)[:80], str(error)[:120]) from None
    return nested(keys, value)
