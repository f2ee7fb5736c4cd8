"""Types of command-line options that several commands have."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from scp_recon.errors import InputError
from scp_recon.physics.time_scales import tdb_of_utc

LONGEST = 20
"""Digits: longer numbers are beyond every bound, and slow to read."""


def int_between(low: int, high: int, words: str = "") -> Callable[[str], int]:
    """A type of option: whole numbers within bounds, which are told in `words` if these are shorter."""

    def parse(text: str) -> int:
        if not text.isdecimal() or len(text) > LONGEST or not low <= int(text) <= high:
            allowed = words or f"{low} to {high}"
            raise argparse.ArgumentTypeError(f"got {text!r}; must be a whole number from {allowed}")
        return int(text)

    return parse


SEED = int_between(0, 2**63 - 1, "0 to 2^63 - 1")
"""Of random numbers."""


def number_between(low: float, high: float) -> Callable[[str], float]:
    """A type of option: numbers within bounds."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(
                f"got {text!r}; must be a number from {low:g} to {high:g}"
            )
        return value

    return parse


def date_utc(text: str) -> datetime:
    """A type of option: a date and time in UTC, which comes out in TDB."""
    try:
        return tdb_of_utc(datetime.fromisoformat(text))
    except ValueError as error:  # an InputError is one
        reason = "" if not isinstance(error, InputError) else f", {error.allowed}"
        raise argparse.ArgumentTypeError(
            f"got {text!r}; must be a date and time such as 2020-01-21T20:32:08, UTC{reason}"
        ) from None


def date_tdb(text: str) -> datetime:
    """A type of option: a date and time in TDB."""
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        found = None
    if found is None or found.tzinfo is not None:
        raise argparse.ArgumentTypeError(
            f"got {text!r}; must be a date and time such as 2020-01-21T20:33:17, TDB, without a zone"
        )
    return found


def named_folder(text: str) -> Path:
    """A type of option: a folder, which has a name."""
    if not text:
        raise argparse.ArgumentTypeError("got ''; must be a folder")
    return Path(text)


def add_overrides(p: argparse.ArgumentParser, example: str = ", e.g. risk.p_chance=0.8") -> None:
    """Entries of the scenario, one by one."""
    p.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="PATH=VALUE",
        dest="overrides",
        help=f"override one entry of the scenario{example}; may be repeated",
    )


def add_certify(p: argparse.ArgumentParser) -> None:
    """Whether exact risk is certified."""
    p.add_argument(
        "--certify",
        choices=("yes", "no"),
        help="with risk.allocation = exact, fly the plan and plan again until the lower limit of the "
        "probability reached is what was asked (default: yes)",
    )
