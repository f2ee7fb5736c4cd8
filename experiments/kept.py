"""Rows of a study as they come, so that a run that was stopped continues.

A line of JSON each, below one that says what they belong to: the study's settings, and a hash of the
sources that made them. A file of anything else is begun anew, and a study that has ended takes its own
away.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from experiments.studies import Cell
from scp_recon.files import write_atomically

SOURCES = ("formulations/**/*.py", "scp_recon/**/*.py", "scp_recon/data/**/*.toml")

Kind = dict[str, Any]


@cache
def sources_hash(study: Path) -> str:
    """Of the library and the study's own files, in hexadecimal."""
    root, digest = Path(__file__).parents[1], hashlib.sha256()
    own = study.parent.glob("*.py") if study.name == "__main__.py" else [study]
    files = [path for pattern in SOURCES for path in root.glob(pattern)]
    for path in sorted({*files, *own}):
        digest.update(path.read_bytes())
    return digest.hexdigest()


class Kept:
    """What a study has found so far.

    Args:
        path: of the file; its folder is made.
        study: the study's module, `__file__`.
        setting: what rows depend on besides the sources.
    """

    def __init__(self, path: Path, study: str, setting: Mapping[str, Cell]) -> None:
        self._path = path
        self._head = json.dumps({"sources": sources_hash(Path(study)), **setting})
        self.rows: dict[str, Kind] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            head, *lines = path.read_text("utf-8").splitlines()
            if head == self._head:
                self.rows = {line["key"]: line["row"] for line in map(json.loads, lines)}
        except (OSError, ValueError, KeyError, TypeError):  # none, or a damaged one
            self.rows = {}

    def row(self, key: str, make: Callable[[], Kind]) -> Kind:
        """A row that is kept, or that is made now and kept from here on."""
        if key not in self.rows:
            self.rows[key] = make()
            lines = [json.dumps({"key": key, "row": row}) for key, row in self.rows.items()]
            write_atomically(self._path, "\n".join([self._head, *lines]) + "\n")
        return self.rows[key]

    def forget(self) -> None:
        """Take the file away: its rows are in the study's table."""
        self._path.unlink(missing_ok=True)
