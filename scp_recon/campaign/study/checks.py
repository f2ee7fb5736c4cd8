"""What is refused of a study before any work, in one message."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from math import prod
from pathlib import Path
from typing import NoReturn

import numpy as np

from scp_recon.campaign.study.axes import Row
from scp_recon.campaign.study.changes import changed
from scp_recon.campaign.study.unmeant import overlap
from scp_recon.errors import InputError
from scp_recon.scenario.schema import Scenario

ROWS_MAX = 1_000_000
"""Most rows of one axis."""
CHECKED = 100
"""Rows of an axis whose scenarios are made before the work, spread evenly from first to last."""
SHOWN = 5
CERTIFIED = "exact"


def check_do(do: str, base: Scenario) -> None:
    """What is to be done can be done with the base.

    Raises:
        InputError: if not.
    """
    home = base.boundary.home
    if base.in_flight is not None:
        raise InputError("campaign.base", "a flight under way", "must be a whole flight")
    if do == "design" and home is None:
        raise InputError(
            "campaign.do", "'design' of a base without boundary.home", "must have a home orbit"
        )
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


def check_count(counts: list[int], ask_from: int, *, yes: bool) -> None:
    """There are no more cases than are meant; counted, not made.

    Raises:
        InputError: if there are.
    """
    cases = prod(counts)
    product = " x ".join(f"{count:,}" for count in counts)
    if cases > ask_from and not yes:
        raise InputError(
            "axis",
            f"{cases:,} cases ({product})",
            f"more than {ask_from:,} need --yes, if they are meant",
        )
    for number, count in enumerate(counts, start=1):
        if count > ROWS_MAX:
            raise InputError(f"axis {number}", f"{count:,} rows", f"must have at most {ROWS_MAX:,}")


def check_axes(
    base: Scenario,
    folder: Path,
    axes: Sequence[list[Row]],
    random: Sequence[bool],
    unmeant: Iterable[InputError] = (),
) -> None:
    """No entry is on two axes, and every value is one that its entry may have, as far as is looked.

    Args:
        base: that the axes change.
        folder: to which files are relative that they name.
        axes: their rows.
        random: whether an axis is drawn: rows beyond the bounds are refused cases, unless all are.
        unmeant: what else is wrong, for the same message.

    Raises:
        InputError: one message of what is wrong.
    """
    wrong = [*unmeant, *_twice(axes)]
    first = {entry: value for rows in axes for entry, value in rows[0].items()}
    for number, rows in enumerate(axes, start=1):
        looked = sorted({round(place) for place in np.linspace(0, len(rows) - 1, CHECKED)})
        refused: list[InputError] = []
        for place in looked:
            try:
                _check_row(base, folder, rows[place], first)
            except InputError as error:
                where = f"axis {number}, row {place + 1}: {error.entry}"
                refused.append(InputError(where, error.given, error.allowed))
        if not random[number - 1] or len(refused) == len(looked):
            wrong += refused
    if not wrong and not any(random):
        _check_together(base, folder, axes, first)
    if wrong:
        refuse(wrong)


def _twice(axes: Sequence[list[Row]]) -> Iterator[InputError]:
    """Entries that are on two axes, by themselves or as part of a table."""
    seen: list[tuple[str, int]] = []
    for number, rows in enumerate(axes, start=1):
        for entry in rows[0]:
            for other, owner in seen:
                if owner != number and overlap(entry, other):
                    given = f"on axis {owner} and axis {number}"
                    yield InputError(max(other, entry, key=len), given, "must be on one axis")
            seen.append((entry, number))


def _check_together(base: Scenario, folder: Path, axes: Sequence[list[Row]], first: Row) -> None:
    """The first case or the last is a scenario, although each axis by itself is.

    Raises:
        InputError: of the first, if neither is.
    """
    last = {entry: value for rows in axes for entry, value in rows[-1].items()}
    try:
        changed(base, first, folder)
    except InputError as error:
        try:
            changed(base, last, folder)
        except InputError:
            raise InputError(
                f"all axes together: {error.entry}", error.given, error.allowed
            ) from None


def _check_row(base: Scenario, folder: Path, row: Row, first: Row) -> None:
    """A row is a scenario's, alone or else beside the first rows of the other axes."""
    try:
        changed(base, row, folder)
    except InputError:
        try:
            changed(base, {**first, **row}, folder)
        except InputError:
            pass
        else:
            return
        raise


def refuse(wrong: Sequence[InputError]) -> NoReturn:
    """All in one message.

    Raises:
        InputError: always.
    """
    first, *others = wrong
    lines = [first.allowed, *map(str, others[: SHOWN - 1])]
    if len(wrong) > SHOWN:
        lines.append(f"... and {len(wrong) - SHOWN} more")
    raise InputError(first.entry, first.given, "\n".join(lines))
