"""What a table is: cells with a text and the number behind it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Cell:
    """A text, and the number behind it."""

    text: str
    value: float | None = None


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        key: by which it is found.
        title: what it shows.
        heading: of the columns, with units.
        rows: as many cells each; the first names the row.
        note: below it.
    """

    key: str
    title: str
    heading: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""


Given = Cell | str | float | int | None
Row = list[Given]


def cell(given: str | float | int | None, form: str = ".6g") -> Cell:
    """Of a figure in a form, or of a text; empty of nothing."""
    if given is None:
        return Cell("")
    if isinstance(given, str):
        return Cell(given)
    return Cell(format(given, form), float(given))


def table(
    key: str,
    title: str,
    heading: Sequence[str],
    rows: Iterable[Sequence[Given]],
    note: str = "",
) -> Table:
    """Of rows of cells, figures and texts."""
    cells = tuple(tuple(c if isinstance(c, Cell) else cell(c) for c in row) for row in rows)
    return Table(key, title, tuple(heading), cells, note)
