"""A record of no flight, for whatever reads one."""

from typing import Any

import numpy as np

from scp_recon.simulation.record import ARRAYS, SCHEMA, Arrays, FlightSummary

SIDES = {"wheels": 4, "panels": 5, "batteries": 2}


def arrays(**lengths: int) -> Arrays:
    """Zeros of the right shapes; samples, seconds and nodes are 3 each if not given."""
    known: dict[str | int, int] = {**SIDES, **lengths}
    sides = {name: [known.get(s, s if isinstance(s, int) else 3) for s in shape]
             for name, (shape, _) in ARRAYS.items()}  # fmt: skip
    return {name: np.zeros(shape) for name, shape in sides.items()}


def entries(**changes: Any) -> dict[str, Any]:
    """Entries of a summary, as the file has them."""
    angles = {"mean": 0.06, "q50": 0.05, "q95": 0.1, "q99.7": 0.12, "q100": 0.123}
    mode = {"mode": "delta-V", "start_s": 100.0, "duration_s": 900.0, "required_s": 900.0}
    burn = {"t_s": 0.0, "duration_s": 9.0, "planned_m_s": [0.1, 0.0, 0.0]}
    angle = {"pointing_deg": 0.02, "executed_pointing_deg": 0.1}
    return {
        "schema": SCHEMA,
        "vehicle": "DARE",
        "seed": 4,
        "policy": "open",
        "plan_hash": "0" * 64,
        "inputs_sha256": "1" * 64,
        "modes": ["delta-V", "sun-pointing", "observation"],
        "legs": [mode | {"ok": True, "settled_s": 300.0, "settled_in_time": True}],
        "burns": [burn | {"executed_m_s": [0.1, 0.0, 0.001]} | angle],
        "window_pointing_deg": {"camera": angles, "site": angles},
        "estimate_deg": angles,
        "least_charge": 0.9,
        "floor_charge": 0.3,
        "energy_wh": dict.fromkeys(("generated", "consumed", "lost", "unused", "short"), 0.0),
        "ledger_error": 1e-9,
        "dumps": 1,
        "terminal_miss": {"position_m": 10.0, "velocity_m_s": 1e-3},
        "within_3_sigma": 1.0,
        "largest_sigma_distance": 2.0,
        **changes,
    }


def summary(**changes: Any) -> FlightSummary:
    return FlightSummary.model_validate(entries(**changes), strict=False)
