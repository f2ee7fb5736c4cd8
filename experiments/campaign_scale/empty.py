"""A case in which nothing is done; processes that run it import this alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from scp_recon.campaign.rows.case import Case, Found


@dataclass(frozen=True)
class Empty:
    """Does nothing."""

    @property
    def columns(self) -> Mapping[str, type]:
        """Of its rows."""
        return {"status": str}

    def __call__(self, _case: Case, /) -> Found:
        """At once."""
        return Found({"status": "converged"})
