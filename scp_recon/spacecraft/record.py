"""The file of a simulated flight: arrays every few seconds, and a summary.

`docs/simulation_file.md` describes both.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scp_recon.errors import InputError
from scp_recon.files import write_atomically
from scp_recon.mission.schedule import Mode
from scp_recon.solution.file import Solution
from scp_recon.solution.part import parse_file
from scp_recon.spacecraft.flight import Flight
from scp_recon.spacecraft.guidance import CONTROL_PERIOD_S
from scp_recon.spacecraft.outcome import (
    LegOutcome,
    Pointing,
    ledger_error,
    leg_outcomes,
    node_states,
    pointing,
    sigma_distance,
    state_of_charge,
)
from scp_recon.spacecraft.summary import (
    SCHEMA,
    Angles,
    Energy,
    FlightSummary,
    FlownBurn,
    ModeOutcome,
    TerminalMiss,
    WindowPointing,
)
from scp_recon.spacecraft.vehicle import Vehicle

FILE_NAME = "simulation.npz"
SAMPLE_S = 10.0
MODES = tuple(Mode)
QUANTILES = {"q50": 0.5, "q95": 0.95, "q997": 0.997, "q100": 1.0}

ARRAYS: dict[str, tuple[str | int, ...]] = {
    "t_s": ("samples",),
    "state": ("samples", 6),
    "attitude": ("samples", 4),
    "command": ("samples", 4),
    "estimate": ("samples", 4),
    "rate_rad_s": ("samples", 3),
    "mode": ("samples",),
    "actuators": ("samples",),
    "wheel_speed_rad_s": ("samples", "wheels"),
    "panel_w": ("samples", "panels"),
    "panel_peak_w": ("panels",),
    "consumed_w": ("samples",),
    "state_of_charge": ("samples", "batteries"),
    "pointing_error_rad": ("seconds",),
    "node_state": ("nodes", 6),
    "node_sigma_distance": ("nodes",),
}
"""What every file of this schema has, with its shape: numbers, and names of lengths that are equal."""

Arrays = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Record:
    """A simulation file: arrays by name, and the summary."""

    arrays: Arrays
    summary: FlightSummary

    @property
    def plan_hash(self) -> str | None:
        """`Solution.plan_hash` of the plan flown; none in files of earlier versions."""
        return self.summary.plan_hash


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


def _summary(flight: Flight, solution: Solution, angles: Pointing, seed: int) -> FlightSummary:
    plan = flight.plan
    charge, distance = state_of_charge(flight), sigma_distance(flight, solution)
    miss = flight.terminal_state - np.array(solution.nodes.state[-1])
    return FlightSummary(
        vehicle=plan.vehicle.name,
        seed=seed,
        plan_hash=solution.plan_hash,
        inputs_sha256=inputs_digest(solution, plan.vehicle),
        modes=tuple(mode.value for mode in MODES),
        legs=tuple(_outcome(outcome) for outcome in leg_outcomes(flight)),
        burns=tuple(_burns(flight, angles)),
        window_pointing_deg=WindowPointing(
            camera=_quantiles(angles.camera), site=_quantiles(angles.site)
        ),
        estimate_deg=_quantiles(angles.estimate),
        least_charge=float(charge.min()),
        floor_charge=plan.vehicle.battery.floor_charge,
        energy_wh=_energy(flight),
        ledger_error=ledger_error(flight),
        dumps=flight.dumps,
        terminal_miss=TerminalMiss(
            position_m=float(np.linalg.norm(miss[:3])),
            velocity_m_s=float(np.linalg.norm(miss[3:])),
        ),
        within_3_sigma=float((distance <= 3.0).mean()),
        largest_sigma_distance=float(distance.max()),
    )


def _outcome(outcome: LegOutcome) -> ModeOutcome:
    """A mode against the rules."""
    return ModeOutcome(
        mode=outcome.leg.mode.value,
        start_s=outcome.leg.start_s,
        duration_s=outcome.duration_s,
        required_s=outcome.required_s,
        ok=outcome.ok,
        settled_s=outcome.settled_s if np.isfinite(outcome.settled_s) else None,
        settled_in_time=outcome.settled_in_time,
    )


def _burns(flight: Flight, angles: Pointing) -> Iterator[FlownBurn]:
    """Every burn as planned and as executed."""
    start, mean = np.rad2deg(angles.burns).tolist(), np.rad2deg(angles.executed).tolist()
    for i, firing in enumerate(flight.plan.firings):
        yield FlownBurn(
            t_s=firing.start_s,
            duration_s=firing.duration_s,
            planned_m_s=tuple(firing.dv_m_s.tolist()),
            executed_m_s=tuple(flight.burns_m_s[i].tolist()),
            pointing_deg=start[i],
            executed_pointing_deg=mean[i],
        )


def _quantiles(angle: npt.NDArray[np.float64]) -> Angles:
    """Mean and quantiles in degrees."""
    degrees = np.rad2deg(angle)
    named = {name: float(np.quantile(degrees, level)) for name, level in QUANTILES.items()}
    return Angles(mean=float(degrees.mean()), **named)


def _energy(flight: Flight) -> Energy:
    """Totals of the bus."""
    hours = CONTROL_PERIOD_S / 3600.0
    totals = {
        "generated": flight.panels_w,
        "consumed": flight.consumed_w,
        "lost": flight.lost_w,
        "unused": flight.unused_w,
        "short": flight.short_w,
    }
    return Energy(**{name: float(power[1:].sum()) * hours for name, power in totals.items()})


def write_record(record: Record, folder: Path) -> Path:
    """Write `simulation.npz` into a folder, whole or not at all.

    Raises:
        OSError: if the folder cannot be written.
    """
    buffer = io.BytesIO()
    text = np.array(json.dumps(record.summary.entries()))
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
    found = parse_file(summary, FlightSummary, [SCHEMA], f"simulation {file}")
    if strange := _strange(arrays):
        raise InputError(f"simulation {file}: {strange}", "no such array", _shape_of(strange))
    return Record(arrays, found)


def _strange(arrays: Arrays) -> str | None:
    """An array that is missing, holds no numbers, or does not fit the others."""
    lengths: dict[str | int, int] = {}
    for name, shape in ARRAYS.items():
        array = arrays.get(name)
        if array is None or array.dtype.kind not in "fiu" or array.ndim != len(shape):
            return name
        for side, length in zip(shape, array.shape, strict=True):
            expected = side if isinstance(side, int) else lengths.setdefault(side, length)
            if length != expected or not length:
                return name
        if not np.isfinite(array).all():
            return name
    return None


def _shape_of(name: str) -> str:
    return f"must be finite numbers of shape ({', '.join(map(str, ARRAYS[name]))})"
