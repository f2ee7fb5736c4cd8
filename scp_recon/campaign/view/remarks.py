"""A campaign in a few lines, for the terminal and the page."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from scp_recon.campaign.engine.columns import VERIFIED
from scp_recon.campaign.view.labels import CHANCE, COST, DELTA_V
from scp_recon.campaign.view.outcome import (
    FEASIBLE,
    NO_ANSWER,
    NO_MISSION,
    NOT_VERIFIED,
    SHORTFALLS,
    CampaignResults,
)

COMMONEST = 3
"""Reasons that are named of those why cases have no plan."""
LONGEST = 160
"""Characters of a reason."""


def remarks(results: CampaignResults) -> list[str]:
    """How the cases ended, what the feasible ones cost, what stopped the others, what had no effect."""
    counts = ", ".join(f"{count:,} {end}" for end, count in results.counts().items())
    found = [f"Ends: {counts}."]
    table, ends = results.table, np.array(results.ends)
    good = table[ends == FEASIBLE]
    if len(good):
        low, middle, high = np.percentile(good[COST], (0, 50, 100))
        found.append(
            f"{DELTA_V.capitalize()}: least {low:.4f}, median {middle:.4f}, most {high:.4f}. "
            f"Lowest probability of a joint constraint: {good[CHANCE].min():.3f} to "
            f"{good[CHANCE].max():.3f}."
        )
    doubted = table[ends == NOT_VERIFIED]
    found += _reasons("Broken most", table.get("binds"))
    refuted = doubted["verdict"] != VERIFIED
    found += _reasons("Not borne out", doubted["verdict"][refuted])
    for column in SHORTFALLS:
        found += _reasons("Not borne out", doubted[~refuted].get(column))
    for end in (NO_MISSION, NO_ANSWER):
        found += _reasons(end.capitalize(), table[ends == end].get("message"))
    found += _reasons("Warned", table.get("warnings"))
    if results.idle:
        listed = ", ".join(results.idle)
        found.append(f"No effect: {listed}; ends, delta-v and probabilities are the same along it.")
    if results.overlaid:
        found.append(
            "Pictures show the cheapest of the cases that share a place; the table has all."
        )
    return found


def _reasons(what: str, column: Any) -> Iterator[str]:
    """The commonest values of a column, if there is any."""
    counts = {} if column is None else column.value_counts().to_dict()
    if counts:
        most = list(counts.items())[:COMMONEST]
        named = ", ".join(f"{_short(name)} ({count:,})" for name, count in most)
        yield f"{what}: {named}."


def _short(reason: str) -> str:
    line = " ".join(reason.removeprefix("not verified: ").split())
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 3]}..."
