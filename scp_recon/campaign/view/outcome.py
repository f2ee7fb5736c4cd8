"""A campaign as it is shown: its rows, how each ended, and along what they differ."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scp_recon.campaign.engine.columns import VERIFIED
from scp_recon.campaign.engine.run import FILE_NAME, SCHEMA
from scp_recon.campaign.rows.case import REFUSED
from scp_recon.campaign.rows.table import read_results
from scp_recon.campaign.study.axes import LATITUDE, LONGITUDE
from scp_recon.campaign.study.study import Campaign
from scp_recon.errors import InputError
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status

if TYPE_CHECKING:
    import pandas

FEASIBLE, INFEASIBLE, NO_MISSION, NOT_VERIFIED, NO_ANSWER = (
    *("feasible", "infeasible", "no mission"),
    *("not verified", "no answer"),
)
"""How a case ends: a verified plan; none that keeps the limits; refused, as without a lighting window;
a plan that flights or other checks do not bear out; an iteration that ended early, or a failure."""
ENDS = (FEASIBLE, INFEASIBLE, NO_MISSION, NOT_VERIFIED, NO_ANSWER)
NAMES = ("site.name",)
"""Entries that only name others."""


@dataclass(frozen=True)
class CampaignResults:
    """What a campaign has found, finished or not.

    Attributes:
        folder: of the campaign.
        table: rows by case.
        base: scenario of all cases, before their own changes.
        campaign: the study's table of that name.
        entries: what the axes change.
        cases: how many there are to be.
    """

    folder: Path
    table: pandas.DataFrame
    base: Scenario
    campaign: Campaign
    entries: tuple[str, ...]
    cases: int

    @cached_property
    def ends(self) -> list[str]:
        """How each row ended, one of `ENDS`."""
        rows = self.table.reindex(columns=["status", "verdict"])
        return [
            _end(status, verdict)
            for status, verdict in zip(rows["status"], rows["verdict"], strict=True)
        ]

    @cached_property
    def feasible(self) -> int:
        """Cases with a verified plan."""
        return self.ends.count(FEASIBLE)

    @property
    def verdict(self) -> str:
        """How many are feasible of how many."""
        done = len(self.table)
        so_far = "" if done == self.cases else f" run so far, of {self.cases:,} in the study"
        return f"{self.feasible:,} feasible of {done:,} cases{so_far}"

    @property
    def is_map(self) -> bool:
        """Whether it has sites by latitude and longitude."""
        return LATITUDE in self.entries and LONGITUDE in self.entries

    @cached_property
    def free(self) -> tuple[str, ...]:
        """The entries along which cases differ, of those that change together the first."""
        found: list[str] = []
        for entry in self.entries:
            if entry in NAMES or self.table[entry].nunique() < 2:
                continue
            if not any(self._follows(entry, other) for other in found):
                found.append(entry)
        return tuple(found)

    def _follows(self, entry: str, other: str) -> bool:
        return int(self.table.groupby(other)[entry].nunique().max()) == 1

    def counts(self) -> dict[str, int]:
        """Cases by how they ended, those that there are."""
        return {end: self.ends.count(end) for end in ENDS if end in self.ends}


def _end(status: Any, verdict: Any) -> str:
    if status == Status.CONVERGED.value.name:
        return FEASIBLE if verdict == VERIFIED else NOT_VERIFIED
    if status == Status.INFEASIBLE.value.name:
        return INFEASIBLE
    return NO_MISSION if status == REFUSED else NO_ANSWER


def read_campaign(folder: Path) -> CampaignResults:
    """Read the folder of a campaign, finished or not.

    Raises:
        InputError: if it holds none, or the extra [campaign] is missing.
    """
    path = folder / FILE_NAME
    try:
        found = json.loads(path.read_text("utf-8"))
        if not isinstance(found, dict) or found.get("schema") != SCHEMA:
            raise ValueError(f"schema {found.get('schema')!r}" if isinstance(found, dict) else "")
        base = Scenario.validated(found["base"])
        campaign = Campaign.model_validate(found["study"].get("campaign", {}))
        entries, cases = tuple(found["entries"]), int(found["cases"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError("folder", f"{folder} ({error})"[:200], "must hold a campaign") from None
    return CampaignResults(folder, read_results(folder), base, campaign, entries, cases)
