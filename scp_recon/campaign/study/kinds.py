"""The kinds of axes: an axis is of the kind whose key its table has."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scp_recon.campaign.study.axes import Axis, Draws, Grid, Sites, Values, Windows
from scp_recon.campaign.study.shape_sites import ShapeSites

KINDS: dict[str, type[Axis]] = {
    "values": Values,
    "grid": Grid,
    "draws": Draws,
    "sites": Sites,
    "spread": ShapeSites,
    "windows": Windows,
}
"""By the key that says so."""


def axis_of(table: Mapping[str, Any]) -> type[Axis]:
    """The kind of an axis.

    Raises:
        ValueError: if its table has not exactly one key of `KINDS`.
    """
    kinds = [key for key in KINDS if key in table]
    if len(kinds) != 1:
        raise ValueError(f"must have one of {', '.join(KINDS)}")
    return KINDS[kinds[0]]
