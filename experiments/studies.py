"""What the commands of the studies share: how they end, and how their tables are written."""

from __future__ import annotations

import argparse
import csv
import io
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from scp_recon.errors import InputError
from scp_recon.status import Status

BAD_INPUT = 2

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


def whole(low: int, high: int) -> Callable[[str], int]:
    """A type of option: whole numbers within bounds."""

    def parse(text: str) -> int:
        if not text.isdigit() or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(
                f"got {text!r}; must be a whole number from {low} to {high}"
            )
        return int(text)

    return parse


def run(study: Callable[[argparse.Namespace], int], options: argparse.Namespace) -> int:
    """Run a command to its exit status; 2 for bad input, with one line that says which."""
    try:
        return study(options)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT
    except OSError as error:
        where = error.filename or "the terminal"
        print(f"error: cannot write to {where}: {error.strerror}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return Status.INTERRUPTED.value.exit_code


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
