"""The published JSON schema: up to date, with every entry described."""

from __future__ import annotations

import json
from pathlib import Path

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
