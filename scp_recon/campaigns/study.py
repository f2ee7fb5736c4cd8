"""Read a study, and refuse one with errors or ineffective entries before any work, in one message.

A study is a base scenario, the axes along which it changes, and what to do with each case. An
*ineffective* axis or entry changes no result. It is an error, because no user intends it.
"""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, islice, product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from scp_recon.campaigns.axes import (
    NAME,
    Axis,
    Cases,
    Changes,
    changed,
    layer_of,
    of_campaign,
)
from scp_recon.errors import InputError, shortened
from scp_recon.files import read_text
from scp_recon.mission.feedback import check_feedback
from scp_recon.monte_carlo.closed_loop import cut_offs_s
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
        if entry == "axis":
            raise InputError(entry, found.given, "must be tables [[axis]]") from None
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


CHECKED = 100
"""Rows of an axis whose scenarios are made before the work, spread evenly from first to last."""
SHOWN = 5
CERTIFIED, DESIGN, FLY, REPLAN = "exact", "design", "fly", "replan"
REST = "at_s", "free_times"
"""Entries of `[campaign]` on the rest of a flight, which axes may change as `campaign.at_s`."""
FLOWN = FLY, "simulate"


def check_do(do: str, base: Scenario) -> None:
    """Refuse a base scenario that does not suit the study's `do`.

    Raises:
        InputError: naming the entry of the base, what was given and what is required.
    """
    home = base.boundary.home
    if base.in_flight is not None:
        raise InputError("campaign.base", "a flight under way", "must be a whole flight")
    if do != "design" and home is not None and home.is_free:
        raise InputError(
            "campaign.do",
            f"{do!r} of a base whose boundary.home has free phases, or is flown",
            "must be 'design'",
        )
    if do == "certify" and base.risk.allocation != CERTIFIED:
        raise InputError(
            "campaign.do", "'certify'", 'needs "risk.allocation" = "exact" in campaign.overrides'
        )


def check_axes(
    base: Scenario,
    folder: Path,
    axes: Sequence[list[Changes]],
    random: Sequence[object],
    ineffective: Iterable[InputError] = (),
    *,
    replanned: bool = False,
) -> None:
    """Refuse ineffective entries, and invalid values in up to `CHECKED` of each axis's rows.

    Args:
        base: scenario that the axes change.
        folder: folder of relative file names.
        axes: rows of each axis.
        random: whether each axis is random; invalid rows of a random axis become refused cases,
            unless all rows are invalid.
        ineffective: further errors for the same message.
        replanned: whether burns are planned again in flight, which needs a measurement.

    Raises:
        InputError: one message with all errors.
    """

    def refusal(changes: Changes) -> InputError | None:
        try:
            scenario = changed(base, changes, folder)
            check_feedback(scenario)
            if replanned:
                cut_offs_s(scenario)
        except InputError as error:
            return error
        return None

    wrong = list(ineffective)
    first, last = (
        {entry: value for rows in axes for entry, value in rows[end].items()} for end in (0, -1)
    )
    for number, rows in enumerate(axes, start=1):
        places = sorted({round(place) for place in np.linspace(0, len(rows) - 1, CHECKED)})
        refused: list[InputError] = []
        for place in places:
            error = refusal(rows[place])
            # What it makes of the base alone may be mended by the other axes.
            if error and refusal({**first, **rows[place]}):
                where = f"axis {number}, row {place + 1}: {error.entry}"
                refused.append(InputError(where, error.given, error.allowed))
        if not random[number - 1] or len(refused) == len(places):
            wrong += refused
    if not wrong and not any(random) and (error := refusal(first)) and refusal(last):
        wrong.append(InputError(f"all axes together: {error.entry}", error.given, error.allowed))
    if wrong:
        one, *others = wrong
        lines = [one.allowed, *map(str, others[: SHOWN - 1])]
        lines += [f"... and {len(wrong) - SHOWN} more"] * (len(wrong) > SHOWN)
        raise InputError(one.entry, one.given, "\n".join(lines))


def ineffective(
    base: Scenario,
    do: str,
    given: Mapping[str, Any],
    axes: Sequence[list[Changes]],
    *,
    beside_windows: bool,
) -> Iterator[InputError]:
    """Find entries and axes of a study without effect, or with a misleading one.

    `given` is the table `[campaign]` as written.
    """
    table = {f"campaign.{key}": value for key, value in given.items() if key != "overrides"}
    named = {f"axis {number}": rows[0] for number, rows in enumerate(axes, start=1)}
    places = {"campaign.overrides": given.get("overrides", {}), **named}
    set_by = {where: dict(leaves(row)) for where, row in places.items()}
    kinds = {base.policy.kind, *(own.get("policy.kind") for own in map(dict, _rows(axes)))}
    closed, replanned = "feedback" in kinds, given.get("policy") == "replan"
    # Entries, or tables of them, what makes them act, whether it is there, and what is in its place.
    another, idle = f"with do = {do!r}", "with policy.kind = 'open'"
    rules = [
        ("campaign.samples", "do = 'fly'", do == FLY, another),
        ("campaign.policy", "do = 'fly' or 'simulate'", do in FLOWN, another),
        *((f"campaign.{key}", "do = 'replan'", do == REPLAN, another) for key in REST),
        ("design", "do = 'design'", do == DESIGN, another),
    ]
    of_axes = [
        ("policy.cost", "policy.kind = 'feedback'", closed, idle),
        ("navigation", "policy.kind = 'feedback'", closed or replanned, idle),
        ("site", "a study for each site", not beside_windows, "beside windows of the base's site"),
    ]
    for where, own in {"": table, **set_by}.items():
        for entry, value in own.items():
            for whole, needed, acts, instead in rules + of_axes * (where in named):
                if overlap(entry, whole) and not acts and entry != NAME:
                    place = f"{where}: {entry}" if where else entry
                    yield InputError(place, f"{shortened(value)} {instead}", f"needs {needed}")
    for (one, entries), (other, others) in combinations(set_by.items(), 2):
        for entry, second in product(entries, others):
            if overlap(entry, second):
                longer = max(entry, second, key=len)
                yield InputError(longer, f"{one} and {other}", "must be in one place")
    for number, rows in enumerate(axes, start=1):
        yield from islice(_doubled(f"axis {number}", rows), 1)


def _rows(axes: Sequence[list[Changes]]) -> Iterator[Iterator[tuple[str, Any]]]:
    return (leaves(row) for rows in axes for row in rows)


def _doubled(name: str, rows: Sequence[Changes]) -> Iterator[InputError]:
    """Find rows that repeat earlier ones; numbers are equal by value."""
    seen: dict[str, int] = {}
    for place, row in enumerate(rows, start=1):
        numbers = json.loads(json.dumps(row, default=str), parse_int=float)
        first = seen.setdefault(json.dumps(numbers, sort_keys=True), place)
        if first != place:
            given = f"{shortened(row)}, the value of row {first} again"
            yield InputError(f"{name}, row {place}", given, "must be given once")


def leaves(changes: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted entries with their values, those in tables included."""
    for entry, value in changes.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{before}{entry}.")
        else:
            yield f"{before}{entry}", value


def overlap(one: str, other: str) -> bool:
    """Whether two entries are the same, or one is in the other."""
    part, whole = sorted((one, other), key=len, reverse=True)
    return f"{part}.".startswith(f"{whole}.")
