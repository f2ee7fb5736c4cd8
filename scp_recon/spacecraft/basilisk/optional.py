"""Basilisk is an extra, and takes seconds to import: where it is wanted, and what to say without it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from scp_recon.errors import InputError


@contextmanager
def needing_basilisk(entry: str) -> Iterator[None]:
    """Around imports that need Basilisk.

    Args:
        entry: what to name in a message.

    Raises:
        InputError: if it is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith("Basilisk"):
            raise
        raise InputError(
            entry,
            f"no module named {error.name}",
            "needs the extra scp_recon[sim]: pip install 'scp_recon[sim]'",
        ) from None
