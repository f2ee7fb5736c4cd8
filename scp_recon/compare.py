"""Compare plans: `python -m scp_recon.compare A B ...`, folders with a solution.json or the files."""

from __future__ import annotations

from scp_recon.cli.command import Answer, exit_on_sigint, parse, run_command

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from scp_recon.cli.documents import comparison_document
from scp_recon.cli.warnings import show_warnings
from scp_recon.errors import printable
from scp_recon.solution.comparison import compare
from scp_recon.solution.read import read_solution


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0, or 2 after bad input."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.compare", description=__doc__)
    p.add_argument(
        "plans", type=Path, nargs="+", metavar="PLAN", help="folder with a solution.json, or a file"
    )
    options = parse(p, arguments)
    return run_command(lambda console: _compare(options.plans, console), options)


def _compare(paths: Sequence[Path], console: Console) -> Answer:
    solutions = [read_solution(path) for path in paths]
    found = compare([str(path) for path in paths], solutions)
    heading, *rows = found.cells()
    table = Table(box=None, header_style="bold", pad_edge=False)
    for number, name in enumerate(heading):
        table.add_column(Text(name), justify="right" if number else "left", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    console.print(table)
    for path, solution in zip(paths, solutions, strict=True):
        show_warnings(console, solution.warnings, of=printable(str(path)))
    return Answer(0, comparison_document(found))


if __name__ == "__main__":
    sys.exit(main())
