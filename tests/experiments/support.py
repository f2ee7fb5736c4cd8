"""What several tests of this wing use."""

from __future__ import annotations

import csv
from pathlib import Path

SAMPLES = 1500
QUICK = ("--quick", "--skip-ipopt", "--samples", str(SAMPLES))


def table_of(out: Path) -> dict[str, dict[str, str]]:
    with (out / "observation_table.csv").open(encoding="utf-8", newline="") as file:
        return {row["row"]: row for row in csv.DictReader(file)}
