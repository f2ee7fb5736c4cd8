"""Write the JSON schema of scenario files, with which editors complete and check them.

An entry's description is the docstring below its field. Descriptions are read here and not at
import, because reading them takes longer than making the classes.
"""

from __future__ import annotations

import ast
import inspect
import itertools
import json
import sys
from typing import Any

from pydantic import BaseModel

from scp_recon.bodies.catalogue import body_names
from scp_recon.scenario.fields import walk
from scp_recon.scenario.load import base_names
from scp_recon.scenario.schema import Scenario

TITLE = "scp_recon scenario"
DRAFT = "http://json-schema.org/draft-07/schema#"
"""What taplo and Even Better TOML read; Pydantic writes 2020-12, which names two things otherwise."""


def json_schema() -> dict[str, Any]:
    """JSON schema of a scenario file: the entries of `Scenario`, none of them required, and `base`.

    None is required because a base or a computation may give it; the program says what is missing.
    """
    schema = Scenario.model_json_schema()
    models: dict[str, type[BaseModel]] = {"Scenario": Scenario}
    models |= {table.__name__: table for _, table in walk(Scenario) if table is not None}
    definitions = _as_draft_7(schema.pop("$defs"))
    for name, table in [("Scenario", schema), *definitions.items()]:
        table.pop("required", None)
        descriptions = field_descriptions(models[name])
        for key, entry in table["properties"].items():
            entry.pop("title", None)
            if "description" not in entry and key in descriptions:
                entry["description"] = descriptions[key]
    base = {
        "description": "What this file changes: a packaged scenario "
        f"({', '.join(base_names())}), or a scenario file relative to this one.",
        "type": "string",
    }
    definitions["Body"]["properties"]["name"]["examples"] = body_names()
    properties = {"base": base, **_as_draft_7(schema["properties"])}
    return {
        "$schema": DRAFT,
        "title": TITLE,
        "description": "Units are in the names of the entries; angles are in degrees.",
        "type": "object",
        "additionalProperties": False,
        "properties": properties,
        "definitions": definitions,
    }


def _as_draft_7(part: Any) -> Any:
    """Rewrite a 2020-12 schema as draft 7: `definitions`, `items`, and date-times without a format."""
    if isinstance(part, dict):
        return {
            "items" if key == "prefixItems" else key: _as_draft_7(value)
            for key, value in part.items()
            if key != "format"
        }
    if isinstance(part, list):
        return [_as_draft_7(item) for item in part]
    return part.replace("#/$defs/", "#/definitions/") if isinstance(part, str) else part


def field_descriptions(kind: type) -> dict[str, str]:
    """Descriptions of a class's fields: the docstring below each, or that of the field's table."""
    tree = ast.parse(inspect.getsource(sys.modules[kind.__module__]))
    body = next(
        node.body
        for node in tree.body
        if isinstance(node, ast.ClassDef) and node.name == kind.__name__
    )
    models = kind.model_fields if issubclass(kind, BaseModel) else {}
    descriptions = {
        name: field.annotation.__doc__ or ""
        for name, field in models.items()
        if inspect.isclass(field.annotation) and issubclass(field.annotation, BaseModel)
    }
    for field, below in itertools.pairwise(body):
        if (
            isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(below, ast.Expr)
            and isinstance(below.value, ast.Constant)
        ):
            descriptions[field.target.id] = inspect.cleandoc(str(below.value.value)).replace(
                "\n", " "
            )
    return descriptions


def schema_text() -> str:
    """Text of the schema file."""
    return json.dumps(json_schema(), indent=2) + "\n"
