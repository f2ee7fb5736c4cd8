"""The part of a campaign's table that the tests compare."""

from pathlib import Path

import pyarrow.parquet

from scp_recon.campaigns.results import MEASURED, RESULTS


def table_of(folder: Path) -> pyarrow.Table:
    """The table without what was measured."""
    return pyarrow.parquet.read_table(folder / RESULTS).drop_columns(list(MEASURED))
