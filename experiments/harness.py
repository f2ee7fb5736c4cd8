"""Run a study: options, finished work, progress and tables.

A study is in the `STUDIES` of a module; `python -m experiments NAME` runs it. Its `run` gets a
`Session` and returns tables, which go to OUT as CSV. All tables of at most `ROWS_MAX` rows go into a
file of evidence as well, from which the pages' tables are rendered.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import os
import resource
import shlex
import subprocess
import sys
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from math import isfinite
from pathlib import Path
from time import perf_counter
from typing import Any, TypeAlias

import pandas as pd
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from experiments.evidence import FILE, STUDIES, Evidence
from scp_recon.api.verbs import plan
from scp_recon.cli.command import (
    Answer,
    add_output_options,
    parse,
    progress_console,
    run_command,
    show_line,
    show_written,
)
from scp_recon.errors import InputError
from scp_recon.files import write_atomically
from scp_recon.jobs.job import Done, Executor, Failure, Job, Key, Work
from scp_recon.jobs.store import Row, Store
from scp_recon.jobs.store import run as run_jobs
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightTally, fly_many
from scp_recon.monte_carlo.limits import ALL
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.planning.plan import Plan
from scp_recon.results.policy import policy_of
from scp_recon.results.solution import Solution, make_solution
from scp_recon.scenario.load import base_names, load_scenario, packaged
from scp_recon.scp.status import Status

Record = dict[str, Any]
"""A row of a CSV file by column."""

ROWS_MAX = 400
"""Rows of a table up to which it is kept as evidence; longer ones are for figures."""
Tables: TypeAlias = Mapping[str, Sequence[Record] | pd.DataFrame]
"""Rows by the name of their table, which is that of the CSV file too."""
CONVERGED = Status.CONVERGED.value.name


@dataclass(frozen=True)
class Study:
    """A study: the text of --help, and the function that does the work.

    `options` come besides --out, --json and --quiet: keywords of `argparse.add_argument` by flag. The
    `folder` of `runs` is the study's name by default. Raise `version` when results change where no
    sentinel (`experiments.sentinels`) feels it.
    """

    about: str | None
    run: Callable[[Session], Tables]
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    folder: str = ""
    version: int = 1


@dataclass(frozen=True)
class Session:
    """One run of a study, which writes into the folder `out`; `store` has its finished rows."""

    options: argparse.Namespace
    out: Path
    console: Console
    store: Store

    def say(self, line: str) -> None:
        """Show a line of progress."""
        show_line(self.console, line)

    def rows(
        self,
        label: str,
        work: Work,
        cases: Iterable[Any],
        *,
        executor: Executor | None = None,
        failed: Callable[[Key, Failure], Record] | None = None,
    ) -> list[Record]:
        """Measure the cases whose rows the store lacks, with progress shown; return all in order.

        `work` makes the row of a case, which may be a `Job` with a key of its own; no two of a study
        have the same. `failed` makes the row of a job that failed; without `failed` the failure is
        raised.
        """
        store = self.store
        jobs = [case if isinstance(case, Job) else Job(repr(case), case) for case in cases]
        columns = (TextColumn(label), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, console=progress_console(self.console), transient=True) as bar:
            done = sum(job.key in store for job in jobs)
            task = bar.add_task("", total=len(jobs), completed=done)

            def row_of(one: Done) -> Row:
                bar.advance(task)
                if one.failure is not None and failed is not None:
                    return Row(failed(one.key, one.failure))
                return Row(one.result())

            run_jobs(work, jobs, store, executor, row_of=row_of)
        return [store[job.key] for job in jobs]


@cache
def packaged_entries() -> str:
    """SHA-256 of the entries of all packaged scenarios."""
    entries = {name: packaged(name) for name in base_names()}
    return hashlib.sha256(json.dumps(entries, sort_keys=True, default=str).encode()).hexdigest()


@cache
def default_plan() -> Solution:
    """The default scenario's plan, from a cold start."""
    return make_solution(plan())


@cache
def default_mission() -> Mission:
    """The default scenario's mission."""
    return Mission.from_scenario(load_scenario())


def plan_figures(found: Plan) -> Record:
    """Columns on a plan: status, total delta-v, and iterations of P3 and P2."""
    count = dict.fromkeys(("P3", "P2"), 0)
    for stage in found.stages:
        count[stage.problem] += len(stage.result.records)
    return {
        "status": found.status.value.name,
        "total_dv_m_s": found.total_dv_m_s,
        "iterations_p3": count["P3"],
        "iterations_p2": count["P2"],
    }


def flight_figures(flown: FlightTally) -> Record:
    """Columns on flights: probability at the worst node and of whole flights, and time observed."""
    return {
        "node": min(flown.worst_probability(n)[1].value for n in flown.node_counts if n != ALL),
        "whole_flight": flown.whole / flown.samples,
        "observed_mean_s": flown.tallies[ALL].mean().value,
    }


def run_python(
    words: Sequence[str],
    statuses: Container[int] = (0,),
    folder: Path | None = None,
    setting: Mapping[str, str] | None = None,
) -> tuple[dict[str, float], str]:
    """Run Python with some words: seconds of clock and processor, and what it printed.

    Errors go to the terminal. `setting` are variables of the environment.

    Raises:
        InputError: if it ends with another status than these.
    """
    begin, before = perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    command, env = [sys.executable, *words], {**os.environ, **(setting or {})}
    done = subprocess.run(
        command, check=False, cwd=folder, env=env, stdout=subprocess.PIPE, text=True
    )
    wall, after = perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in statuses:
        raise InputError(" ".join(words), f"exit status {done.returncode}", "must end well")
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"wall_s": wall, "processor_s": cpu}, done.stdout


def fly_plan(found: Plan, samples: int, seed: int) -> FlightTally:
    """Fly a plan with errors, its burns corrected as it says."""
    policy = policy_of(found.mission, found.final.result.lin)
    config = Flyer(found.mission, found.burns_m_s, policy, seed=seed)
    return fly_many(config, samples=samples)


def study_of(name: str) -> Study:
    """The study of a name."""
    studies: Mapping[str, Study] = importlib.import_module(f"experiments.{STUDIES[name]}").STUDIES
    return studies[name]


def run(prog: str, study: Study, arguments: Sequence[str]) -> int:
    """Run a study's command line, `prog` and arguments, to its exit status.

    Finished rows of a study that was stopped are taken up again, if version and scenarios are the same.
    """
    name = prog.split()[-1]
    default = Path("runs") / (study.folder or name)
    p = argparse.ArgumentParser(prog=prog, description=study.about)
    said = f"folder for what is written (default: {default})"
    p.add_argument("--out", type=Path, default=default, metavar="DIR", help=said)
    for flag, settings in study.options.items():
        p.add_argument(flag, **settings)
    options = parse(p, arguments)
    output = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    output.add_argument("--out")
    add_output_options(output)
    command = shlex.join([*prog.split()[2:], *output.parse_known_args(arguments)[1]])

    def action(console: Console) -> Answer:
        out, begun, began = options.out, Evidence.begun(command, study.version), perf_counter()
        depends_on = {"version": study.version, "scenarios": packaged_entries()}
        try:
            with Store(out / f"{name}_partial.jsonl", depends_on) as store:
                tables = study.run(Session(options, out, console, store))
                seconds = round(perf_counter() - began, 1)
                written = write(out, tables, begun.model_copy(update={"seconds": seconds}))
                store.forget()
        except OSError as error:
            if error.filename is None:  # the terminal, or a pipe
                raise
            reason = (error.strerror or "unusable").lower()
            raise InputError(str(error.filename), reason, "must be writable") from None
        for path in written:
            show_written(console, path)
        return Answer(0, {"folder": str(out), "files": [str(path) for path in written]})

    return run_command(action, options)


def write(out: Path, tables: Tables, evidence: Evidence) -> list[Path]:
    """Write a study's tables, with a column for each key of any row, and its evidence."""
    written, kept = list[Path](), dict[str, list[Record]]()
    for name, own in tables.items():
        frame = pd.DataFrame(own, dtype=object)  # so that numbers stay what they are
        written.append(write_atomically(out / f"{name}.csv", frame.to_csv(index=False)))
        if len(frame) <= ROWS_MAX:
            finite = frame.map(lambda v: isinstance(v, str) or (v is not None and isfinite(v)))
            kept[name] = frame.where(finite, None).to_dict("records")
    return [*written, evidence.model_copy(update={"tables": kept}).write(out / FILE)]


def wide(frame: pd.DataFrame, index: Sequence[str], columns: str, values: str) -> list[Record]:
    """A row for each combination of `index`, with a column for each value of `columns`."""
    found = frame.pivot_table(values, [*index], columns, aggfunc="first", sort=False)
    rows: list[Record] = found.reset_index().to_dict("records")
    return rows
