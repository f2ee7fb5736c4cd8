"""How the tests run cases, and what they compare."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet

from scp_recon.campaign.engine.run import run_cases
from scp_recon.campaign.rows.case import Case, Runner
from scp_recon.campaign.rows.table import MEASURED, RESULTS
from scp_recon.campaign.runners.child import Limits
from scp_recon.campaign.study.cases import Cases

LIMITS = Limits(4.0, 256)
ENTRIES = {"x": float}
IDENTITY = {"hash": "of a test"}


def some_cases(count: int, seed: int = 5) -> Cases:
    return Cases(([{"x": 0.1 * i} for i in range(count)],), seed)


def run(
    work: Any, cases: Sequence[Case], folder: Path, runner: Runner, observe: Any = None
) -> pyarrow.Table:
    """The table without what was measured."""
    run_cases(work, cases, folder, runner, IDENTITY, ENTRIES, observe)
    return computed(folder)


def computed(folder: Path) -> pyarrow.Table:
    return pyarrow.parquet.read_table(folder / RESULTS).drop_columns(list(MEASURED))
