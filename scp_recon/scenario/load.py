"""Reading scenarios: a complete TOML file, or one that names a `base` and holds what differs."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from scp_recon.errors import InputError
from scp_recon.files import read_text
from scp_recon.scenario.inherit import inherit, merge, nested
from scp_recon.scenario.resolve import anchored, resolve
from scp_recon.scenario.schema import Scenario

BYTES_MAX = 1_000_000
"""Three hundred times the packaged scenario; TOML of many keys takes its time to read."""
DOTS_MAX = 200
"""In a line: a list of 64 firing times has a third, and what has more nests without end."""
PARTS_MAX = 3
"""Of a dotted entry: section.entry.item."""
BASES_MAX = 8
"""Of files that are each the base of the one before."""


def load_scenario(path: Path | str | None = None, overrides: Sequence[str] = ()) -> Scenario:
    """Read a scenario and apply `section.entry=value` overrides.

    >>> import scp_recon as sr
    >>> sr.load_scenario("recon_b").replace({"risk.p_chance": 0.8}).risk.p_chance
    0.8

    Args:
        path: of a file, or the name of a packaged scenario; `recon_b` if not given.
        overrides: each with its value in TOML.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    name = "recon_b" if path is None else str(path)
    if name in base_names():
        return _validated(_with_base(packaged(name), Path(), ()), overrides)
    file = Path(name)
    return _validated(_with_base(_read(file), file.parent, (file.absolute(),)), overrides)


def validate_scenario(data: Mapping[str, Any], overrides: Sequence[str] = ()) -> Scenario:
    """Validate a scenario given as nested tables, after merging its base and the overrides.

    Files that they name are relative to the current folder.
    """
    return _validated(_with_base(data, Path(), ()), overrides)


def override(scenario: Scenario, overrides: Sequence[str]) -> Scenario:
    """A scenario with other values, and what follows from them.

    What nothing of that touches stays as it is: the files that it came from may be gone.

    Args:
        scenario: resolved.
        overrides: `section.entry=value` each, the value in TOML.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    return scenario.changed(_layer(overrides)) if overrides else scenario


def _validated(data: Mapping[str, Any], overrides: Sequence[str]) -> Scenario:
    return Scenario.validated(resolve(inherit(data, _layer(overrides))))


def _layer(overrides: Sequence[str]) -> dict[str, Any]:
    """All overrides as one: a later one wins, and none takes back another."""
    layer: dict[str, Any] = {}
    for text in overrides:
        layer = merge(layer, _parse_override(text))
    return anchored(layer, Path())


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
    if text.lstrip().startswith("{"):  # TOML never does: likely a solution
        allowed = (
            "must be a scenario file in TOML; solve plans a solution's scenario again with --init"
        )
        raise InputError(f"scenario {path}", "JSON", allowed)
    if any(line.count(".") > DOTS_MAX for line in text.splitlines()):
        raise InputError(f"scenario {path}", "a line of many dots", f"must have at most {DOTS_MAX}")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"scenario {path}", f"no TOML ({str(error)[:120]})", "must be a scenario file"
        ) from None


def _with_base(data: Mapping[str, Any], folder: Path, above: tuple[Path, ...]) -> dict[str, Any]:
    """Nested tables over their base, whose own base is below it, and so on.

    Args:
        data: nested tables as in a file.
        folder: that of the file, to which the files that it names are relative.
        above: the file and those that it is the base of.
    """
    if not {"base", *Scenario.model_fields} & set(data):
        raise InputError(
            "scenario", "none of its entries", 'must be complete or have base = "recon_b"'
        )
    own = anchored({key: value for key, value in data.items() if key != "base"}, folder)
    if "base" not in data:
        return own
    name, names = data["base"], base_names()
    if isinstance(name, str) and name in names:
        return inherit(_with_base(packaged(name), Path(), ()), own)
    if not isinstance(name, str) or not (folder / name).is_file():
        allowed = f"must be one of {', '.join(names)}, or a scenario file"
        raise InputError("base", repr(name)[:80], f"{allowed}, relative to the one that names it")
    file = (folder / name).absolute()
    if any(file.samefile(other) for other in above) or len(above) >= BASES_MAX:
        chain = " -> ".join(other.name for other in (*above, file))
        rule = f"must come to an end, after {BASES_MAX} files at most"
        raise InputError("base", chain, rule)
    return inherit(_with_base(_read(file), file.parent, (*above, file)), own)


def _parse_override(text: str) -> dict[str, Any]:
    path, separator, given = text.partition("=")
    keys = path.strip().split(".")
    if not separator or not all(keys) or len(keys) > PARTS_MAX or not text.isprintable():
        raise InputError("--set", repr(text)[:80], "must read section.entry=value, on one line")
    try:
        value = tomllib.loads(f"value = {given}")["value"]
    except tomllib.TOMLDecodeError:
        value = given  # a bare word is a string: boundary.frame=j2000
    except (ValueError, RecursionError) as error:
        raise InputError("--set", repr(text)[:80], str(error)[:120]) from None
    return nested(keys, value)
