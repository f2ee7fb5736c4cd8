"""Compare SCP's forms, algorithms and conic solvers with IPOPT.

Rows and tables are left in OUT; a run that was stopped continues with the first missing row.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from importlib.metadata import version as release_of
from itertools import chain
from pathlib import Path

from experiments.harness import FRESH, Findings, Record, Session, Study, option
from experiments.solvers.compare_solvers.cases import (
    EXACT,
    QUICK,
    Cell,
    exact_design,
    full_design,
    quick_design,
)
from experiments.solvers.compare_solvers.cell import (
    FAILED,
    Row,
    failed_row,
    solve_cell,
    solve_exact,
)
from experiments.solvers.compare_solvers.claims import claims
from experiments.solvers.compare_solvers.tables import csv_of, report, shown
from scp_recon.errors import InputError
from scp_recon.jobs.job import TIMED_OUT, Done, Job, in_order
from scp_recon.jobs.processes import Limits, Processes
from scp_recon.jobs.store import Store

DEFAULT_OUT, QUICK_OUT = Path("runs") / "comparison", Path("runs") / "comparison_quick"
ROWS_FILE = "rows.jsonl"
FLIGHTS, LIMIT_S, QUICK_LIMIT_S, EXACT_LIMIT_S = 2_000, 30.0, 20.0, 150.0
CORES = 2
ASLEEP = 20.0
"""Times its limit that a cell's process may take by the clock, on a machine with other work."""

Solve = Callable[..., Row]
"""Of a cell and of how many flights; a function of a module that a process imports alone."""


# --- rows -----------------------------------------------------------------------------------------


def run_cells(
    cells: Sequence[Cell], store: Store, *, flights: int, limit_s: float, solve: Solve = solve_cell
) -> Iterator[Row]:
    """Rows of the cells, repeats last: from the store if it has them, else solved and stored.

    Two cells are solved at a time, each in a process of its own within `limit_s` seconds of processor
    time, the Monte Carlo estimate of `flights` flights included. A failure before the limit is tried
    again; what reaches the limit at first does so in its repeats, which take its row.
    """
    limits = Limits(seconds=ASLEEP * limit_s, cpu_s=limit_s, apart=True)
    late: dict[str, Row] = {}

    def kept(cell: Cell) -> Row | None:
        """Its row in the store, or that of a first run that reached the limit."""
        key = key_of(cell, limit_s)
        row = row_from(store[key]) if key in store else None
        if row is None or (row.status == FAILED and not row.cpu_s >= limit_s):
            row = late.get(replace(cell, repeat=0).key)
        return row

    for again in (False, True):
        some = [cell for cell in cells if bool(cell.repeat) == again]
        jobs = [Job(key_of(cell, limit_s), cell) for cell in some if kept(cell) is None]
        solved = in_order(Processes(CORES, limits), partial(solve, flights=flights), jobs)
        with closing(solved):
            for cell in some:
                row = kept(cell)
                if row is None:
                    row = _row_of(next(solved), cell, limit_s)
                    row = replace(row, limit_s=limit_s, version=release_of("scp_recon"))
                if row.status == FAILED and row.cpu_s >= limit_s:
                    late.setdefault(cell.key, row)
                row, key = replace(row, key=cell.key), key_of(cell, limit_s)
                if key not in store or row_from(store[key]).status == FAILED:
                    store.put(key, asdict(row))
                yield row


def key_of(cell: Cell, limit_s: float) -> str:
    """The key of its row in a store."""
    return f"{cell.key}|{limit_s:g} s"


def _row_of(done: Done, cell: Cell, limit_s: float) -> Row:
    if done.failure is None:
        row: Row = done.value
        return row
    if done.failure.status == TIMED_OUT:
        return failed_row(cell, f"no end after {limit_s:g} s", limit_s)
    return failed_row(cell, " ".join(done.failure.message.split())[:200])


def row_from(values: Record) -> Row:
    """A row as a store keeps it."""
    return Row(**values | {"burns_m_s": tuple(values["burns_m_s"])})


# --- the study ------------------------------------------------------------------------------------


def design(options: Namespace) -> Sequence[Cell]:
    """The cells to solve."""
    if options.exact:
        return exact_design()
    if options.quick:
        return (*quick_design(), *exact_design(QUICK))
    return (*full_design(), *exact_design())


def run(session: Session) -> Findings:
    """Solve the missing cells, those of exact risk last."""
    options = session.options
    sizes = [name for name in ("quick", "full", "exact") if getattr(options, name)]
    if len(sizes) > 1:
        raise InputError(f"--{sizes[0]}", f"--{sizes[1]} beside it", "goes alone")
    if options.quick and options.out == DEFAULT_OUT:
        session.out = QUICK_OUT
    store = session.store(ROWS_FILE)
    if options.fresh:
        store.forget()
    cells, rows = design(options), []
    exact = [cell for cell in cells if cell.group == EXACT]
    others = [cell for cell in cells if cell.group != EXACT]
    limit_s = QUICK_LIMIT_S if options.quick else LIMIT_S
    solved = chain(
        run_cells(others, store, flights=FLIGHTS, limit_s=limit_s),
        run_cells(exact, store, flights=0, limit_s=EXACT_LIMIT_S, solve=solve_exact),
    )
    with session.steps("cells", len(cells)) as done:
        for row in solved:
            rows.append(row)
            if row.status == FAILED:
                session.say(f"{row.key}: {shown(row)}")
            done()
    session.say(
        f"`python -m paper_figs solver_comparison --runs {session.out} --out DIR` draws it."
    )
    if options.quick:
        session.say("A quick run shows a few cells of each kind: only --full settles the claims.")
    return Findings(report(rows), {"comparison.csv": csv_of(rows)}, claims(rows))


STUDY = Study(
    "Comparison of solvers",
    __doc__,
    run,
    (
        option(
            "--quick",
            action="store_true",
            help=f"a cell of every kind, into {QUICK_OUT}: three minutes",
        ),
        option("--full", action="store_true", help="everything, two to three hours (default)"),
        option(
            "--exact", action="store_true", help="exact risk in 50 scenarios alone: half an hour"
        ),
        FRESH,
    ),
    folder=DEFAULT_OUT.name,
    stem="comparison",
)
