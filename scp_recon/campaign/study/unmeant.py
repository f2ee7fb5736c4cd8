"""What a study says that no case would do: refused, since nobody asks for it on purpose."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from numbers import Real
from typing import Any

from scp_recon.campaign.study.axes import LATITUDE, LONGITUDE, Row
from scp_recon.errors import InputError, shortened

NAME = "site.name"
DESIGN, FLY = "design", "fly"


def unmeant(
    do: str, given: Mapping[str, Any], axes: Sequence[list[Row]], windows: Sequence[bool]
) -> Iterator[InputError]:
    """All that is.

    Args:
        do: what is done.
        given: the table `[campaign]` as it is written.
        axes: rows of each axis.
        windows: whether an axis is of lighting windows.
    """
    yield from unused(do, given, axes)
    yield from replaced(given.get("overrides", {}), axes)
    yield from doubled(axes)
    if True in windows:
        yield from elsewhere(windows.index(True), axes)


def unused(do: str, given: Mapping[str, Any], axes: Sequence[list[Row]]) -> Iterator[InputError]:
    """What belongs to something else than what is done."""
    if do != FLY and "samples" in given:
        yield InputError(
            "campaign.samples", f"{given['samples']} with do = '{do}'", "needs do = 'fly'"
        )
    if do == DESIGN:
        return
    entries = [("campaign.overrides", entry) for entry in leaves(given.get("overrides", {}))]
    entries += [
        (f"axis {number}", entry)
        for number, rows in enumerate(axes, start=1)
        for entry in leaves(rows[0])
    ]
    for where, entry in entries:
        if overlap(entry, DESIGN):
            yield InputError(f"{where}: {entry}", f"with do = '{do}'", "needs do = 'design'")


def replaced(overrides: Mapping[str, Any], axes: Sequence[list[Row]]) -> Iterator[InputError]:
    """Overrides that every case replaces, since an axis has the same entry."""
    for number, rows in enumerate(axes, start=1):
        for entry in leaves(rows[0]):
            for other in leaves(overrides):
                if overlap(entry, other):
                    given = f"also on axis {number}, which replaces it in every case"
                    yield InputError(f"campaign.overrides: {other}", given, "must be in one place")


def doubled(axes: Sequence[list[Row]]) -> Iterator[InputError]:
    """The first row of each axis that is there twice."""
    for number, rows in enumerate(axes, start=1):
        seen: dict[Hashable, int] = {}
        for place, row in enumerate(rows, start=1):
            first = seen.setdefault(_same(row), place)
            if first != place:
                site = LONGITUDE in row
                yield InputError(
                    f"axis {number}, row {place}",
                    f"{shortened(row)}, the {'site' if site else 'value'} of row {first} again",
                    "must be there once"
                    + "; 0 and 360 deg are one meridian, and a pole is one site" * site,
                )
                break


def elsewhere(windowed: int, axes: Sequence[list[Row]]) -> Iterator[InputError]:
    """Sites beside the lighting windows of an axis, which are those of the base's own site."""
    for number, rows in enumerate(axes, start=1):
        for entry in leaves(rows[0]):
            if overlap(entry, "site") and entry != NAME:
                yield InputError(
                    f"axis {windowed + 1}.windows",
                    f"beside {entry} on axis {number}",
                    "are windows of the base's site: needs a study for each site",
                )
                return


def leaves(changes: Mapping[str, Any], before: str = "") -> Iterator[str]:
    """The dotted entries of values, of those in tables too."""
    for entry, value in changes.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{before}{entry}.")
        else:
            yield f"{before}{entry}"


def overlap(one: str, other: str) -> bool:
    """Whether two entries are the same, or one is a table that holds the other."""
    part, whole = sorted((one, other), key=len, reverse=True)
    return f"{part}.".startswith(f"{whole}.")


def _same(row: Row) -> Hashable:
    """Equal for rows that ask for the same."""
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
