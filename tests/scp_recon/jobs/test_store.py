"""Rows on the disk: none lost, none doubled, wherever the work stops."""

import errno
import json
import resource
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scp_recon.errors import InputError
from scp_recon.jobs import store as module
from scp_recon.jobs.job import Key
from scp_recon.jobs.store import Store, read_head, read_rows
from tests import reliability
from tests.scp_recon.jobs.support import DEPENDS_ON, computed, run_all, some_jobs
from tests.scp_recon.jobs.works import Quick
from tests.scp_recon.support import raising


def row_of(key: Key) -> dict[str, Any]:
    numbers = [5e-324, int(key) / 3.0, 2**62, True]
    return {"key": key, "numbers": numbers, "text": None if int(key) % 3 else f"ü\n{key}"}


STEPS = st.lists(
    st.one_of(
        st.integers(0, 40).map(lambda key: ("add", key)),
        st.sampled_from([("crash", 0), ("torn", 0), ("close", 0)]),
    ),
    max_size=60,
)


@given(STEPS)
def test_no_row_is_lost_or_doubled(steps):
    """Rows are added once each, and between them the process ends in every way that it can."""
    with TemporaryDirectory() as name, pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.fsync", lambda _: None)
        path, expected = Path(name) / "rows.jsonl", dict[Key, Any]()
        store = Store(path, DEPENDS_ON)
        for step, key in steps:
            if step == "add":
                if key not in store:
                    store.put(key, row_of(key))
                    expected[key] = row_of(key)
                continue
            store.close()
            if step == "torn" and path.is_file():  # as a power cut leaves a line
                with path.open("ab") as file:
                    file.write(b'{"key": 77, "row')
            store = Store(path, DEPENDS_ON)
            assert dict(store.rows()) == expected
        assert dict(store.rows()) == expected
        assert not path.is_file() or dict(read_rows(path)) == expected
        store.close()


@pytest.mark.parametrize("place", [5, -5])
def test_damaged_row_is_dropped_alone(tmp_path, place):
    path = tmp_path / "rows.jsonl"
    with Store(path, DEPENDS_ON) as store:
        for key in range(3):
            store.put(key, row_of(key))
    head, *lines = path.read_bytes().splitlines(keepends=True)
    damaged = bytearray(lines[1])
    damaged[place] ^= 1
    path.write_bytes(b"".join([head, lines[0], bytes(damaged), lines[2]]))
    with Store(path, DEPENDS_ON) as store:
        assert dict(store.rows()) == {0: row_of(0), 2: row_of(2)}
        store.put(1, row_of(1))
    with Store(path, DEPENDS_ON) as store:
        assert len(store) == 3
    reliability.count(reliability.FAULTS)


def test_later_row_of_a_key_counts(tmp_path):
    with Store(tmp_path / "rows.jsonl", DEPENDS_ON) as store:
        store.put("a", {"x": 1})
        store.put("a", {"x": 2})
    lines = (tmp_path / "rows.jsonl").read_text("utf-8").splitlines()
    assert [set(json.loads(line)) for line in lines[:2]] == [
        {"schema", "depends_on"},
        {"key", "crc", "row"},
    ]
    with Store(tmp_path / "rows.jsonl", DEPENDS_ON) as store:
        assert list(store.rows()) == [("a", {"x": 2})]
        store.forget()
        assert "a" not in store
    assert [path.name for path in tmp_path.iterdir()] == []


@pytest.mark.parametrize(
    "text", ["", "{", "[]\n", '{"schema": "another", "depends_on": {}}\n{"key": 1}\n']
)
def test_foreign_rows_stay_until_the_first_put(tmp_path, text):
    path = tmp_path / "rows.jsonl"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=r"no store|Expecting"):
        read_head(path)
    with Store(path, DEPENDS_ON) as store:
        assert len(store) == 0
        assert path.read_text("utf-8") == text
        store.put(1, row_of(1))
    assert read_head(path) == DEPENDS_ON
    with Store(path, {"of": "another test"}) as store:
        assert len(store) == 0
    with Store(path, DEPENDS_ON) as store:
        assert len(store) == 1


def test_one_writer_at_a_time(tmp_path):
    with Store(tmp_path / "rows.jsonl", DEPENDS_ON), pytest.raises(InputError, match="at work"):
        Store(tmp_path / "rows.jsonl", DEPENDS_ON)
    Store(tmp_path / "rows.jsonl", DEPENDS_ON).close()


def test_full_disk_stops_and_the_run_continues(tmp_path):
    """The system itself refuses to make a file longer, in the middle of a line."""
    jobs, unlimited = some_jobs(50), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2_000, unlimited[1]))
    try:
        with pytest.raises(InputError, match=r"file too large"):
            run_all(Quick(), jobs, tmp_path / "a")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    kept = {key for key, _ in read_rows(tmp_path / "a" / "rows.jsonl")}
    assert 0 < len(kept) < 50
    seen: list[Key] = []
    rows = run_all(Quick(), jobs, tmp_path / "a", on_done=lambda key, _: seen.append(key))
    assert set(seen) == set(range(50)) - kept
    assert computed(rows) == computed(run_all(Quick(), jobs, tmp_path / "b"))
    reliability.count(reliability.FAULTS)


def test_a_row_has_its_files_before_it(tmp_path, monkeypatch):
    """A disk without room for a file has none for the row."""
    run_all(Quick(), some_jobs(1), tmp_path)
    assert (tmp_path / "files" / "0.txt").read_bytes() == b"a file"

    full = raising(OSError(errno.ENOSPC, "No space left on device"))
    monkeypatch.setattr(module, "write_atomically", full)
    with pytest.raises(InputError, match="no space left"):
        run_all(Quick(), some_jobs(2), tmp_path)
    assert [key for key, _ in read_rows(tmp_path / "rows.jsonl")] == [0]


def test_unusable_path_is_refused_and_leaves_no_lock(tmp_path):
    (tmp_path / "rows.jsonl").mkdir()
    with pytest.raises(InputError, match=r"rows.jsonl.* must be a folder"):
        Store(tmp_path / "rows.jsonl", DEPENDS_ON)
    assert [path.name for path in tmp_path.iterdir()] == ["rows.jsonl"]
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"out: .* must be a folder"):
        Store(tmp_path / "file" / "rows.jsonl", DEPENDS_ON)
