"""What the project's JSON files share: frozen, strict parts, a schema, and one way of reading."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from scp_recon.errors import InputError
from scp_recon.files import read_text

Probability = Annotated[float, Field(ge=0, le=1)]


class Part(BaseModel):
    """Frozen and strict: unknown keys are refused, and so are booleans or strings for numbers."""

    model_config = ConfigDict(
        frozen=True, strict=True, extra="forbid", allow_inf_nan=False, validate_by_name=True
    )


class File(Part):
    """The whole content of a file; keys that a later version added are ignored."""

    model_config = ConfigDict(extra="ignore")


FileKind = TypeVar("FileKind", bound=File)


def read_file(path: Path, kind: type[FileKind], schemas: Sequence[str], noun: str) -> FileKind:
    """Read a file of a schema.

    Args:
        path: of the file.
        kind: what it holds.
        schemas: what its entry `schema` may be, the newest last.
        noun: what to call it in messages.

    Raises:
        InputError: if there is none, it is of another version, or it is damaged.
    """
    return parse_file(read_json(path, noun), kind, schemas, f"{noun} {path}")


def parse_file(data: Any, kind: type[FileKind], schemas: Sequence[str], named: str) -> FileKind:
    """What JSON holds, validated, as `read_file` does; messages call it by its name."""
    if not isinstance(data, dict) or data.get("schema") not in schemas:
        given = data.get("schema", "no schema") if isinstance(data, dict) else "no object"
        raise InputError(named, repr(given)[:80], f"schema must be {schemas[-1]!r}")
    try:
        # Through JSON again: strict fields such as tuples and dates read from it as written to it.
        return kind.model_validate_json(json.dumps(data))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        entry = ".".join(str(part) for part in first["loc"])
        given = repr(first["input"])[:80] if first["type"] != "missing" else "nothing"
        raise InputError(f"{named}: {entry}", given, first["msg"]) from None


def read_json(path: Path, noun: str) -> Any:
    """What a file of JSON holds; messages call it by the noun.

    Raises:
        InputError: if there is none, or it is no JSON.
    """
    text = read_text(path, f"{noun} {path}", f"{noun} file in JSON")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = f"no JSON ({error})"
        raise InputError(f"{noun} {path}", reason, f"must be a {noun} file") from None
