"""The one look of the terminal's tables: no lines, names to the left, figures to the right."""

from __future__ import annotations

from rich.console import JustifyMethod
from rich.table import Table


def plain_table(*headings: str, names: int = 1, no_wrap: bool = False) -> Table:
    """A table without rows.

    Args:
        headings: of its columns.
        names: how many columns, the first ones, hold names.
        no_wrap: whether cells stay on one line where the terminal is narrow.
    """
    table = Table(box=None, header_style="bold", pad_edge=False)
    for number, heading in enumerate(headings):
        side: JustifyMethod = "left" if number < names else "right"
        table.add_column(heading, justify=side, no_wrap=no_wrap)
    return table
