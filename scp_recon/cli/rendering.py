"""Render tables, warnings and verdicts for the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from scp_recon.results.table import Table
from scp_recon.scenario.fields import ScenarioWarning

STYLES = {"bad": "red", "doubtful": "yellow"}
"""Rich's styles of the cells' by name."""


def terminal(table: Table, *, narrow: bool = False) -> RichTable:
    """A table as the terminal shows it, without its title and note.

    Args:
        table: what to show.
        narrow: whether units stand below their headings and cells stay on one line, for a table that
            would not fit otherwise.
    """
    shown = RichTable(box=None, header_style="bold", pad_edge=False)
    gap = "\n" if narrow else " "
    for number, (column, side) in enumerate(zip(table.columns, table.sides, strict=True)):
        unit = column.shown_unit or column.unit
        heading = column.heading if unit in ("", "1") else f"{column.heading}{gap}{unit}"
        shown.add_column(Text(heading), justify=side, no_wrap=narrow or not number, overflow="fold")
    for row in table.rows:
        shown.add_row(*(Text(cell.text, STYLES.get(cell.style, "")) for cell in row))
    return shown


def fitting(console: Console, table: Table, heading: str) -> RichTable:
    """A table for the terminal, without one of its columns where the lines would be too long."""
    shown = terminal(table)
    needed = console.measure(shown, options=console.options.update(width=1000)).maximum
    return shown if needed <= console.width else terminal(table.without(heading))


def show_warnings(
    console: Console, warnings: Iterable[ScenarioWarning | str], of: str = ""
) -> None:
    """One line each, however long; each once.

    Args:
        console: to print to.
        warnings: warnings of one plan, or of its file and of its mission; or their words.
        of: name of the plan, if there are several.
    """
    head = f"warning of {of}" if of else "warning"
    for warning in dict.fromkeys(warnings):
        console.print(
            f"{head}: {warning}", style="yellow", markup=False, highlight=False, soft_wrap=True
        )


def show_verdict(
    console: Console, word: str, failed: Sequence[str], note: str | None = None
) -> None:
    """Show the verdict.

    Args:
        console: to print to.
        word: the good verdict, such as "verified".
        failed: names of failed checks, or sentences with the required values; empty for a good
            verdict.
        note: that the verdict has to be read with.
    """
    if failed:
        text = Text(f"not {word}", style="bold red") + Text(
            f": {', '.join(failed)}", style="default"
        )
    else:
        text = Text(word, style="bold green")
    if note:
        text += Text(f"; {note}", style="yellow")
    console.print(text, soft_wrap=True)


def time_left(done: float, total: float, took_s: float) -> str:
    """Time that is left in words, where each piece of work takes as long as those done on average."""
    if not 0 < done < total:
        return ""
    left = (total - done) * took_s / done
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if left >= 1.5 * size:
            return f"about {left / size:.2g} {unit} left"
    return f"about {max(left, 1.0):.0f} s left"
