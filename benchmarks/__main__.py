"""Time every method in one run on one machine: `python -m benchmarks`.

Every method runs in a process of its own, with one thread. All methods run in turn several times, so
that other work on the machine affects all of them alike. The smallest figures count. With `--growth`
the run measures instead how plans grow with nodes, facets and burns, in seconds of the processor.
After Ctrl-C it continues with what is missing. `make bench` sets up the environment.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

from benchmarks import growth
from benchmarks.methods import METHODS, Timed
from benchmarks.tables import growth_rows, method_rows, ratio_rows
from experiments.harness import Findings, Record, Session, Study, option, records, run
from scp_recon.errors import InputError
from scp_recon.jobs.job import Job

ROUNDS, REPEATS = 3, 3
SLOW = ("ipopt printed", "scp lifted")
"""Methods that are timed twice a round at most."""
SAME_ARITHMETIC = {"OPENBLAS_CORETYPE": "Haswell", "OPENBLAS_NUM_THREADS": "1"}
"""OpenBLAS's kernels, which every x86 processor since 2013 has, on one thread, as commands have it. How
long IPOPT takes for the program as printed depends on rounding: with a newer processor's kernels it had
no plan after seven minutes."""


def measure(session: Session) -> Findings:
    """Time every method and the command line; or measure how plans grow."""
    store = session.store()
    if session.options.growth:
        if session.options.quick:
            raise InputError("--growth", "--quick beside it", "goes alone")
        pairs = [(study.name, method) for study in growth.STUDIES for method in growth.METHODS]
        jobs = [Job(", ".join(pair), pair) for pair in pairs]
        fits = session.rows("growth", grown, jobs, store)
        return _found({"growth": growth_rows([growth.Fit(**fit) for fit in fits])})
    rounds = 1 if session.options.quick else ROUNDS
    jobs = [Job(f"{round_} {name}", name) for round_ in range(rounds) for name in METHODS]
    rows = session.rows("methods", figures_of, jobs, store)
    figures = best_of([job.inputs for job in jobs], [Timed(**row) for row in rows])
    repeats = [Job(f"command {number}", session.out) for number in range(2 * rounds)]
    times = session.rows("commands", command_times, repeats, store)
    commands = {name: min(row[name] for row in times) for name in times[0]}
    return _found({"methods": method_rows(figures), "ratios": ratio_rows(figures, commands)})


def _found(tables: Mapping[str, Sequence[Record]]) -> Findings:
    found = {f"{name}.csv": records(rows) for name, rows in tables.items()}
    return Findings([replace(table, title=name) for name, table in found.items()], found)


def best_of(names: Sequence[str], timed: Sequence[Timed]) -> dict[str, Timed]:
    """Every method's figures from the process with the smallest `best`, with the least `first`."""
    found: dict[str, Timed] = {}
    for name, figures in zip(names, timed, strict=True):
        other = found.get(name, figures)
        better = min(figures, other, key=lambda timed: timed.best)
        found[name] = replace(better, first=min(figures.first, other.first))
    return found


def figures_of(name: str) -> dict[str, Any]:
    """One method's figures."""
    return in_a_process("benchmarks.methods", name, str(1 if name in SLOW else REPEATS))


def grown(study: tuple[str, str]) -> dict[str, Any]:
    """How the plans of a method grow with a quantity."""
    return in_a_process("benchmarks.growth", *study)


def in_a_process(module: str, *words: str) -> dict[str, Any]:
    """What a module prints as JSON in a process of its own, whose errors go to the terminal."""
    command = [sys.executable, "-m", module, *words]
    setting = {**os.environ, **SAME_ARITHMETIC}
    output = subprocess.run(
        command, check=True, stdout=subprocess.PIPE, text=True, env=setting
    ).stdout
    found: dict[str, Any] = json.loads(output)
    return found


def command_times(out: Path) -> dict[str, float]:
    """Process start to end of the command line, and of importing CVXPY, s."""
    commands = {
        "solve": ["-m", "scp_recon.solve", "--out", str(out / "solve")],
        "import cvxpy": ["-c", "import cvxpy"],
    }
    found = {}
    for name, command in commands.items():
        begin = perf_counter()
        subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL)
        found[name] = perf_counter() - begin
    return found


STUDY = Study(
    "Performance",
    __doc__,
    measure,
    [
        option("--quick", action="store_true", help="one round"),
        option("--growth", action="store_true", help="how plans grow, instead"),
    ],
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    return run("python -m benchmarks", STUDY, words)


if __name__ == "__main__":
    sys.exit(main())
