"""Build a table once and render it for the terminal, a page, Markdown, CSV and JSON.

A cell has a text for people and a value for programs. Terminal, page and Markdown show the texts;
CSV and JSON hold the values to the last digit. The terminal's renderer is `cli/views.py`.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from html import escape
from io import StringIO
from math import isfinite
from typing import Any, Literal

import numpy as np

from scp_recon.display import digits

Value = str | int | float | bool | None
SCALES = {("m/s", "mm/s"): 1e3}
"""Factors from the unit of a column's values to that of its texts."""
UNITS = {shown: unit for unit, shown in SCALES}


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        heading: heading without the unit.
        unit: unit of all values; empty if they have none or each its own.
        form: format specification of figures that are not whole numbers.
        name: name in CSV and JSON; by default made of heading and unit.
        shown_unit: unit of the texts, where people read another than the values have.
    """

    heading: str
    unit: str = ""
    form: str = ".6g"
    name: str = ""
    shown_unit: str = ""

    @classmethod
    def of(cls, text: str) -> Column:
        """A column by its label and form, such as "size (mm/s) +.3f"; values of mm/s are in m/s."""
        found = re.fullmatch(r"(.+?)(?: \(([^()]+)\))?(?: ([+z]*(?:\.\d+)?[defg]))?", text)
        assert found is not None
        heading, shown, form = found.groups(default="")
        unit = UNITS.get(shown, shown)
        return cls(heading, unit, form or ".6g", shown_unit=shown if unit != shown else "")

    @property
    def label(self) -> str:
        """Heading with the unit of the texts in brackets."""
        unit = self.shown_unit or self.unit
        return f"{self.heading} ({unit})" if unit else self.heading

    @property
    def key(self) -> str:
        """Name in CSV and JSON, such as `size_m_s`."""
        return self.name or re.sub(r"\W+", "_", f"{self.heading} {self.unit}".lower()).strip("_")

    def cell(self, value: object, style: str = "") -> Cell:
        """Make a cell of this column from a value, a NumPy scalar or a cell; None is an empty cell.

        Raises:
            TypeError: if it is anything else.
        """
        if isinstance(value, Cell):
            return value
        value = value.item() if isinstance(value, np.generic) else value
        if not isinstance(value, str | int | float | None):
            raise TypeError(f"{type(value).__name__} is no value of a cell")
        if isinstance(value, float):
            number = value * SCALES.get((self.unit, self.shown_unit), 1.0)
            general = re.fullmatch(r"\.(\d+)g", self.form)
            text = digits(number, int(general[1])) if general else format(number, self.form)
            if not text.strip("+-0.e%"):
                text = format(0.0, self.form)  # rounding has no sign
        else:
            text = "" if value is None else str(value)
        return Cell(text, value, style)


def columns(*texts: str) -> list[Column]:
    """Columns, each by `Column.of`."""
    return list(map(Column.of, texts))


@dataclass(frozen=True)
class Cell:
    """A text, the value behind it, and a style by name, such as "bad"; none is plain.

    Attributes:
        text: as it is shown.
        value: as it was computed.
        style: by name.
    """

    text: str
    value: Value = None
    style: str = ""

    @property
    def is_number(self) -> bool:
        """Whether the value is a figure."""
        return isinstance(self.value, int | float) and not isinstance(self.value, bool)


@dataclass(frozen=True)
class Table:
    """A table: rows of cells, the first of which names the row, and a note below.

    A page finds it by its key.

    Attributes:
        title: above it.
        columns: headings, with unit and form.
        rows: of cells.
        key: by which a page finds it.
        note: below it.
    """

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    key: str = ""
    note: str = ""

    @classmethod
    def of(
        cls,
        title: str,
        columns: Iterable[Column | str],
        rows: Iterable[Sequence[object]],
        key: str = "",
        note: str = "",
    ) -> Table:
        """Make a table from rows of values, or of cells where the column's form does not suit.

        A column that is a mere heading has neither unit nor form.
        """
        named = tuple(Column(c) if isinstance(c, str) else c for c in columns)
        cells = (tuple(c.cell(v) for c, v in zip(named, row, strict=True)) for row in rows)
        return cls(title, named, tuple(cells), key, note)

    @property
    def sides(self) -> list[Literal["left", "right"]]:
        """Alignment of each column: right if any cell is a figure, else left."""
        values = [[row[i] for row in self.rows if row[i].text] for i in range(len(self.columns))]
        return [
            "left" if cells and not any(cell.is_number for cell in cells) else "right"
            for cells in values
        ]

    def without(self, *headings: str) -> Table:
        """The table without some columns."""
        kept = [i for i, column in enumerate(self.columns) if column.heading not in headings]
        return replace(
            self,
            columns=tuple(self.columns[i] for i in kept),
            rows=tuple(tuple(row[i] for i in kept) for row in self.rows),
        )

    def with_rows(self, rows: Iterable[Sequence[object]]) -> Table:
        """The table with more rows at the end."""
        more = Table.of(self.title, self.columns, rows)
        return replace(self, rows=self.rows + more.rows)

    def __str__(self) -> str:
        """Plain text, names to the left and figures to the right."""
        lines = [[c.label for c in self.columns], *([c.text for c in row] for row in self.rows)]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        sides = [{"left": str.ljust, "right": str.rjust}[side] for side in self.sides]
        return "\n".join(
            "  ".join(s(t, w) for s, t, w in zip(sides, line, widths, strict=True)).rstrip()
            for line in lines
        )

    def html(self) -> str:
        """HTML: row and column headings as such, figures with their values, the note below."""
        head = "".join(f'<th scope="col">{escape(column.label)}</th>' for column in self.columns)
        body = "\n".join(
            f"<tr>{''.join(_html(cell, number) for number, cell in enumerate(row))}</tr>"
            for row in self.rows
        )
        note = f'\n<p class="note">{escape(self.note)}</p>' if self.note else ""
        return (
            f'<div class="wide" tabindex="0" role="region" aria-label="{escape(self.title)}">\n'
            f'<table data-table="{escape(self.key)}"><thead><tr>{head}</tr></thead>\n'
            f"<tbody>\n{body}\n</tbody></table></div>{note}"
        )

    def markdown(self) -> str:
        """Markdown, with figures to the right; without title and note."""
        lines = [
            [column.label for column in self.columns],
            ["---" if side == "left" else "---:" for side in self.sides],
            *(
                [cell.text.replace("|", "\\|").replace("\n", " ") for cell in row]
                for row in self.rows
            ),
        ]
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)

    def csv(self) -> str:
        """CSV of the values, truth values in lower case."""
        text = StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(column.key for column in self.columns)
        for row in self.rows:
            values = (cell.value for cell in row)
            writer.writerow(str(v).lower() if isinstance(v, bool) else v for v in values)
        return text.getvalue()

    def records(self) -> list[dict[str, Any]]:
        """The values by the columns' keys, as JSON takes them; null for what is not finite."""
        return [
            {
                column.key: None
                if isinstance(cell.value, float) and not isfinite(cell.value)
                else cell.value
                for column, cell in zip(self.columns, row, strict=True)
            }
            for row in self.rows
        ]


def _html(cell: Cell, number: int) -> str:
    if number == 0:
        return f'<th scope="row">{escape(cell.text)}</th>'
    classes = " ".join(filter(None, ("number" if cell.is_number else "", cell.style)))
    given = f' class="{classes}"' if classes else ""
    if cell.is_number:
        given += f' data-value="{cell.value}"'
    return f"<td{given}>{escape(cell.text)}</td>"
