"""Show the progress of a campaign, its summary and its files."""

from __future__ import annotations

import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from scp_recon.campaigns.outcome import CampaignResults, remarks
from scp_recon.cli.command import progress_console, show_line, show_written
from scp_recon.cli.rendering import time_left


def summary_of(results: CampaignResults) -> dict[str, Any]:
    """The terminal's summary of a campaign as a document for `--json`."""
    return {
        "feasible": results.feasible,
        "ends": results.counts(),
        "remarks": remarks(results),
    }


def show_campaign(results: CampaignResults, written: Sequence[Path], console: Console) -> None:
    """Show the summary of a campaign, and its files."""
    for line in (results.verdict, *remarks(results)):
        show_line(console, line)
    for path in written:
        show_written(console, path)


@contextmanager
def continuing(console: Console) -> Iterator[None]:
    """Treat a termination signal as Ctrl-C, and say after either how to continue the campaign.

    Only the main thread receives the signal.
    """

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, stop) if in_main_thread else None
    try:
        yield
    except KeyboardInterrupt:
        kept = "every row until now is kept, and the same command continues the campaign"
        show_line(progress_console(console), kept)
        raise
    finally:
        if in_main_thread:
            signal.signal(signal.SIGTERM, before)


@contextmanager
def progress(
    console: Console,
) -> Iterator[tuple[Callable[[int, int, Mapping[str, Any] | None], None], Callable[[str], None]]]:
    """Yield a bar with time taken and left and outcomes, and a function that shows a line above it.

    The time left is known once the first case has ended, however long cases take.
    """
    errors = progress_console(console)
    columns = (
        *("cases", BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()),
        TextColumn("{task.fields[left]}"),
        TextColumn("{task.fields[ends]}"),
    )
    ends: Counter[str] = Counter()
    begun, before = monotonic(), 0
    with Progress(*columns, console=errors) as bar:
        task = bar.add_task("cases", total=None, left="", ends="")

        def observe(done: int, total: int, row: Mapping[str, Any] | None) -> None:
            nonlocal before
            if row is None:
                before = done
                if done:
                    show_line(errors, f"continued: {done} of {total} cases have their rows")
                bar.reset(task, total=total, completed=done)
                return
            ends[str(row.get("status"))] += 1
            bar.update(
                task,
                completed=done,
                left=time_left(done - before, total - before, monotonic() - begun),
                ends=", ".join(f"{count} {name}" for name, count in ends.most_common(4)),
            )

        yield observe, lambda text: show_line(errors, text)
