"""Read the delivery of `replan`: state, covariance and measured burns, as numbers or files."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np

from formulations.arrays import Array
from scp_recon.errors import InputError
from scp_recon.files import read_text
from scp_recon.replanning.delivery import Delivery

BYTES_MAX = 100_000
"""Of a file of 36 numbers with whatever is said of them."""


def read_delivery(
    at_s: str,
    state: str,
    epoch: datetime,
    *,
    frame: str,
    covariance: Path | None,
    covariance_frame: str | None,
    measured_burns: Sequence[str],
) -> Delivery:
    """Make a delivery from options of the command line.

    Args:
        at_s: time of the state, s past the epoch or a date in TDB.
        state: six numbers, m and m/s, or their file.
        epoch: of the plan that is flown, TDB.
        frame: axes of state and burns.
        covariance: file of six rows of six numbers, m and m/s, if any.
        covariance_frame: axes of the covariance.
        measured_burns: N=X,Y,Z each, m/s.

    Raises:
        InputError: if a number, a date or a file is not valid.
    """
    rows = None
    if covariance is not None:
        rows = _rows(covariance, "--covariance")
        if [len(row) for row in rows] != 6 * [6]:
            sizes = " and ".join(sorted({str(len(row)) for row in rows})) or "no"
            raise InputError(
                f"--covariance {covariance}",
                f"{len(rows)} rows of {sizes} numbers",
                "must be six rows of six numbers, m and m/s",
            )
    return Delivery.of(
        at_s=_time(at_s, epoch),
        state=_state(state),
        frame=frame,
        covariance=None if rows is None else np.array(rows),
        covariance_frame=covariance_frame,
        measured=_burns(measured_burns),
    )


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


def _state(text: str) -> Array:
    """Numbers, or a file of them."""
    try:
        given = _numbers(text)
    except ValueError:
        given = [number for row in _rows(Path(text), "--state") for number in row]
    if len(given) != 6:
        raise InputError(
            "--state", f"{len(given)} numbers", "must be six, m and m/s, or their file"
        )
    return np.array(given)


def _burns(texts: Sequence[str]) -> dict[int, Array]:
    """Burns by their number, each once."""
    found: dict[int, Array] = {}
    for text in texts:
        number, burn = _burn(text)
        if number in found:
            raise InputError("--measured-burn", f"burn {number} twice", "must be given once")
        found[number] = burn
    return found


def _burn(text: str) -> tuple[int, Array]:
    number, separator, burn = text.partition("=")
    try:
        if not (separator and number.strip().isdecimal()):
            raise ValueError
        given = _numbers(burn)
        if len(given) != 3:
            raise ValueError
    except ValueError:
        allowed = "must read N=X,Y,Z: the burn's number and three numbers in m/s"
        raise InputError("--measured-burn", repr(text)[:80], allowed) from None
    return int(number), np.array(given)


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
