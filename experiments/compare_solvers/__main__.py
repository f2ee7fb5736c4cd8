"""SCP's forms, algorithms and conic solvers against IPOPT: `python -m experiments.compare_solvers`.

Rows and tables are left in OUT; a run that was stopped continues with the first missing row.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint, parse, run_command

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Iterator, Sequence
from math import inf
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from experiments.compare_solvers.cases import EXACT, Cell, full_design, quick_design
from experiments.compare_solvers.exact.cell import solve_exact
from experiments.compare_solvers.exact.scenarios import QUICK, exact_design
from experiments.compare_solvers.report import claim_line, every_claim, shown, to_csv, to_markdown
from experiments.compare_solvers.row import FAILED, Row
from experiments.compare_solvers.runs import FILE_NAME, PEER_NAME, read_rows, run_cells
from scp_recon.files import write_atomically

DEFAULT_OUT, QUICK_OUT = Path("runs") / "comparison", Path("runs") / "comparison_quick"
REPORT_NAME = "comparison.md"
FLIGHTS, LIMIT_S, QUICK_LIMIT_S, EXACT_LIMIT_S = 2_000, 30.0, 20.0, 150.0


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m experiments.compare_solvers", description=__doc__)
    size = p.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="a cell of every kind: three minutes")
    size.add_argument("--full", action="store_true", help="everything, two hours (default)")
    size.add_argument(
        "--exact", action="store_true", help="exact risk in 50 scenarios alone: half an hour"
    )
    p.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder for the rows and the tables "
        f"(default: {DEFAULT_OUT}, with --quick {QUICK_OUT})",
    )
    p.add_argument(
        "--fresh", action="store_true", help="forget the rows that are there instead of going on"
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 once every cell has its row, failed ones included."""
    options = parse(parser(), arguments)
    return run_command(lambda console: _run(options, console), options)


def _run(options: argparse.Namespace, console: Console) -> int:
    out: Path = options.out or (QUICK_OUT if options.quick else DEFAULT_OUT)
    out.mkdir(parents=True, exist_ok=True)
    if options.fresh:
        (out / FILE_NAME).unlink(missing_ok=True)
    cells = _design(options)
    limit_s = QUICK_LIMIT_S if options.quick else LIMIT_S
    rows = _rows(console, cells, out / FILE_NAME, limit_s)
    rows += read_rows(out / PEER_NAME, inf).values()
    for claim in every_claim(rows):
        console.print(claim_line(claim), highlight=False, soft_wrap=True)
    for path in _write(rows, out):
        console.print(f"written: {path}", highlight=False, soft_wrap=True)
    words = (
        f"The tables are in {out / REPORT_NAME}; python -m paper_figs.studies.solver_comparison "
        f"{out / 'comparison.csv'} {out} draws them."
    )
    if options.quick:
        words += " A quick run shows a few cells of each kind: only --full settles the claims."
    console.print(words, highlight=False, soft_wrap=True)
    return 0


def _design(options: argparse.Namespace) -> Sequence[Cell]:
    if options.exact:
        return exact_design()
    if options.quick:
        return (*quick_design(), *exact_design(QUICK))
    return (*full_design(), *exact_design())


def _solved(cells: Sequence[Cell], path: Path, limit_s: float) -> Iterator[Row]:
    """Rows of the cells, those of exact risk last."""
    exact = [cell for cell in cells if cell.group == EXACT]
    others = [cell for cell in cells if cell.group != EXACT]
    yield from run_cells(others, path, flights=FLIGHTS, limit_s=limit_s)
    yield from run_cells(exact, path, flights=0, limit_s=EXACT_LIMIT_S, solve=solve_exact)


def _rows(console: Console, cells: Sequence[Cell], path: Path, limit_s: float) -> list[Row]:
    """All rows, with a bar that moves as they come."""
    rows: list[Row] = []
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
    )
    with bar:
        task = bar.add_task("cells", total=len(cells))
        for row in _solved(cells, path, limit_s):
            rows.append(row)
            if row.status == FAILED:
                bar.console.print(f"{row.key}: {shown(row)}", highlight=False, markup=False)
            bar.advance(task)
    return rows


def _write(rows: Sequence[Row], out: Path) -> list[Path]:
    table = write_atomically(out / "comparison.csv", to_csv(rows))
    report = write_atomically(out / REPORT_NAME, to_markdown(rows))
    return [table, report]


if __name__ == "__main__":
    sys.exit(main())
