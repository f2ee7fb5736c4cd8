"""Check and renew evidence, and render the pages: `python -m experiments evidence`.

The check measures the sentinels of all studies on two processes, and says of each file of evidence
whether it is current, or what has moved. Without `--check` every study with evidence out of date then
runs in turn, the shortest first, into runs/evidence/NAME; `--dated` renews timings and counts. After
a stop the same command continues: finished studies are current, and an unfinished one keeps its work.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments import pages
from experiments.evidence import FILE, SOURCES, Evidence, path_of
from experiments.harness import study_of
from experiments.sentinels import OWN, sentinels_of
from scp_recon.cli.command import parse, run_command, show_line, show_written
from scp_recon.errors import InputError
from scp_recon.files import write_atomically
from scp_recon.jobs.job import Job
from scp_recon.jobs.processes import Processes

RUNS = Path("runs") / "evidence"
OUT_OF_DATE = 1
"""Exit status where any evidence is out of date, or was not renewed."""
PROCESSES = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    p = argparse.ArgumentParser(prog="python -m experiments evidence", description=__doc__)
    does = p.add_mutually_exclusive_group()
    for flag, said in (
        ("--check", "renew nothing; status 1 if any is out of date"),
        ("--dated", "renew timings and counts, and only these"),
        ("--render", "measure nothing; fill the pages' tables"),
    ):
        does.add_argument(flag, action="store_true", help=said)
    options = parse(p, arguments)

    def action(console: Console) -> int:
        stale, left = list[str](), list[str]()
        if options.dated:
            stale = [name for name, source in SOURCES.items() if source.dated]
        elif not options.render:
            stale = check(console)
        if options.check:
            left = [*stale, *(f"{page.name}: its tables are old" for page in pages.behind())]
        else:
            left = [*renewed(sorted(stale, key=seconds_of), console)]
            for page, text in pages.behind().items():
                show_written(console, write_atomically(page, text))
        left += [] if options.render else pages.wrong_claims()
        for line in left:
            show_line(console, line)
        return OUT_OF_DATE if left else 0

    return run_command(action, options)


def check(console: Console) -> list[str]:
    """Names of the evidence that is out of date; a line says why of each, or that it is current.

    Raises:
        InputError: if a file of evidence is none.
    """
    names = sorted(SOURCES, key=seconds_of, reverse=True)  # the slowest sentinels first
    found = {name: changes(name) for name in names}
    asked = {
        name: [OWN.index(one) for one in sentinels_of(name)]
        for name in names
        if not (SOURCES[name].dated or found[name])
    }
    jobs = [Job(place, place) for place in dict.fromkeys(chain(*asked.values()))]
    results = {done.key: done for done in Processes(PROCESSES)(measured, jobs)}
    for name, places in asked.items():
        for place in places:
            try:
                for result in results[place].result():
                    found[name] += OWN[place].moved(result)
            except InputError as error:  # an extra that is missing, or a row that is not there
                found[name].append(str(error))
    for name, lines in found.items():
        for line in lines or [f"current, of {Evidence.read(path_of(name)).date}"]:
            show_line(console, f"{name}: {line}")
    return [name for name, lines in found.items() if lines]


def changes(name: str) -> list[str]:
    """Why evidence is out of date before anything is measured."""
    if not path_of(name).exists():
        return ["never measured"]
    kept, source = Evidence.read(path_of(name)), SOURCES[name]
    if source.dated:
        return []
    version = study_of(source.command.split()[1]).version
    found = [f"version {kept.version}, now {version}"] if kept.version != version else []
    return found + ([f"made by {kept.command}"] if kept.command != source.command else [])


def measured(place: int) -> list[Any]:
    """Measure the cases of a sentinel, given by its place: the work of a process."""
    return [OWN[place].work(case) for case in OWN[place].cases]


def seconds_of(name: str) -> float:
    """Seconds of wall time that a study took the last time; 0 if it never ran."""
    return Evidence.read(path_of(name)).seconds if path_of(name).exists() else 0.0


def renewed(names: Sequence[str], console: Console) -> Iterator[str]:
    """Run studies, and keep their evidence and pictures; yields a line for each that failed."""
    for name in names:
        source, out = SOURCES[name], RUNS / name
        try:
            _run(f"{source.command} --out {out}", console)
            path_of(name).parent.mkdir(exist_ok=True)
            Evidence.read(out / FILE).write(path_of(name))
            for figure in source.figures:
                _run(f"paper_figs {figure.format(out=out)}", console)
        except InputError as error:  # the others need not wait for what this one lacks
            yield f"{name}: {error}"


def _run(command: str, console: Console) -> None:
    show_line(console, f"python -m {command}")
    status = subprocess.run([sys.executable, "-m", *shlex.split(command)], check=False).returncode
    if status:
        raise InputError(f"python -m {command}", f"exit status {status}", "must end with 0")
