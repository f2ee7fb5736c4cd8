"""Read the delivery of `replan`: state, covariance and measured burns, as numbers or files."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from scp_recon.errors import InputError
from scp_recon.files import read_text
from scp_recon.replanning.remainder import Delivery

BYTES_MAX = 100_000
"""Of a file of 36 numbers with whatever is said of them."""


def read_delivery(
    epoch: datetime,
    *,
    at_s: str,
    state: str,
    covariance: Path | None,
    measured_burns: Sequence[str],
    **frames: str,
) -> Delivery:
    """Make a delivery from options of the command line.

    Args:
        epoch: of the plan that is flown, TDB.
        at_s: time of the state, s past the epoch or a date in TDB.
        state: six numbers, m and m/s, or their file.
        covariance: file of six rows of six numbers, m and m/s, if any.
        measured_burns: N=X,Y,Z each, m/s.
        **frames: axes of state and burns, and of the covariance, as of `Delivery.of`.

    Raises:
        InputError: if a number, a date or a file is not valid.
    """
    rows = None if covariance is None else _rows(covariance, "--covariance")
    if rows is not None and [len(row) for row in rows] != 6 * [6]:
        sizes = " and ".join(sorted({str(len(row)) for row in rows})) or "no"
        given, allowed = f"{len(rows)} rows of {sizes} numbers", "must be six rows of six numbers"
        raise InputError(f"--covariance {covariance}", given, f"{allowed}, m and m/s")
    try:
        numbers = _numbers(state)
    except ValueError:
        numbers = [number for row in _rows(Path(state), "--state") for number in row]
    if len(numbers) != 6:
        allowed = "must be six, m and m/s, or their file"
        raise InputError("--state", f"{len(numbers)} numbers", allowed)
    burns: dict[int, list[float]] = {}
    for text in measured_burns:
        number, burn = _burn(text)
        if number in burns:
            raise InputError("--measured-burn", f"burn {number} twice", "must be given once")
        burns[number] = burn
    return Delivery.of(_time(at_s, epoch), numbers, covariance=rows, measured=burns, **frames)


def _time(text: str, epoch: datetime) -> float:
    try:
        return float(text)
    except ValueError:
        pass
    try:
        date = datetime.fromisoformat(text)
    except ValueError:
        date = None
    if date is None or date.tzinfo is not None:
        allowed = (
            "must be seconds past the plan's epoch, or a date in TDB such as 2020-01-22T01:16:37"
        )
        raise InputError("--at", repr(text)[:80], allowed)
    return (date - epoch).total_seconds()


def _burn(text: str) -> tuple[int, list[float]]:
    number, _, burn = text.partition("=")
    try:
        (x, y, z), index = _numbers(burn), int(number)
    except ValueError:
        allowed = "must read N=X,Y,Z: the burn's number and three numbers in m/s"
        raise InputError("--measured-burn", repr(text)[:80], allowed) from None
    return index, [x, y, z]


def _rows(path: Path, entry: str) -> list[list[float]]:
    """Numbers of a file, line by line; text after a # is ignored."""
    text = read_text(path, f"{entry} {path}", "file of numbers", BYTES_MAX)
    lines = [line.partition("#")[0] for line in text.splitlines()]
    try:
        return [_numbers(line) for line in lines if line.strip()]
    except ValueError as error:
        raise InputError(f"{entry} {path}", str(error)[:80], "must be a file of numbers") from None


def _numbers(text: str) -> list[float]:
    return [float(part) for part in text.replace(",", " ").split()]
