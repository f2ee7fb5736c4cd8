"""A campaign as it is shown: its rows, how each ended, and along what they differ."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scp_recon.campaign.engine.columns import VERIFIED
from scp_recon.campaign.engine.run import FILE_NAME, SCHEMA
from scp_recon.campaign.rows.case import REFUSED
from scp_recon.campaign.rows.table import read_results
from scp_recon.campaign.study.axes import EPOCH, LATITUDE, LONGITUDE
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
a plan that flights, a simulation or other checks do not bear out; an iteration that ended early, or a
failure."""
ENDS = (FEASIBLE, INFEASIBLE, NO_MISSION, NOT_VERIFIED, NO_ANSWER)
NAMES = ("site.name",)
"""Entries that only name others."""
SHORTFALLS = ("flown_shortfalls", "simulated_shortfalls")
"""Columns of what a plan's own flights or its simulation did not keep."""
AXES_DRAWN = 3
"""Entries for which curves have room: along them, one by one, and in panels."""
TOLD = ("status", "verdict", "total_dv_m_s", "probability", "binds")
"""Columns in which an entry that matters makes a difference; they are drawn by no seed of a case."""


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
        short = self.table.reindex(columns=list(SHORTFALLS)).notna().any(axis=1)
        return [
            _end(status, verdict, kept=not missed)
            for status, verdict, missed in zip(rows["status"], rows["verdict"], short, strict=True)
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

    @cached_property
    def varies(self) -> list[str]:
        """The entries of numbers, or the epoch, in which cases differ."""
        kinds = self.table.dtypes
        return [e for e in self.free if e == EPOCH or kinds[e].kind in "if"]

    @cached_property
    def by_site(self) -> CampaignResults:
        """Of each site one case: the cheapest feasible one, or else the first that came furthest."""
        ranks = [ENDS.index(end) for end in self.ends]
        costs = self.table["total_dv_m_s"].where([end == FEASIBLE for end in self.ends])
        rows = self.table.assign(rank=ranks, cost=costs).sort_values(["rank", "cost", "case"])
        kept = rows.drop_duplicates([LATITUDE, LONGITUDE])["case"]
        return replace(self, table=self.table[self.table["case"].isin(kept)])

    @property
    def overlaid(self) -> bool:
        """Whether several cases share a place in the pictures, which show the cheapest of them."""
        if self.is_map:
            return len(self.by_site.table) < len(self.table)
        return bool(self.varies) and not len(self.free) == len(self.varies) <= AXES_DRAWN

    def scatters(self, entry: str) -> bool:
        """Whether other numbers jump up and down along an entry, as where several are drawn."""
        along = self.table.sort_values(entry)
        return any(
            not (along[other].is_monotonic_increasing or along[other].is_monotonic_decreasing)
            for other in self.entries
            if other not in self.free
            and along[other].dtype.kind in "if"
            and self._follows(other, entry)
        )

    @cached_property
    def idle(self) -> tuple[str, ...]:
        """Entries that make no difference to any plan, whatever the others are."""
        return tuple(entry for entry in self.free if self._is_idle(entry))

    def _is_idle(self, entry: str) -> bool:
        others = [other for other in self.free if other != entry]
        plans = self.table[self.table["total_dv_m_s"].notna()]
        if plans[entry].nunique() < 2:
            return False
        rows = self.table.reindex(columns=[entry, *others, *TOLD])
        groups = rows.groupby(others) if others else [((), rows)]
        found = [part for _, part in groups if part[entry].nunique() > 1]
        return bool(found) and all(
            part[column].nunique(dropna=False) == 1 for part in found for column in TOLD
        )

    def _follows(self, entry: str, other: str) -> bool:
        return int(self.table.groupby(other)[entry].nunique().max()) == 1

    def counts(self) -> dict[str, int]:
        """Cases by how they ended, those that there are."""
        return {end: self.ends.count(end) for end in ENDS if end in self.ends}


def _end(status: Any, verdict: Any, *, kept: bool) -> str:
    if status == Status.CONVERGED.value.name:
        return FEASIBLE if verdict == VERIFIED and kept else NOT_VERIFIED
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
