"""Renew evidence that is out of date, and the figures of the pages: `python -m experiments evidence`.

Every study with evidence out of date runs in turn, the shortest first, into runs/evidence/NAME. The
command first shows how long all of them took the last time. After a stop the same command
continues: finished studies are up to date, and an unfinished study keeps its finished work.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from experiments import evidence, pages
from experiments.evidence import FILE, ROOT, Evidence, out_of_date, path_of
from scp_recon.cli.command import parse, run_command, show_line, show_written
from scp_recon.cli.rendering import terminal
from scp_recon.errors import InputError
from scp_recon.files import write_atomically
from scp_recon.results.table import Column, Table

RUNS = Path("runs") / "evidence"
OUT_OF_DATE = 1
"""Exit status of --check where anything is."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    p = argparse.ArgumentParser(prog="python -m experiments evidence", description=__doc__)
    p.add_argument("--page", metavar="PAGE", help="only what a page shows, such as README.md")
    does = p.add_mutually_exclusive_group()
    does.add_argument(
        "--check", action="store_true", help="measure nothing; status 1 if any is out of date"
    )
    does.add_argument(
        "--render", action="store_true", help="measure nothing; fill the pages' marks"
    )
    options = parse(p, arguments)

    def action(console: Console) -> int:
        names = _names(options.page)
        if options.render:
            _write_pages(console)
            return 0
        stale = out_of_date(names)
        console.print(terminal(plan_of(stale)) if stale else "all evidence is up to date")
        if options.check:
            for page in pages.behind():
                stale[page.name] = "its figures are not the evidence's"
                show_line(console, f"{page.name}: {stale[page.name]}")
            return OUT_OF_DATE if stale else 0
        failed = []
        for name in sorted(stale, key=seconds_of):
            try:
                renew(name, console)
                _write_pages(console)
            except InputError as error:  # the others need not wait for what this one lacks
                failed.append(name)
                show_line(console, f"{name}: {error}", "red")
        if failed:
            raise InputError(", ".join(failed), "not renewed", "must be, as said above")
        return 0

    return run_command(action, options)


def _names(page: str | None) -> list[str]:
    """Evidence of a page, or all."""
    if page is None:
        return list(evidence.SOURCES)
    found = [path for path in pages.PAGES if path.is_relative_to(ROOT / page)]
    if not found:
        raise InputError("--page", page, "must be README.md or a page of docs, from the project on")
    return pages.used(found[0].read_text("utf-8"))


def seconds_of(name: str) -> float:
    """Seconds of wall time that a study took the last time; infinite if it never ran."""
    try:
        return Evidence.read(path_of(name)).seconds
    except FileNotFoundError:
        return float("inf")


def plan_of(stale: dict[str, str]) -> Table:
    """The studies to run, why, and how long they took."""
    times = {name: seconds_of(name) / 60.0 for name in sorted(stale, key=seconds_of)}
    rows = [(name, stale[name], minutes) for name, minutes in times.items()]
    total = ("together", "", sum(times.values()))
    columns = ("evidence", "out of date by", Column("the last time", "min", ".1f"))
    return Table.of("", columns, [*rows, total])


def renew(name: str, console: Console) -> None:
    """Run a study, and keep its evidence and pictures.

    Raises:
        InputError: if a command fails.
    """
    source, out = evidence.SOURCES[name], RUNS / name
    _run(f"{source.command} --out {out}", console)
    found = Evidence.read(out / FILE)
    if found.resumed and path_of(name).exists():
        found = replace(found, seconds=max(found.seconds, seconds_of(name)))
    path_of(name).parent.mkdir(exist_ok=True)
    found.write(path_of(name))
    for figure in source.figures:
        _run(figure.format(out=out), console)


def _run(command: str, console: Console) -> None:
    show_line(console, f"python -m {command}")
    status = subprocess.run([sys.executable, "-m", *shlex.split(command)], check=False).returncode
    if status:
        raise InputError(f"python -m {command}", f"exit status {status}", "must end with 0")


def _write_pages(console: Console) -> None:
    for page, text in pages.behind().items():
        show_written(console, write_atomically(page, text))
