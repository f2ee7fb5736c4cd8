"""The published JSON schema: up to date, with every entry described."""

from __future__ import annotations

import json
import tomllib
from importlib.resources import files
from pathlib import Path

from scp_recon.cli.commands import schema
from scp_recon.scenario.json_schema import schema_text

PUBLISHED = Path(__file__).parents[3] / "docs" / "scenario.schema.json"


def test_it_is_up_to_date() -> None:
    assert PUBLISHED.read_text("utf-8") == schema_text(), (
        "run python -m scp_recon schema docs/scenario.schema.json"
    )


def test_every_entry_is_described_and_none_unknown_is_let_in() -> None:
    published = json.loads(PUBLISHED.read_text("utf-8"))
    for name, table in {"the file": published, **published["definitions"]}.items():
        assert table["additionalProperties"] is False
        assert "required" not in table  # a base may give it
        for key, entry in table["properties"].items():
            assert len(entry.get("description", "")) > 5, f"{name}.{key}"


def test_the_packaged_scenario_has_entries_of_the_schema_only() -> None:
    published = json.loads(PUBLISHED.read_text("utf-8"))
    text = (files("scp_recon") / "data" / "recon_b.toml").read_text("utf-8")
    for name, table in tomllib.loads(text).items():
        entry = published["properties"][name]
        if isinstance(table, dict):
            definition = published["definitions"][entry["$ref"].rpartition("/")[2]]
            assert set(table) <= set(definition["properties"])


def test_the_command_writes_it(tmp_path: Path) -> None:
    assert schema.main([str(tmp_path / "new" / "schema.json")]) == 0
    assert (tmp_path / "new" / "schema.json").read_text("utf-8") == schema_text()
    assert schema.main([str(tmp_path / "new")]) == 2  # a folder
