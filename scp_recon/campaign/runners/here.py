"""Cases in this process, one after the other: nothing is started, and no limit is kept."""

from __future__ import annotations

from collections.abc import Generator, Iterable

from scp_recon.campaign.rows.case import Case, Done, Work, attempt


def here(work: Work, cases: Iterable[Case]) -> Generator[Done, None, None]:
    """Run cases in order."""
    for case in cases:
        yield attempt(work, case)
