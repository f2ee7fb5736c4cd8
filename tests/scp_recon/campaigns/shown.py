"""Campaigns whose rows are made by hand, to be shown; what tests compare of a table."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow.parquet

from scp_recon.campaigns.axes import Case
from scp_recon.campaigns.run import MEASURED, RESULTS, run_study
from scp_recon.campaigns.study import Study
from scp_recon.jobs.job import here
from scp_recon.jobs.store import Row

PLACES = {
    "axis": [{"spread": {"count": 24, "noon_at_s": 14_838.0}}],
    "campaign": {
        "base": "kingfisher",
        "do": "design",
        "overrides": {"design.departure_s": [0.0, 0.0], "polytopes.ball": "tangent"},
    },
}
ERRORS = {
    "axis": [
        {"entry": "uncertainty.execution_error", "values": [0.02, 0.04, 0.08, 0.16]},
        {
            "entries": ["battery.delta_v_cone_deg", "battery.observation_cone_deg"],
            "values": [[10.0, 8.0], [20.0, 16.0]],
        },
    ]
}


def by_hand(case: Case, /) -> Row:
    """Feasible in the north, infeasible in the south, refused at the poles; dear by its number."""
    latitude = float(case.changes.get("site.latitude_deg", 1.0))
    if abs(latitude) > 60.0:
        return Row({"status": "refused", "message": "design: no window <at all> & none"})
    if latitude < 0.0:
        return Row({"status": "infeasible", "binds": "emission_max", "message": "no pass"})
    row: dict[str, Any] = {"status": "converged", "verdict": "verified", "asked": 0.7}
    cost = 0.1 + case.number / 997.0
    return Row(row | {"total_dv_m_s": cost, "dv99_m_s": cost, "probability": 0.9})


def campaign_of(tables: Mapping[str, Any], folder: Path, stop_after: int | None = None) -> Study:
    """Run it by hand into a folder; stopped after so many rows if that is said."""
    study = Study.validated(tables)

    def observe(done: int, _total: int, _row: Mapping[str, Any] | None) -> None:
        if done == stop_after:
            raise KeyboardInterrupt

    try:
        run_study(study, folder, by_hand, here, observe)
    except KeyboardInterrupt:
        assert stop_after is not None
    return study


def table_of(folder: Path) -> pyarrow.Table:
    """The table without what was measured."""
    return pyarrow.parquet.read_table(folder / RESULTS).drop_columns(list(MEASURED))
