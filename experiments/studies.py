"""What the commands of the studies share: how they end, and how their tables are written."""

from __future__ import annotations

import argparse
import csv
import io
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

from rich.console import Console

from scp_recon.cli.command import Answer, run_command
from scp_recon.errors import InputError

Cell = str | float | int | bool


def add_out(parser: argparse.ArgumentParser, default: Path) -> None:
    """The option --out."""
    parser.add_argument(
        "--out",
        type=Path,
        default=default,
        metavar="DIR",
        help=f"folder for what is written (default: {default})",
    )


def run(study: Callable[[argparse.Namespace], int], options: argparse.Namespace) -> int:
    """Run a study to its exit status; what goes wrong ends it as it ends every command."""

    def action(console: Console) -> Answer:
        try:
            with _printing_to(console):
                status = study(options)
        except OSError as error:
            if error.filename is None:  # the terminal, or a pipe
                raise
            reason = (error.strerror or "unusable").lower()
            raise InputError(str(error.filename), reason, "must be writable") from None
        return Answer(status, {"folder": str(options.out)})

    return run_command(action, options)


@contextmanager
def _printing_to(console: Console) -> Iterator[None]:
    """What a study prints goes where the console writes: with --quiet nowhere, its bars neither."""
    with ExitStack() as stack:
        if console.stderr:
            stack.enter_context(redirect_stdout(sys.stderr))
        if console.quiet:
            nowhere = stack.enter_context(Path(os.devnull).open("w", encoding="utf-8"))
            stack.enter_context(redirect_stdout(nowhere))
            stack.enter_context(redirect_stderr(nowhere))
        yield


def to_csv(records: Sequence[Mapping[str, Cell]]) -> str:
    """Records with the same keys as CSV; truth values in lower case."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(records[0]), lineterminator="\n")
    writer.writeheader()
    for record in records:
        writer.writerow(
            {k: str(v).lower() if isinstance(v, bool) else v for k, v in record.items()}
        )
    return text.getvalue()


def markdown(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A table whose first column is words and whose others are figures."""
    body = [header, ["---"] + ["---:"] * (len(header) - 1), *lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in body)
