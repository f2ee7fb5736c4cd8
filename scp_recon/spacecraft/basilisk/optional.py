"""Basilisk is an extra, and takes seconds to import: where it is wanted, and what to say without it."""

from __future__ import annotations

from contextlib import AbstractContextManager

from scp_recon.errors import needing


def needing_basilisk(entry: str) -> AbstractContextManager[None]:
    """Around imports that need Basilisk.

    Args:
        entry: what to name in a message.

    Raises:
        InputError: if it is not installed.
    """
    return needing(entry, "sim", "Basilisk")
