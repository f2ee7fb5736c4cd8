"""Time everything in one run on one machine: `python -m benchmarks`.

Every method runs in a process of its own, all in turn and several times, so that other work on the
machine affects all alike. The smallest figures count. `make bench` sets up the environment.
"""

from __future__ import annotations

from scp_recon.cli.command import Answer, exit_on_sigint, parse, progress_console, run_command

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import json
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

from rich.console import Console
from rich.progress import track

from benchmarks import growth
from benchmarks.methods import METHODS, Timed
from benchmarks.tables import growth_table, pair_table, ratio_lines
from scp_recon.files import write_atomically

PAGE = Path(__file__).parents[1] / "docs" / "performance.md"
BEGIN, END = "<!-- benchmarks -->", "<!-- /benchmarks -->"
ROUNDS, REPEATS = 3, 3
SLOW = ("ipopt printed", "scp lifted")
"""Methods that are timed twice a round at most."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one round, and no growth")
    parser.add_argument(
        "--page", action="store_true", help="replace the tables of docs/performance.md"
    )
    options = parse(parser, arguments)
    return run_command(lambda console: _measure(options, console), options)


def _measure(options: argparse.Namespace, console: Console) -> Answer:
    rounds = 1 if options.quick else ROUNDS
    bars = progress_console(console)
    figures = measure(rounds, lambda jobs: list(track(jobs, "methods", console=bars)))
    commands = command_times(rounds)
    text = [machine(), "", pair_table(figures), "", *ratio_lines(figures, commands)]
    studies = () if options.quick else growth.STUDIES
    fits = (
        [growth.fit(study) for study in track(studies, "growth", console=bars)] if studies else []
    )
    if fits:
        text += ["", growth_table(fits)]
    console.print("\n".join(text), markup=False, highlight=False, soft_wrap=True)
    if options.page:
        write_page("\n".join(text))
    found = {
        "machine": text[0],
        "methods": {name: asdict(timed) for name, timed in figures.items()},
        "commands_s": commands,
        "growth": [asdict(fit) for fit in fits],
    }
    return Answer(0, found)


def measure(
    rounds: int, ordered: Callable[[list[tuple[int, str]]], list[tuple[int, str]]]
) -> dict[str, Timed]:
    """Every method's figures from the process with the smallest `best`, with the least `first`."""
    found: dict[str, Timed] = {}
    for _, name in ordered([(round_, name) for round_ in range(rounds) for name in METHODS]):
        figures = in_a_process(name, 1 if name in SLOW else REPEATS)
        other = found.get(name, figures)
        better = min(figures, other, key=lambda timed: timed.best)
        found[name] = replace(better, first=min(figures.first, other.first))
    return found


def in_a_process(name: str, repeats: int) -> Timed:
    """One method's figures from a process of its own, whose errors go to the terminal."""
    command = [sys.executable, "-m", "benchmarks.methods", name, str(repeats)]
    output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    return Timed(**json.loads(output))


def command_times(rounds: int) -> dict[str, float]:
    """Process start to end of the command line, and of importing CVXPY."""
    commands = {
        "solve": ["-m", "scp_recon.solve", "--out", "runs/benchmark"],
        "import cvxpy": ["-c", "import cvxpy"],
    }
    best = dict.fromkeys(commands, float("inf"))
    for _ in range(2 * rounds):
        for name, command in commands.items():
            begin = perf_counter()
            subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL)
            best[name] = min(best[name], perf_counter() - begin)
    return best


def machine() -> str:
    """Description of the machine and of versions."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = re.findall(r"model name\s*:\s*(.+)", info.read_text())
        cpu = f"{names[0]}, {len(names)} cores" if names else cpu
    packages = ("clarabel", "casadi", "numpy", "cvxpy")
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    return f"{cpu}; Python {platform.python_version()}, {versions}"


def write_page(text: str) -> None:
    """Replace the page's text between the markers."""
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    after = rest.split(END)[1]
    write_atomically(PAGE, f"{before}{BEGIN}\n{text}\n{END}{after}")


if __name__ == "__main__":
    sys.exit(main())
