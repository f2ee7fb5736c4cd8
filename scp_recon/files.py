"""Reading what the user names: text of a sane size, or a message."""

from __future__ import annotations

from pathlib import Path

from scp_recon.errors import InputError

BYTES_MAX = 100_000_000
"""Thirty times the solution of the largest grid; /dev/zero ends here and not in the memory."""


def read_text(path: Path, entry: str, kind: str) -> str:
    """UTF-8 text of a file.

    Args:
        path: of the file.
        entry: what to name in a message.
        kind: what the file must be.

    Raises:
        InputError: if it cannot be read, is too large, or is no UTF-8 text.
    """
    try:
        with path.open("rb") as file:
            data = file.read(BYTES_MAX + 1)
    except OSError as error:
        reason = (error.strerror or "unreadable").lower()
        raise InputError(entry, reason, f"must be a readable {kind}") from None
    except ValueError as error:  # of a path that no file can have
        raise InputError(entry, str(error), f"must be a readable {kind}") from None
    if len(data) > BYTES_MAX:
        raise InputError(
            entry, f"more than {BYTES_MAX // 1_000_000} megabytes", f"must be a {kind}"
        )
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(entry, f"no UTF-8 text ({error.reason})", f"must be a {kind}") from None
