"""A scenario as a file of its own: complete TOML, which reads back as the same scenario."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from scp_recon.scenario.schema import Scenario


def scenario_text(scenario: Scenario) -> str:
    """The file. JSON's text, numbers and lists are TOML's too."""
    tables = scenario.model_dump(mode="json", exclude_none=True)
    return "\n".join(_lines("", tables)) + "\n"


def _lines(name: str, table: Mapping[str, Any]) -> Iterator[str]:
    inner = {key: value for key, value in table.items() if isinstance(value, dict)}
    if name:
        yield f"\n[{name}]"
    yield from (f"{key} = {json.dumps(table[key])}" for key in table if key not in inner)
    for key, value in inner.items():
        yield from _lines(f"{name}.{key}" if name else key, value)
