"""Read a study: a base scenario, the axes along which it changes, and what to do with each case."""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from scp_recon.campaigns.axes import (
    Axis,
    Cases,
    Changes,
    changed,
    layer_of,
    of_campaign,
)
from scp_recon.campaigns.checks import REPLAN, REST, check_axes, check_do, ineffective
from scp_recon.errors import InputError, shortened
from scp_recon.files import read_text
from scp_recon.scenario.fields import Section
from scp_recon.scenario.load import base_names, load_scenario
from scp_recon.scenario.messages import input_error
from scp_recon.scenario.schema import Scenario

BYTES_MAX = 50_000_000
VERSION = 2
"""Version of what is done with a case: raise it when results of the same study change."""
ASK_FROM = 100_000
"""Number of cases above which a caller has to pass `yes`."""

Do = Literal["plan", "design", "certify", "replan", "fly", "simulate"]


class Campaign(Section):
    """The table `[campaign]`."""

    base: Annotated[str, Field(min_length=1)] = "recon_b"
    """Packaged scenario, or a file relative to the study."""
    do: Do = "plan"
    """plan; design a pass from the home orbit; certify an exact plan; plan the rest from the planned
    state in flight again; fly a plan often; simulate it."""
    at_s: Annotated[float, Field(ge=0, le=1e7)] = 0.0
    """When the rest is planned with do = "replan", s past the epoch."""
    free_times: bool = False
    """Whether burns of the rest may move, as with `replan --free-times`."""
    policy: Literal["open", "replan"] | None = None
    """What burns are flown: as planned, or planned again before each (default: the plan's gains)."""
    samples: Annotated[int, Field(ge=20, le=10_000_000)] = 10_000
    """Flights of a case with do = "fly"."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of all draws: a case's own follows from it and the case's number."""
    limit_s: Annotated[float, Field(ge=0.1, le=1e6)] = 600.0
    """Wall time after which a case is ended, s."""
    memory_mb: Annotated[int, Field(ge=16, le=1_000_000)] = 4096
    """Memory that a case may take beyond the program's own, megabytes."""
    keep_solutions: bool = False
    """Whether each case's solution.json is kept."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """Entries of the base that differ in all cases."""


class Tables(Section):
    """A study file."""

    campaign: Campaign = Campaign()
    axis: tuple[Axis, ...] = ()


@dataclass(frozen=True)
class Study:
    """A base scenario, the axes along which it changes, and what is done with each case.

    Files that the study names are relative to its folder; `tables` are those of the file.
    """

    campaign: Campaign
    base: Scenario
    axes: tuple[list[Changes], ...]
    folder: Path
    tables: Mapping[str, Any]

    @classmethod
    def validated(
        cls, tables: Mapping[str, Any], folder: Path = Path(), *, yes: bool = False
    ) -> Study:
        """Make a study from nested tables, as in a file; `yes` allows more than `ASK_FROM` cases.

        Raises:
            InputError: one message of everything that is wrong.
        """
        found = _read(tables)
        campaign, kinds = found.campaign, found.axis
        name = campaign.base
        base = load_scenario(name if name in base_names() else folder / name)
        base = _overridden(base, campaign.overrides, kinds, folder)
        check_do(campaign.do, base)
        rows = tuple(axis.rows(base, (campaign.seed, place)) for place, axis in enumerate(kinds))
        own = campaign.model_dump(exclude_unset=True)
        for row in (row for each in rows for row in each if of_campaign(row)):
            if unknown := of_campaign(row).keys() - REST:
                named = f"campaign.{min(unknown)}"
                raise InputError(
                    named, "an axis", f"must be one of {', '.join(REST)}, or given once"
                )
            _read({"campaign": own | of_campaign(row)})
        study = cls(campaign, base, rows, folder, tables)
        if len(study.cases) > ASK_FROM and not yes:
            product = " x ".join(f"{len(each):,}" for each in rows)
            given = f"{len(study.cases):,} cases ({product})"
            raise InputError("axis", given, f"more than {ASK_FROM:,} need --yes")
        random, windows = ([getattr(axis, key) for axis in kinds] for key in ("draws", "windows"))
        unfelt = ineffective(base, campaign.do, own, rows, beside_windows=any(windows))
        check_axes(base, folder, rows, random, unfelt, replanned=campaign.policy == "replan")
        return study

    @property
    def cases(self) -> Cases:
        """All cases, each made when it is taken."""
        return Cases(self.axes, self.campaign.seed)

    @cached_property
    def entries(self) -> tuple[str, ...]:
        """Entries that the axes change, in their order."""
        return tuple(entry for rows in self.axes for entry in rows[0])

    @cached_property
    def kinds(self) -> dict[str, type]:
        """Kinds of the entries' columns."""
        return {
            entry: kind_of(row[entry] for row in rows) for rows in self.axes for entry in rows[0]
        }

    @cached_property
    def hash(self) -> str:
        """SHA-256 of everything that the rows depend on: base, axes, limits, named files, `VERSION`."""
        excluded = {"base", "overrides"} | set(REST if self.campaign.do != REPLAN else ())
        parts = {
            "campaign": self.campaign.model_dump(mode="json", exclude=excluded),
            "base": self.base.model_dump(mode="json"),
            "axes": self.axes,
            "files": dict(_digests(self)),
            "version": VERSION,
        }
        text = json.dumps(parts, sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()


def read_study(given: str | Path | Mapping[str, Any], *, yes: bool = False) -> Study:
    """Read a study from its file or its tables.

    Raises:
        InputError: one message of everything that is wrong.
    """
    if isinstance(given, Mapping):
        return Study.validated(given, yes=yes)
    if not isinstance(given, str | Path):
        raise InputError("study", shortened(given), "must be a file, or tables as in one")
    path = Path(given)
    text = read_text(path, f"study {path}", "study file in TOML", BYTES_MAX)
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"study {path}", f"no TOML ({str(error)[:120]})", "must be a study file"
        ) from None
    return Study.validated(tables, path.parent, yes=yes)


def _overridden(base: Scenario, overrides: Changes, axes: Sequence[Axis], folder: Path) -> Scenario:
    """The base with overrides; entries that only an axis gives come from its first row."""
    try:
        return changed(base, overrides, folder)
    except InputError as error:
        named = [axis for axis in axes if axis.values or axis.grid]
        first = {entry: value for axis in named for entry, value in axis.rows(base, ())[0].items()}
        with suppress(InputError):
            return changed(base, {**first, **overrides}, folder)
        raise error


def _read(tables: Any) -> Tables:
    """Tables as a model; axes count from 1 in messages."""
    try:
        return Tables.model_validate_json(json.dumps(tables, default=str))
    except ValidationError as error:
        found = input_error(error, Tables)
        entry = "study" if found.entry == "scenario" else found.entry
        entry, allowed = (
            re.sub(r"\baxis\.(\d+)", lambda match: f"axis {int(match[1]) + 1}", text)
            for text in (entry, found.allowed)
        )
        raise InputError(entry, found.given, allowed) from None
    except (ValueError, RecursionError) as error:
        raise InputError("study", "values that cannot be read", str(error)[:120]) from None


def _digests(study: Study) -> Iterator[tuple[str, str]]:
    """SHA-256 of the files that the scenarios name, by name."""
    named: set[str] = set()
    layers = [study.base.model_dump(mode="json", exclude_none=True)]
    layers += [layer_of(row, study.folder) for rows in study.axes for row in rows]
    for tables in layers:
        named |= set(files_in(tables))
    for name in sorted(name for name in named if isinstance(name, str)):
        path = Path(name)
        if path.is_file():
            with path.open("rb") as file:
                yield name, hashlib.file_digest(file, "sha256").hexdigest()


def files_in(table: Any) -> Iterator[Any]:
    """Values of all entries that name files, nested ones included."""
    for key, value in table.items() if isinstance(table, dict) else ():
        if key.endswith(("_file", "_files")):
            yield from value if isinstance(value, list) else [value]
        else:
            yield from files_in(value)


def kind_of(values: Iterable[Any]) -> type:
    """Kind of a column for these values; text if they are of several kinds."""
    known = list(values)
    kinds = {type(value) for value in known}
    if kinds == {bool}:
        return bool
    if kinds == {int} and all(abs(value) < 2**63 for value in known):
        return int
    return float if kinds <= {int, float} else str
