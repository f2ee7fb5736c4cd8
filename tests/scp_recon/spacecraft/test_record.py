from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scp_recon import simulate
from scp_recon.errors import InputError
from scp_recon.solution.file import Solution
from scp_recon.spacecraft.flight import Flight
from scp_recon.spacecraft.record import (
    ARRAYS,
    FILE_NAME,
    KEYS,
    SCHEMA,
    Record,
    inputs_digest,
    make_record,
    read_record,
    write_record,
)
from scp_recon.spacecraft.vehicle import Vehicle

WHOLE: dict[str, Any] = dict.fromkeys(KEYS) | {"schema": SCHEMA}


def test_a_record_is_read_as_it_was_written(
    perfect: Flight, short_solution: Solution, tmp_path: Path
) -> None:
    record = make_record(perfect, short_solution, 0)
    assert set(record.arrays) == set(ARRAYS)
    assert set(KEYS) <= set(record.summary)
    write_record(record, tmp_path)
    again = read_record(tmp_path)
    assert again.summary == record.summary
    assert again.plan_hash == short_solution.plan_hash
    for name in ARRAYS:
        np.testing.assert_array_equal(again.arrays[name], record.arrays[name])


@pytest.mark.parametrize("entry", [{}, {"plan_hash": None}, {"plan_hash": 5}])
def test_an_older_file_is_of_an_unknown_plan(tmp_path: Path, entry: dict[str, Any]) -> None:
    write_record(Record(dict.fromkeys(ARRAYS, np.zeros(1)), WHOLE | entry), tmp_path)
    assert read_record(tmp_path).plan_hash is None


@pytest.mark.parametrize(
    ("summary", "arrays"),
    [
        ([1], ARRAYS),
        ({**WHOLE, "schema": "other"}, ARRAYS),
        ({key: WHOLE[key] for key in KEYS if key != "burns"}, ARRAYS),
        (WHOLE, ARRAYS[1:]),
    ],
)
def test_what_is_no_record_is_named(tmp_path: Path, summary: object, arrays: list[str]) -> None:
    named = {name: np.zeros(1) for name in arrays}
    np.savez(tmp_path / FILE_NAME, summary=np.array(json.dumps(summary)), **named)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"simulation\.npz"):
        read_record(tmp_path)


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    (tmp_path / FILE_NAME).write_bytes(b"PK not a zip")
    np.save(tmp_path / "array.npy", np.zeros(3))
    for path in (tmp_path, tmp_path / "array.npy", tmp_path / "none"):
        with pytest.raises(InputError, match="simulation"):
            read_record(path)


def test_the_digest_knows_every_entry_of_the_vehicle(
    short_solution: Solution, vehicle: Vehicle
) -> None:
    errors = vehicle.errors.model_copy(update={"imu_rad_s": 1e-3})
    other = vehicle.model_copy(update={"errors": errors})
    digests = {inputs_digest(short_solution, v) for v in (vehicle, vehicle, other)}
    assert len(digests) == 2
    first, *others = short_solution.burns
    moved = first.model_copy(update={"dv_m_s": (*first.dv_m_s[:2], first.dv_m_s[2] + 1e-9)})
    elsewhere = short_solution.model_copy(update={"burns": [moved, *others]})
    assert inputs_digest(elsewhere, vehicle) not in digests
    again = short_solution.model_copy(update={"message": "planned again"})
    assert inputs_digest(again, vehicle) in digests


def test_a_simulation_is_one_document_with_json(
    perfect: Flight,
    short_solution: Solution,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(simulate, "_flight", lambda *_: perfect)
    short_solution.write(tmp_path)
    status = simulate.main([str(tmp_path), "--json", "--quiet"])
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert (document["command"], document["status"]) == ("simulate", status)
    assert document["summary"]["terminal_miss"]["position_m"] > 0.0
    assert said.err == ""
