"""A base scenario with what a case changes of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scp_recon.scenario.inherit import merge, nested
from scp_recon.scenario.resolve import anchored
from scp_recon.scenario.schema import Scenario


def changed(base: Scenario, changes: Mapping[str, Any], folder: Path) -> Scenario:
    """The base with a case's changes.

    Raises:
        InputError: if that is no scenario.
    """
    return base.changed(layer_of(changes, folder)) if changes else base


def layer_of(changes: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Nested tables of values by entry; the files among them are named for good."""
    layer: dict[str, Any] = {}
    for entry, value in changes.items():
        layer = merge(layer, nested(entry.split("."), value))
    return anchored(layer, folder)
