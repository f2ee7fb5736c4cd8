"""Show the progress of a campaign, its summary and its files."""

from __future__ import annotations

import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from scp_recon.campaigns.outcome import CampaignResults, remarks
from scp_recon.cli.command import progress_console, show_line, show_written


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
    """Yield a bar with rate, time left and outcomes, and a function that shows a line above it."""
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
