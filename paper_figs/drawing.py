"""What all figures share: their style, how they are saved, and the command line of one alone."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from matplotlib import style
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from paper_figs.inputs import Runs, read_runs
from scp_recon.errors import InputError

STYLE = Path(__file__).with_name("style.mplstyle")

WIDTH_IN = 7.0
"""Of a figure across the page."""

LEGEND_PT = 8.0
"""Size of the words in legends."""

ABOVE: dict[str, Any] = {
    "loc": "lower left",
    "bbox_to_anchor": (0.0, 1.0),
    "borderaxespad": 0.1,
    "fontsize": LEGEND_PT,
}
"""Where a legend hides nothing."""

BANDS = ((2.28, 97.72, "0.85", "2 sigma"), (15.87, 84.13, "0.65", "1 sigma"))
"""Percentiles between which a normal variable lies with 95.4 % and 68.3 % probability."""

HALO = [withStroke(linewidth=2.5, foreground="w")]
"""Around text that lies over lines."""

PICTURES = (".png", ".pdf")

Read = TypeVar("Read")
"""What a figure is drawn from."""


def save(figure: Figure, path: Path) -> Path:
    """Write a figure in the format of the path's ending, the same bytes every time."""
    metadata: dict[str, Any] = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}.get(
        path.suffix, {}
    )
    with style.context(STYLE):
        figure.savefig(path, metadata=metadata)
    return path


def command(
    make: Callable[[Runs], Figure | str], about: str | None, arguments: Sequence[str] | None = None
) -> int:
    """The command line of a module: one figure or table from a folder of runs to a file."""
    return command_from(read_runs, make, about, arguments)


def command_from(
    read: Callable[[Path], Read],
    make: Callable[[Read], Figure | str],
    about: str | None,
    arguments: Sequence[str] | None = None,
) -> int:
    """The command line of a module that is drawn from what `read` finds in a folder or file."""
    p = argparse.ArgumentParser(description=about)
    p.add_argument("runs", type=Path, metavar="RUNS", help="what experiments wrote")
    p.add_argument("file", type=Path, metavar="FILE", help="e.g. figure.png, figure.pdf, table.md")
    options = p.parse_args(arguments)
    try:
        made = make(read(options.runs))
        if isinstance(made, Figure):
            save(made, options.file)
        else:
            options.file.write_text(made, encoding="utf-8")
    except (InputError, OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
