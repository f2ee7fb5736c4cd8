"""Run many cases, here or on a cluster: `python -m scp_recon.campaign STUDY.toml --out DIR`.

A study names a base scenario, axes along which it changes, and what to do with each case. Results are
one row a case, in DIR/results.parquet. A campaign that was stopped goes on with the same command.
"""

from __future__ import annotations

from scp_recon.cli.command import (
    Answer,
    exit_on_sigint,
    parse,
    progress_console,
    run_command,
    show_line,
    show_written,
)

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from scp_recon.campaign.engine.run import run_study
from scp_recon.campaign.report import show_campaign, summary_of
from scp_recon.campaign.rows.table import status_counts
from scp_recon.campaign.studies import WORKERS_MAX, runner_of
from scp_recon.campaign.study.study import ASK_FROM, read_study
from scp_recon.cli.options import int_between


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.campaign", description=__doc__)
    p.add_argument("study", type=Path, metavar="STUDY", help="TOML file; see docs/campaigns.md")
    p.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for results.parquet"
    )
    where = p.add_mutually_exclusive_group()
    where.add_argument(
        "--workers",
        type=int_between(0, WORKERS_MAX),
        default=1,
        metavar="N",
        help="processes for the cases; 0 runs them in this process, where no case can be ended that "
        "takes too long or too much memory (default: 1)",
    )
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="run on the Dask cluster of this scheduler, e.g. tcp://127.0.0.1:8786; needs [cluster]",
    )
    p.add_argument(
        "--yes", action="store_true", help=f"more than {ASK_FROM} cases are what is meant"
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 when every case has its row, whatever the rows say."""
    options = parse(parser(), arguments)
    return run_command(lambda console: _campaign(options, console), options)


def _campaign(options: argparse.Namespace, console: Console) -> Answer:
    study = read_study(options.study, yes=options.yes)
    with _progress(console) as (observe, say):
        path = run_study(
            study, options.out, runner_of(study, options.workers, options.scheduler, say), observe
        )
    counts = status_counts(path)
    for status, count in counts.items():
        show_line(console, f"{count:10,}  {status}")
    show_written(console, path)
    results, shown = show_campaign(options.out, console)
    document = {
        "cases": len(study.cases),
        "hash": study.hash,
        "statuses": counts,
        **summary_of(results),
        "files": [str(file) for file in (path, *shown)],
    }
    return Answer(0, document)


@contextmanager
def _progress(
    console: Console,
) -> Iterator[tuple[Callable[[int, int, Mapping[str, Any] | None], None], Callable[[str], None]]]:
    """A bar with rate, time left and how cases end; and what says a line above it."""
    errors = progress_console(console)
    columns = (
        *("cases", BarColumn(), MofNCompleteColumn()),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[ends]}"),
    )
    ends: Counter[str] = Counter()
    with Progress(*columns, console=errors, speed_estimate_period=300.0) as bar:
        task = bar.add_task("cases", total=None, rate="", ends="")

        def observe(done: int, total: int, row: Mapping[str, Any] | None) -> None:
            if row is None:
                if done:
                    show_line(errors, f"continued: {done} of {total} cases have their rows")
                bar.reset(task, total=total, completed=done)
                return
            ends[str(row.get("status"))] += 1
            speed = bar.tasks[0].speed
            bar.update(
                task,
                completed=done,
                rate=f"{speed:.3g} a second" if speed else "",
                ends=", ".join(f"{count} {name}" for name, count in ends.most_common(4)),
            )

        yield observe, lambda text: show_line(errors, text)


if __name__ == "__main__":
    sys.exit(main())
