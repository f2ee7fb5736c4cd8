"""Campaigns whose rows are made by hand, to be shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scp_recon.campaign.engine.run import run_cases
from scp_recon.campaign.engine.work import FIXED
from scp_recon.campaign.rows.case import Case, Found
from scp_recon.campaign.runners.here import here
from scp_recon.campaign.study.study import Study

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


@dataclass(frozen=True)
class ByHand:
    """Feasible in the north, infeasible in the south, refused at the poles; dear by its number."""

    @property
    def columns(self) -> Mapping[str, type]:
        return FIXED

    def __call__(self, case: Case, /) -> Found:
        latitude = float(case.changes.get("site.latitude_deg", 1.0))
        if abs(latitude) > 60.0:
            return Found({"status": "refused", "message": "design: no window <at all> & none"})
        if latitude < 0.0:
            return Found({"status": "infeasible", "binds": "emission_max", "message": "no pass"})
        row: dict[str, Any] = {"status": "converged", "verdict": "verified", "asked": 0.7}
        return Found(row | {"total_dv_m_s": 0.1 + case.number / 997.0, "probability": 0.9})


def campaign_of(tables: Mapping[str, Any], folder: Path, stop_after: int | None = None) -> Study:
    """Run it by hand into a folder; stopped after so many rows if that is said."""
    study = Study.validated(tables)
    identity = {
        "hash": study.hash,
        "cases": len(study.cases),
        "entries": list(study.entries),
        "study": study.tables,
        "base": study.base.model_dump(mode="json", exclude_none=True),
    }

    def observe(done: int, _total: int, _row: Mapping[str, Any] | None) -> None:
        if done == stop_after:
            raise KeyboardInterrupt

    try:
        run_cases(ByHand(), study.cases, folder, here, identity, study.kinds, observe)
    except KeyboardInterrupt:
        assert stop_after is not None
    return study
