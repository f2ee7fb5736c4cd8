"""The file of a simulated flight: arrays every few seconds, and a summary.

`docs/simulation_file.md` describes both.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scp_recon.errors import InputError
from scp_recon.files import write_atomically
from scp_recon.mission.schedule import Mode
from scp_recon.solution.file import Solution
from scp_recon.spacecraft.flight import Flight
from scp_recon.spacecraft.guidance import CONTROL_PERIOD_S
from scp_recon.spacecraft.outcome import (
    Pointing,
    ledger_error,
    leg_outcomes,
    node_states,
    pointing,
    sigma_distance,
    state_of_charge,
)
from scp_recon.spacecraft.vehicle import Vehicle

SCHEMA = "scp_recon.simulation/1"
FILE_NAME = "simulation.npz"
SAMPLE_S = 10.0
MODES = tuple(Mode)
QUANTILES = (0.5, 0.95, 0.997, 1.0)

ARRAYS = (
    "t_s", "state", "attitude", "command", "estimate", "rate_rad_s", "mode", "actuators",
    "wheel_speed_rad_s", "panel_w", "panel_peak_w", "consumed_w", "state_of_charge",
    "pointing_error_rad", "node_state", "node_sigma_distance",
)  # fmt: skip
KEYS = (
    "schema", "vehicle", "seed", "modes", "legs", "burns", "window_pointing_deg", "estimate_deg",
    "least_charge", "floor_charge", "energy_wh", "ledger_error", "dumps", "terminal_miss",
    "within_3_sigma", "largest_sigma_distance",
)  # fmt: skip
"""What every file of this schema has; what was added later may be missing."""

Arrays = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Record:
    """A simulation file: arrays by name, and the summary."""

    arrays: Arrays
    summary: dict[str, Any]

    @property
    def plan_hash(self) -> str | None:
        """`Solution.plan_hash` of the plan flown; none in files of earlier versions."""
        found = self.summary.get("plan_hash")
        return found if isinstance(found, str) else None


def make_record(flight: Flight, solution: Solution, seed: int) -> Record:
    """Collect what is worth keeping of a flight."""
    every = round(SAMPLE_S / CONTROL_PERIOD_S)
    angles, plan = pointing(flight), flight.plan
    mode = np.zeros(len(flight.times_s), dtype=np.int8)
    for leg in plan.legs:
        mode[flight.times_s >= leg.start_s] = MODES.index(leg.mode)
    arrays: Arrays = {
        "t_s": flight.times_s[::every],
        "state": flight.states[::every],
        "attitude": flight.attitudes[::every].as_quat(canonical=True, scalar_first=True),
        "command": flight.commands[::every].as_quat(canonical=True, scalar_first=True),
        "estimate": flight.estimates[::every].as_quat(canonical=True, scalar_first=True),
        "rate_rad_s": flight.rates_rad_s[::every],
        "mode": mode[::every],
        "actuators": flight.in_use[::every],
        "wheel_speed_rad_s": flight.wheel_speeds_rad_s[::every],
        "panel_w": flight.panels_w[::every],
        "panel_peak_w": plan.panels.peak_w,
        "consumed_w": flight.consumed_w[::every],
        "state_of_charge": state_of_charge(flight)[::every],
        "pointing_error_rad": angles.attitude.astype(np.float32),
        "node_state": node_states(flight, solution),
        "node_sigma_distance": sigma_distance(flight, solution),
    }
    return Record(arrays, _summary(flight, solution, angles, seed))


def inputs_digest(solution: Solution, vehicle: Vehicle) -> str:
    """SHA-256 of what is flown: plan and vehicle; flights of the same differ by the seed."""
    inputs = {"plan_hash": solution.plan_hash, "vehicle": vehicle.model_dump(mode="json")}
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


def _summary(flight: Flight, solution: Solution, angles: Pointing, seed: int) -> dict[str, Any]:
    plan = flight.plan
    charge, distance = state_of_charge(flight), sigma_distance(flight, solution)
    miss = flight.terminal_state - np.array(solution.nodes.state[-1])
    return {
        "schema": SCHEMA,
        "vehicle": plan.vehicle.name,
        "seed": seed,
        "plan_hash": solution.plan_hash,
        "inputs_sha256": inputs_digest(solution, plan.vehicle),
        "modes": list(MODES),
        "legs": _legs(flight),
        "burns": _burns(flight, angles),
        "window_pointing_deg": {"camera": _spread(angles.camera), "site": _spread(angles.site)},
        "estimate_deg": _spread(angles.estimate),
        "least_charge": float(charge.min()),
        "floor_charge": plan.vehicle.battery.floor_charge,
        "energy_wh": _energy(flight),
        "ledger_error": ledger_error(flight),
        "dumps": flight.dumps,
        "terminal_miss": {
            "position_m": float(np.linalg.norm(miss[:3])),
            "velocity_m_s": float(np.linalg.norm(miss[3:])),
        },
        "within_3_sigma": float((distance <= 3.0).mean()),
        "largest_sigma_distance": float(distance.max()),
    }


def _legs(flight: Flight) -> list[dict[str, Any]]:
    """Every mode against the rules."""
    return [
        {
            "mode": outcome.leg.mode,
            "start_s": outcome.leg.start_s,
            "duration_s": outcome.duration_s,
            "required_s": outcome.required_s,
            "ok": outcome.ok,
            "settled_s": outcome.settled_s if np.isfinite(outcome.settled_s) else None,
            "settled_in_time": outcome.settled_in_time,
        }
        for outcome in leg_outcomes(flight)
    ]


def _burns(flight: Flight, angles: Pointing) -> list[dict[str, Any]]:
    """Every burn as planned and as executed."""
    start, mean = np.rad2deg(angles.burns).tolist(), np.rad2deg(angles.executed).tolist()
    return [
        {
            "t_s": firing.start_s,
            "duration_s": firing.duration_s,
            "planned_m_s": firing.dv_m_s.tolist(),
            "executed_m_s": flight.burns_m_s[i].tolist(),
            "pointing_deg": start[i],
            "executed_pointing_deg": mean[i],
        }
        for i, firing in enumerate(flight.plan.firings)
    ]


def _spread(angle: npt.NDArray[np.float64]) -> dict[str, float]:
    """Mean and quantiles in degrees."""
    degrees = np.rad2deg(angle)
    named = {f"q{100 * q:g}": float(np.quantile(degrees, q)) for q in QUANTILES}
    return {"mean": float(degrees.mean()), **named}


def _energy(flight: Flight) -> dict[str, float]:
    """Totals of the bus."""
    hours = CONTROL_PERIOD_S / 3600.0
    totals = {
        "generated": flight.panels_w,
        "consumed": flight.consumed_w,
        "lost": flight.lost_w,
        "unused": flight.unused_w,
        "short": flight.short_w,
    }
    return {name: float(power[1:].sum()) * hours for name, power in totals.items()}


def write_record(record: Record, folder: Path) -> Path:
    """Write `simulation.npz` into a folder, whole or not at all.

    Raises:
        OSError: if the folder cannot be written.
    """
    buffer = io.BytesIO()
    text = np.array(json.dumps(record.summary))
    np.savez_compressed(buffer, allow_pickle=False, summary=text, **record.arrays)
    return write_atomically(folder / FILE_NAME, buffer.getvalue())


def read_record(path: Path) -> Record:
    """Read a simulation file, or the one in a folder.

    Raises:
        InputError: if there is none, it is of another version or it is damaged.
    """
    file = path / FILE_NAME if path.is_dir() else path
    try:
        with file.open("rb") as stream, zipfile.ZipFile(stream):
            pass  # or it is no archive, of which NumPy has other readers
        with np.load(file, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files if name != "summary"}
            summary = json.loads(str(data["summary"]))
    except OSError as error:
        reason = (error.strerror or "unreadable").lower()
        raise InputError(f"simulation {file}", reason, "must be a readable file") from None
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(
            f"simulation {file}", str(error)[:80], "must be a simulation file"
        ) from None
    if not isinstance(summary, dict):
        raise InputError(f"simulation {file}", "a summary that is no object", "must be one")
    if summary.get("schema") != SCHEMA:
        given = repr(summary.get("schema"))[:80]
        raise InputError(f"simulation {file}", given, f"schema must be {SCHEMA!r}")
    missing = [name for name in (*ARRAYS, *KEYS) if name not in arrays and name not in summary]
    if missing:
        raise InputError(f"simulation {file}", f"no {missing[0]}", "must have every entry")
    return Record(arrays, summary)
