"""The documents of --json: SI with the unit in each key, vectors and states along J2000."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from scp_recon.interop.export import Export
from scp_recon.interop.path import WITHIN_M
from scp_recon.mission.survey import Survey
from scp_recon.physics.time_scales import iso_tdb, iso_utc
from scp_recon.results.comparison import Comparison
from scp_recon.results.solution import Solution
from scp_recon.scenario.schema import Scenario

FRAME = "J2000, body-centred"
IN_FILE = {"nodes", "facets", "iterations", "scenario", "timing_s", "units"}
"""Of a solution: what whoever wants it reads in its file."""


def plan_document(solution: Solution, files: Iterable[Path] = ()) -> dict[str, Any]:
    """A plan without its grid: verdict, burns, margins, risk, verification, warnings; and its files."""
    return {
        "scenario": solution.scenario.name,
        "frame": FRAME,
        "plan_hash": solution.plan_hash,
        "plan": {key: value for key, value in solution.document().items() if key not in IN_FILE},
        "files": [str(file) for file in files],
    }


def comparison_document(found: Comparison) -> dict[str, Any]:
    """Rows with a value for each plan."""
    return {
        "plans": list(found.names),
        "rows": [{"name": name, "unit": unit, "values": row} for name, unit, row in found.rows],
    }


def survey_document(scenario: Scenario, survey: Survey) -> dict[str, Any]:
    """Windows in s past the epoch, with when each burn may be; an end that is open is null."""
    return {
        "scenario": scenario.name,
        "epoch_tdb": scenario.epoch.tdb.isoformat(),
        "span_s": survey.span_s,
        "lit_throughout": survey.always,
        "windows": [
            {
                "edges_s": window.edges_s,
                "least_incidence_rad": window.least_incidence_rad,
                "local_solar_time_h": window.local_solar_time_h,
                "burns_s": window.burns_s,
                "epoch_shifts_s": [shift for _, shift in window.shifts_s],
            }
            for window in survey.windows
        ],
    }


def export_document(found: Export, files: Iterable[Path]) -> dict[str, Any]:
    """What was exported: the path that was flown again, its burns with their dates, and the files."""
    return {
        "verdict": found.verdict,
        "files": [str(file) for file in files],
        "frame": FRAME,
        "states": found.path.size,
        "linear_error_m": found.path.linear_error_m,
        "cubic_error_m": found.path.cubic_error_m,
        "asked_error_m": WITHIN_M,
        "burns": [
            {
                "t_s": burn.t_s,
                "tdb": iso_tdb(found.instant(burn.t_s)),
                "utc": iso_utc(found.instant(burn.t_s)),
                "dv_m_s": burn.dv_m_s,
            }
            for burn in found.solution.burns
        ],
        "plan_hash": found.solution.plan_hash,
    }
