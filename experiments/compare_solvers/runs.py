"""Cells one after the other, each in a process of its own with a time limit; rows as they come.

A row is a line of JSON, appended when its cell is done, so that a stopped run continues. It says what
limit it had and which sources solved it: rows of another limit or of other sources are left alone.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing as mp
import resource
import signal
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace
from functools import cache
from importlib.metadata import version as release_of
from math import ceil
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from pathlib import Path
from time import process_time

from experiments.compare_solvers.cases import Cell
from experiments.compare_solvers.cell import solve_cell
from experiments.compare_solvers.row import FAILED, Row, failed_row

FILE_NAME, PEER_NAME = "rows.jsonl", "peer.jsonl"
PRELOADED = ["experiments.compare_solvers.cell", "experiments.compare_solvers.exact.cell"]
"""Imported once by the server that the cells' processes are forked from."""

ASLEEP = 20.0
"""Times its limit that a cell's process may take by the clock, on a machine with other work."""

Solve = Callable[[Cell, int], Row]

SOURCES = (
    "formulations/**/*.py",
    "scp_recon/**/*.py",
    "scp_recon/data/*.*",
    "experiments/compare_solvers/ca*.py",
    "experiments/compare_solvers/exact/[cprs]*.py",
    "experiments/compare_solvers/cell.py",
    "experiments/compare_solvers/unguarded.py",
)
"""What a row depends on."""


@cache
def version() -> str:
    """Of the package, and a hash of the sources that rows depend on."""
    root, digest = Path(__file__).parents[2], hashlib.sha256()
    for path in sorted(path for pattern in SOURCES for path in root.glob(pattern)):
        digest.update(path.read_bytes())
    return f"{release_of('scp_recon')}+{digest.hexdigest()[:12]}"


def run_cells(
    cells: Iterable[Cell], path: Path, *, flights: int, limit_s: float, solve: Solve = solve_cell
) -> Iterator[Row]:
    """Rows of the cells, from the file where they are there, else solved and appended to it.

    What failed before its limit is tried again.

    Args:
        cells: what to solve.
        path: of the rows.
        flights: of each cell's Monte Carlo estimate.
        limit_s: seconds of the processor that a cell may take, its estimate included.
        solve: what solves one; a function of a module.
    """
    known = read_rows(path, limit_s)
    context = mp.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    _start_server()
    with path.open("a+", encoding="utf-8") as file:
        if file.tell():
            file.write("\n")  # after a line that was cut off; empty lines are no rows
        for cell in cells:
            row = known.get(cell.key)
            if row is None or (row.status == FAILED and not row.cpu_s >= limit_s):
                receive, send = context.Pipe(duplex=False)
                process = context.Process(target=_work, args=(send, solve, cell, flights, limit_s))
                row = _row_of(process, receive, send, cell, limit_s)
                row = replace(row, limit_s=limit_s, version=version())
                file.write(json.dumps(asdict(row)) + "\n")
                file.flush()
            yield row


def _start_server() -> None:
    """What cells are forked from, deaf to Ctrl-C: it would die of it with a traceback."""
    heard = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        forkserver.ensure_running()
    finally:
        signal.signal(signal.SIGINT, heard)


def read_rows(path: Path, limit_s: float) -> dict[str, Row]:
    """Complete rows of a file by key, of these sources and this limit; none if there is no file.

    The last one of a key counts.
    """
    rows: dict[str, Row] = {}
    if not path.exists():
        return rows
    for line in path.read_text("utf-8").splitlines():
        try:
            entries = json.loads(line)
            row = Row(**entries | {"burns_m_s": tuple(entries["burns_m_s"])})
        except (ValueError, TypeError, KeyError):
            continue  # cut off, or of another version of this study
        if row.limit_s == limit_s and row.version == version():
            rows[row.key] = row
    return rows


def _work(send: Connection, solve: Solve, cell: Cell, flights: int, limit_s: float) -> None:
    """In the cell's process: its row, or the words of what went wrong."""
    used = int(process_time())  # which a process that was forked may count from
    resource.setrlimit(resource.RLIMIT_CPU, (used + ceil(limit_s), resource.RLIM_INFINITY))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    try:
        send.send(solve(cell, flights))
    except BrokenPipeError:  # nobody waits for it any more
        return
    except Exception as error:  # a solver's, or ours: the row says which
        send.send(failed_row(cell, f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"))


def _row_of(
    process: mp.process.BaseProcess,
    receive: Connection,
    send: Connection,
    cell: Cell,
    limit_s: float,
) -> Row:
    """Wait for a cell's process as long as it may take, and end it."""
    process.start()
    send.close()  # this end of it, so that a process that dies is noticed
    try:
        if not receive.poll(ASLEEP * limit_s):
            return failed_row(cell, f"asleep for {ASLEEP * limit_s:g} s")
        row: Row = receive.recv()
        return row
    except EOFError:
        process.join()
        if process.exitcode == -signal.SIGXCPU:
            return failed_row(cell, f"no end after {limit_s:g} s", limit_s)
        return failed_row(cell, f"its process ended with exit code {process.exitcode}")
    finally:
        process.kill()
        process.join()
        receive.close()
