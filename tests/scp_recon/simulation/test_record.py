"""The file of a simulated flight, what it refuses to read, and the verdict on what it fell short of."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scp_recon.errors import InputError
from scp_recon.simulation.record import (
    ARRAYS,
    FILE_NAME,
    SCHEMA,
    Arrays,
    FlightSummary,
    inputs_digest,
    read_record,
)
from scp_recon.simulation.vehicle import check_vehicle, load_vehicle
from scp_recon.verification.causes import shortfalls
from tests.scp_recon.support import numbers, with_value

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


def save(folder: Path, content: object, named: Arrays) -> None:
    np.savez(folder / FILE_NAME, summary=np.array(json.dumps(content)), **named)  # type: ignore[arg-type]


def test_later_additions_are_ignored(tmp_path):
    save(tmp_path, entries(later=1), arrays() | {"later": np.zeros(7)})
    assert read_record(tmp_path).summary == summary()


@pytest.mark.slow
def test_numbers_are_neither_true_nor_words_nor_infinite(tmp_path):
    for place in numbers(entries()):
        for strange in (True, "1", [1.0], float("nan"), float("inf")):
            save(tmp_path, with_value(entries(), place, strange), arrays())
            with pytest.raises(InputError, match=rf"simulation\.npz: .*{place[-1]}"):
                read_record(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", ARRAYS)
def test_arrays_are_finite_numbers_that_fit_together(tmp_path, name):
    whole = arrays()
    array = whole.pop(name)
    for strange in (None, array > 0.0, array.astype(str), array[None], array[:0], array + np.nan):
        save(tmp_path, entries(), whole if strange is None else whole | {name: strange})
        with pytest.raises(InputError, match=r"simulation\.npz: .*must be"):
            read_record(tmp_path)


def test_what_is_no_record_is_named(tmp_path):
    for content in ([1], entries(schema="other"), {"schema": SCHEMA}):
        save(tmp_path, content, arrays())
        with pytest.raises(InputError, match=r"simulation\.npz"):
            read_record(tmp_path)
    (tmp_path / FILE_NAME).write_bytes(b"PK not a zip")
    np.save(tmp_path / "array.npy", np.zeros(3))
    for path in (tmp_path, tmp_path / "array.npy", tmp_path / "none"):
        with pytest.raises(InputError, match="simulation"):
            read_record(path)


def test_the_digest_knows_every_entry_of_the_vehicle(short_solution, vehicle):
    errors = vehicle.errors.model_copy(update={"imu_rad_s": 1e-3})
    other = vehicle.model_copy(update={"errors": errors})
    digests = {inputs_digest(short_solution, v) for v in (vehicle, vehicle, other)}
    assert len(digests) == 2
    first, *others = short_solution.burns
    moved = replace(first, dv_m_s=(*first.dv_m_s[:2], first.dv_m_s[2] + 1e-9))
    elsewhere = replace(short_solution, burns=[moved, *others])
    assert inputs_digest(elsewhere, vehicle) not in digests
    again = replace(short_solution, message="planned again")
    assert inputs_digest(again, vehicle) in digests


KEPT = entries()


def leg(**changes: object) -> dict[str, Any]:
    return {"legs": [KEPT["legs"][0] | changes]}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, []),
        ({"least_charge": 0.3}, []),
        ({"least_charge": 0.0}, ["least state of charge 0.000, required 0.30"]),
        ({"energy_wh": KEPT["energy_wh"] | {"short": 2.5}}, ["2.5 Wh short, required 0"]),
        (leg(ok=False, duration_s=800.0), ["delta-V mode from 100 s 800 s long, required 900 s"]),
        (
            leg(settled_s=None, settled_in_time=False),
            ["delta-V mode from 100 s steady never, required 650 s"],
        ),
    ],
)
def test_broken_limit_stands_beside_requirement(changes, said, short_solution):
    assert shortfalls(summary(**changes), short_solution) == said
    stalled = replace(short_solution, status="stalled")
    first = "the plan is stalled, required converged"
    assert shortfalls(summary(**changes), stalled) == [first, *said]


def test_vehicle_unlike_plans_spacecraft_is_warned_about(short_solution):
    """A tonne is planned for, and the packaged vehicle flown."""
    vehicle, scenario = load_vehicle(None), short_solution.scenario
    assert list(check_vehicle(vehicle, scenario)) == []
    (warning,) = check_vehicle(vehicle, scenario.replace({"spacecraft.mass_kg": 1000.0}))
    assert warning.entry == "spacecraft.mass_kg"
    assert "is flown, has 178 kg" in warning.expected
