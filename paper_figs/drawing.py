"""What all figures share: their style, how they are saved, and the command line of one alone."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, TypeVar

from matplotlib import style
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from rich.console import Console

from paper_figs.inputs import Runs, read_runs
from scp_recon.cli.command import Answer, parse, run_command, show_written
from scp_recon.errors import InputError
from scp_recon.files import unwritable, write_atomically
from scp_recon.spacecraft.record import Record

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


def plain(text: str) -> str:
    """A name as it is, in which Matplotlib finds no formula."""
    return text.replace("$", r"\$")


def plan_hash_of(source: object) -> str | None:
    """Of the one plan of which a figure is drawn from this; none where that is not known."""
    match source:
        case Runs(plan=flown):
            return flown.solution.plan_hash
        case (Record() as record) | [Record() as record, *_]:
            return record.plan_hash
    return None


def save(
    figure: Figure, path: Path, dpi: float | None = None, plan_hash: str | None = None
) -> Path:
    """Write a figure in the format of the path's ending, the same bytes every time, whole or not.

    Args:
        figure: to write.
        path: its ending is the format.
        dpi: dots per inch, the style's without.
        plan_hash: of the plan it is of, to be kept in the metadata of PNG, PDF and SVG.

    Raises:
        InputError: if the ending is no picture's, or the file cannot be written.
    """
    known = figure.canvas.get_supported_filetypes()
    if path.is_dir() or path.suffix.lower().removeprefix(".") not in known:
        allowed = ", ".join(f".{ending}" for ending in known)
        raise InputError(f"file {path}", "no picture's name", f"must end in one of {allowed}")
    ending = path.suffix.lower()
    picture = BytesIO()
    with style.context(STYLE):
        figure.savefig(picture, format=ending[1:], metadata=_metadata(ending, plan_hash), dpi=dpi)
    return write(path, picture.getvalue())


def _metadata(ending: str, plan_hash: str | None) -> dict[str, str | None] | None:
    """The plan and no date, in the formats that have words for them."""
    plan = f"plan {plan_hash}" if plan_hash else None
    found: dict[str, dict[str, str | None]] = {
        ".png": {"Description": plan} if plan else {},
        ".pdf": {"Keywords": plan, "CreationDate": None},
        ".svg": {"Description": plan, "Date": None},
    }
    return found.get(ending)


def write(path: Path, content: str | bytes) -> Path:
    """Write a file whole or not at all.

    Raises:
        InputError: if it cannot be written.
    """
    try:
        return write_atomically(path, content)
    except OSError as error:
        raise unwritable(path.parent, f"file {path}", error) from None


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
    spec = sys.modules[make.__module__].__spec__
    p = argparse.ArgumentParser(prog=f"python -m {spec.name}" if spec else None, description=about)
    p.add_argument("runs", type=Path, metavar="RUNS", help="what experiments wrote")
    p.add_argument("file", type=Path, metavar="FILE", help="e.g. figure.png, figure.pdf, table.md")
    options = parse(p, arguments)

    def work(console: Console) -> Answer:
        found = read(options.runs)
        made, file = make(found), Path(options.file)
        if isinstance(made, Figure):
            return wrote(console, save(made, file, plan_hash=plan_hash_of(found)))
        return wrote(console, write(file, made))

    return run_command(work, options)


def wrote(console: Console, *paths: Path) -> Answer:
    """How a command ends that has written files."""
    for path in paths:
        show_written(console, path)
    return Answer(0, {"files": [str(path) for path in paths]})
