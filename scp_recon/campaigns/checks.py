"""Refuse a study with errors or ineffective entries, before any work and in one message.

An *ineffective* axis or entry changes no result. It is an error, because no user intends it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations, islice, product
from pathlib import Path
from typing import Any

import numpy as np

from scp_recon.campaigns.axes import NAME, Changes, changed
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
