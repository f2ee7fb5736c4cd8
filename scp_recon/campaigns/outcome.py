"""Read and sum up the results of a campaign: rows, outcomes, axes and remarks."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scp_recon.campaigns.axes import EPOCH, LATITUDE, LONGITUDE, NAME
from scp_recon.campaigns.run import FILE_NAME, SCHEMA, VERIFIED, read_results
from scp_recon.campaigns.study import Campaign
from scp_recon.display import digits
from scp_recon.errors import InputError
from scp_recon.jobs.job import REFUSED
from scp_recon.mission.constraints import required_in_words
from scp_recon.reports.marks import PLANS
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status

if TYPE_CHECKING:
    import pandas
ENDS = FEASIBLE, INFEASIBLE, NO_MISSION, NOT_VERIFIED, NO_ANSWER = (
    *("feasible", "infeasible", "no mission"),
    *("not verified", "no answer"),
)
"""Ends of a case: a verified plan; infeasible; refused, as without a lighting window; a plan that
fails its flights, simulation or other checks; an iteration that ended early, or a failure."""
SHORTFALLS = ("flown_shortfalls", "simulated_shortfalls")
"""Columns of requirements that a plan's own flights or its simulation did not meet."""
AXES_DRAWN = 3
"""Number of entries that curves can show: along the curve, by curve, and by panel."""
COST, CHANCE = "dv99_m_s", "probability"
"""Columns that are drawn. The probability is the lowest of the joint constraints over the nodes, of
10,000 flights of the nonlinear dynamics."""
COLOURS = "Viridis"
"""Plotly's colour scale: readable with any colour vision, and without grey."""
UNIT = re.compile(r"(.+?)_(w_m2|m_s|deg|km|kg|m2|m|s|h)")
WRITTEN = {"w_m2": "W/m^2", "m_s": "m/s", "m2": "m^2"}
"""An entry's key with its unit, and the units that are written otherwise than in keys."""
NAMED = {"tdb": "epoch (TDB)", "name": "site"}
GREYS = {INFEASIBLE: "#8b9098", NO_MISSION: "#bcc1c8", NOT_VERIFIED: PLANS[1], NO_ANSWER: PLANS[3]}
"""Colours of sites without a verified plan."""
COMMONEST = 3
"""Reasons shown for cases without a plan."""
LONGEST = 160
"""Characters of a reason."""


@dataclass(frozen=True)
class CampaignResults:
    """Results of a campaign, finished or not: one row for each ended case, out of `cases`.

    `base` is the scenario of all cases, before the axes change its `entries`.
    """

    folder: Path
    table: pandas.DataFrame
    base: Scenario
    campaign: Campaign
    entries: tuple[str, ...]
    cases: int

    @cached_property
    def ends(self) -> list[str]:
        """End of each row, one of `ENDS`."""
        rows = self.table.reindex(columns=["status", "verdict", *SHORTFALLS])
        planned = rows["status"] == Status.CONVERGED.value.name
        kept = (rows["verdict"] == VERIFIED) & rows[list(SHORTFALLS)].isna().all(axis=1)
        infeasible, refused = (
            rows["status"] == status for status in (Status.INFEASIBLE.value.name, REFUSED)
        )
        found: list[str] = np.select(
            [planned & kept, planned, infeasible, refused],
            [FEASIBLE, NOT_VERIFIED, INFEASIBLE, NO_MISSION],
            NO_ANSWER,
        ).tolist()
        return found

    def ending(self, end: str) -> pandas.DataFrame:
        """The rows with that end."""
        return self.table[np.array(self.ends) == end]

    @property
    def feasible(self) -> int:
        """Number of cases with a verified plan."""
        return self.ends.count(FEASIBLE)

    @property
    def verdict(self) -> str:
        """Sentence such as "12 feasible of 30 cases"."""
        done = len(self.table)
        so_far = "" if done == self.cases else f" run so far, of {self.cases:,} in the study"
        return f"{self.feasible:,} feasible of {done:,} cases{so_far}"

    @property
    def is_map(self) -> bool:
        """Whether the axes are sites by latitude and longitude."""
        return LATITUDE in self.entries and LONGITUDE in self.entries

    @cached_property
    def measures(self) -> tuple[tuple[str, str], tuple[str, str]]:
        """Columns that are drawn, and their names: feedback's cost is what 99 % of flights command."""
        plans = self.table.dropna(subset=[COST])
        corrected = (plans[COST] != plans["total_dv_m_s"]).any()
        cost = "99 % of commanded delta-v (m/s)" if corrected else "delta-v (m/s)"
        return (COST, cost), (CHANCE, "lowest probability (-)")

    @cached_property
    def free(self) -> tuple[str, ...]:
        """Entries in which cases differ; only the first of entries that change together."""
        found: list[str] = []
        for entry in self.entries:
            if entry == NAME or self.table[entry].nunique() < 2:
                continue
            if not any(self._follows(entry, other) for other in found):
                found.append(entry)
        return tuple(found)

    @cached_property
    def varies(self) -> list[str]:
        """Entries with numbers, or the epoch, in which cases differ."""
        kinds = self.table.dtypes
        return [e for e in self.free if e == EPOCH or kinds[e].kind in "if"]

    @property
    def axes(self) -> list[str]:
        """Entries along curves, by curve and by panel, those with more values first.

        The entry along curves has numbers, or is the epoch.
        """
        entries = sorted(self.free, key=lambda entry: -self.table[entry].nunique())
        first = next(entry for entry in entries if entry in self.varies)
        return [first, *(entry for entry in entries if entry != first)][:AXES_DRAWN]

    @cached_property
    def by_site(self) -> CampaignResults:
        """One case per site: the cheapest feasible case, else the first of those that came furthest."""
        good = np.array(self.ends) == FEASIBLE
        columns = {
            "rank": [ENDS.index(end) for end in self.ends],
            "cost": self.table[COST].where(good),
        }
        rows = self.table.assign(**columns).sort_values(["rank", "cost", "case"])
        kept = rows.drop_duplicates([LATITUDE, LONGITUDE])["case"]
        return replace(self, table=self.table[self.table["case"].isin(kept)])

    @property
    def overlaid(self) -> bool:
        """Whether several cases share a place in the pictures, which show the cheapest."""
        if self.is_map:
            return len(self.by_site.table) < len(self.table)
        return bool(self.varies) and len(self.free) > AXES_DRAWN

    def scatters(self, entry: str) -> bool:
        """Whether other entries vary irregularly along this one, as with several random entries."""
        along = self.table.sort_values(entry)
        return any(
            not (along[other].is_monotonic_increasing or along[other].is_monotonic_decreasing)
            for other in self.entries
            if other not in self.free
            and along[other].dtype.kind in "if"
            and self._follows(other, entry)
        )

    def _follows(self, entry: str, other: str) -> bool:
        return int(self.table.groupby(other)[entry].nunique().max()) == 1

    def counts(self) -> dict[str, int]:
        """Number of cases by their end, without zeros."""
        return {end: self.ends.count(end) for end in ENDS if end in self.ends}


def read_campaign(folder: Path) -> CampaignResults:
    """Read the folder of a campaign, finished or not.

    Raises:
        InputError: if it holds no campaign, or the extra [campaign] is missing.
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


def in_words(value: Any) -> str:
    """A value of an entry as a legend shows it; an epoch to the minute."""
    return value[:16] if isinstance(value, str) else digits(value, 6)


def label(entry: str) -> str:
    """An entry with its unit in brackets, without its section: `radius min (m)`."""
    key = entry.rpartition(".")[2]
    if found := UNIT.fullmatch(key):
        return f"{found[1].replace('_', ' ')} ({WRITTEN.get(found[2], found[2])})"
    return NAMED.get(key, f"{key.replace('_', ' ')} (-)")


def remarks(results: CampaignResults) -> list[str]:
    """Remarks on what is required, how cases ended, what feasible ones cost, and why others failed."""
    counts = ", ".join(f"{count:,} {end}" for end, count in results.counts().items())
    found = [f"Ends: {counts}."]
    if not {"risk.p_chance", "risk.scope"} & {*results.entries}:
        found.append(f"Required: {required_in_words(results.base)}.")
    table, good = results.table, results.ending(FEASIBLE)
    if len(good):
        low, middle, high = np.percentile(good[COST], (0, 50, 100))
        cost = results.measures[0][1].capitalize()
        found.append(
            f"{cost}: least {low:.4f}, median {middle:.4f}, most {high:.4f}. Lowest probability of a "
            f"joint constraint: {good[CHANCE].min():.3f} to {good[CHANCE].max():.3f}."
        )
    doubted = results.ending(NOT_VERIFIED)
    found += _reasons("Broken most", table.get("binds"))
    refuted = doubted["verdict"] != VERIFIED
    found += _reasons("Not borne out", doubted["verdict"][refuted])
    for column in SHORTFALLS:
        found += _reasons("Not borne out", doubted[~refuted].get(column))
    for end in (NO_MISSION, NO_ANSWER):
        found += _reasons(end.capitalize(), results.ending(end).get("message"))
    found += _reasons("Warned", table.get("warnings"))
    if results.overlaid:
        found.append("Charts show the cheapest of the cases that share a place; the table has all.")
    return found


def _reasons(what: str, column: Any) -> Iterator[str]:
    """The most frequent values of a column, if there are any."""
    counts = {} if column is None else column.value_counts().to_dict()
    if counts:
        most = list(counts.items())[:COMMONEST]
        named = ", ".join(f"{_short(name)} ({count:,})" for name, count in most)
        yield f"{what}: {named}."


def _short(reason: str) -> str:
    line = " ".join(reason.removeprefix("not verified: ").split())
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 3]}..."
