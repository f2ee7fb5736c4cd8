"""Refuse a study with errors or ineffective entries, before any work and in one message.

An *ineffective* axis or entry changes no result. It is an error, because no user intends it.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import combinations, product
from numbers import Real
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from scp_recon.campaigns.axes import LATITUDE, LONGITUDE, NAME, Changes, changed
from scp_recon.errors import InputError, shortened
from scp_recon.mission.feedback import check_feedback
from scp_recon.monte_carlo.closed_loop import cut_offs_s
from scp_recon.scenario.schema import Scenario

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
    random: Sequence[bool],
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
    _refusal = partial(_refusal_of, base, folder, replanned)
    wrong = list(ineffective)
    first = {entry: value for rows in axes for entry, value in rows[0].items()}
    for number, rows in enumerate(axes, start=1):
        looked = sorted({round(place) for place in np.linspace(0, len(rows) - 1, CHECKED)})
        refused: list[InputError] = []
        for place in looked:
            error = _refusal(rows[place])
            # What it makes of the base alone may be mended by the other axes.
            if error and _refusal({**first, **rows[place]}):
                where = f"axis {number}, row {place + 1}: {error.entry}"
                refused.append(InputError(where, error.given, error.allowed))
        if not random[number - 1] or len(refused) == len(looked):
            wrong += refused
    if not wrong and not any(random) and (error := _refusal(first)):
        last = {entry: value for rows in axes for entry, value in rows[-1].items()}
        if _refusal(last):
            together = f"all axes together: {error.entry}"
            raise InputError(together, error.given, error.allowed)
    if wrong:
        refuse(wrong)


def _refusal_of(
    base: Scenario, folder: Path, replanned: bool, changes: Changes
) -> InputError | None:
    """The error that changes cause in a scenario, or in its policy; None if they are valid."""
    try:
        scenario = changed(base, changes, folder)
        check_feedback(scenario)
        if replanned:
            cut_offs_s(scenario)
    except InputError as error:
        return error
    return None


def refuse(wrong: Sequence[InputError]) -> NoReturn:
    """Raise all errors as one message.

    Raises:
        InputError: always.
    """
    first, *others = wrong
    lines = [first.allowed, *map(str, others[: SHOWN - 1])]
    if len(wrong) > SHOWN:
        lines.append(f"... and {len(wrong) - SHOWN} more")
    raise InputError(first.entry, first.given, "\n".join(lines))


def ineffective(
    base: Scenario,
    do: str,
    given: Mapping[str, Any],
    axes: Sequence[list[Changes]],
    windows: Sequence[bool],
) -> Iterator[InputError]:
    """Find entries and axes of a study without effect, or with a misleading one.

    `given` is the table `[campaign]` as written; `windows` says which axes are of lighting windows.
    """
    yield from unused(do, given, axes)
    yield from unfelt(base, given, axes)
    yield from twice(given.get("overrides", {}), axes)
    yield from doubled(axes)
    if True in windows:
        yield from elsewhere(windows.index(True), axes)


def unused(
    do: str, given: Mapping[str, Any], axes: Sequence[list[Changes]]
) -> Iterator[InputError]:
    """Find entries that belong to another `do`."""
    if do != FLY and "samples" in given:
        yield InputError(
            "campaign.samples", f"{given['samples']} with do = '{do}'", "needs do = 'fly'"
        )
    if do not in FLOWN and "policy" in given:
        yield InputError(
            "campaign.policy",
            f"{given['policy']!r} with do = '{do}'",
            f"needs do = {FLOWN[0]!r} or {FLOWN[1]!r}",
        )
    places = _places(given.get("overrides", {}), axes)
    every = {f"campaign.{key}" for key in given} | {one for _, found in places for one in found}
    for entry in sorted(every & {f"campaign.{key}" for key in REST}):
        if do != REPLAN:
            yield InputError(entry, f"with do = '{do}'", "needs do = 'replan'")
    if do == DESIGN:
        return
    for where, entries in places:
        for entry in entries:
            if overlap(entry, DESIGN):
                yield InputError(f"{where}: {entry}", f"with do = '{do}'", "needs do = 'design'")


def unfelt(
    base: Scenario, given: Mapping[str, Any], axes: Sequence[list[Changes]]
) -> Iterator[InputError]:
    """Find axes that act only on feedback or replanning, in a study without either."""
    rows = [row for rows in axes for row in rows]
    kinds = {base.policy.kind, *(row.get("policy.kind") for row in rows)}
    tables = [row["policy"] for row in rows if isinstance(row.get("policy"), Mapping)]
    if "feedback" in kinds | {table.get("kind") for table in tables}:
        return
    replanned = given.get("policy") == "replan"
    for where, entries in _places({}, axes):
        for entry in entries:
            if entry == "policy.cost" or (not replanned and overlap(entry, "navigation")):
                needed = "needs policy.kind = 'feedback'"
                yield InputError(f"{where}: {entry}", "with policy.kind = 'open'", needed)


def twice(overrides: Mapping[str, Any], axes: Sequence[list[Changes]]) -> Iterator[InputError]:
    """Find entries that are set in two places, among overrides and axes, alone or in a table."""
    for (one, entries), (other, others) in combinations(_places(overrides, axes), 2):
        for entry, second in product(entries, others):
            if overlap(entry, second):
                longer = max(entry, second, key=len)
                yield InputError(longer, f"{one} and {other}", "must be in one place")


def _places(
    overrides: Mapping[str, Any], axes: Sequence[list[Changes]]
) -> list[tuple[str, list[str]]]:
    """Entries by the place that sets them."""
    named = [(f"axis {number}", rows[0]) for number, rows in enumerate(axes, start=1)]
    return [(name, list(leaves(row))) for name, row in [("campaign.overrides", overrides), *named]]


def doubled(axes: Sequence[list[Changes]]) -> Iterator[InputError]:
    """Find the first row of each axis that repeats an earlier one."""
    for number, rows in enumerate(axes, start=1):
        seen: dict[Hashable, int] = {}
        for place, row in enumerate(rows, start=1):
            first = seen.setdefault(_same(row), place)
            if first != place:
                site = LONGITUDE in row
                yield InputError(
                    f"axis {number}, row {place}",
                    f"{shortened(row)}, the {'site' if site else 'value'} of row {first} again",
                    "must be given once"
                    + "; 0 and 360 deg are one meridian, and a pole is one site" * site,
                )
                break


def elsewhere(windowed: int, axes: Sequence[list[Changes]]) -> Iterator[InputError]:
    """Find an axis of sites beside an axis of lighting windows, which belong to the base's site."""
    for where, entries in _places({}, axes):
        for entry in entries:
            if overlap(entry, "site") and entry != NAME:
                yield InputError(
                    f"axis {windowed + 1}.windows",
                    f"beside {entry} on {where}",
                    "are windows of the base's site: needs a study for each site",
                )
                return


def leaves(changes: Mapping[str, Any], before: str = "") -> Iterator[str]:
    """Values by dotted entry, those in tables included."""
    for entry, value in changes.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{before}{entry}.")
        else:
            yield f"{before}{entry}"


def overlap(one: str, other: str) -> bool:
    """Whether two entries are the same, or one is in the other."""
    part, whole = sorted((one, other), key=len, reverse=True)
    return f"{part}.".startswith(f"{whole}.")


def _same(row: Changes) -> Hashable:
    """A key that is equal for equivalent rows."""
    latitude, longitude = row.get(LATITUDE), row.get(LONGITUDE)
    if isinstance(latitude, Real) and isinstance(longitude, Real):
        row = {**row, LONGITUDE: 0.0 if abs(latitude) == 90.0 else longitude % 360.0}
    return _frozen(row)


def _frozen(value: Any) -> Hashable:
    if isinstance(value, Mapping):
        return tuple(sorted((key, _frozen(each)) for key, each in value.items()))
    if isinstance(value, list | tuple):
        return tuple(map(_frozen, value))
    return ("bool", value) if isinstance(value, bool) else value
