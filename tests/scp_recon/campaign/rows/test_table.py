"""The rows on the disk: none lost, none doubled, wherever the work stops."""

from __future__ import annotations

import errno
import resource
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow.parquet
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scp_recon import files
from scp_recon.campaign.engine.run import run_cases
from scp_recon.campaign.rows import table
from scp_recon.campaign.rows.table import JOURNAL, RESULTS, ROWS, Store, cell, kind_of, read_results
from scp_recon.campaign.runners.here import here
from scp_recon.errors import InputError
from tests.scp_recon.campaign.support import run, some_cases
from tests.scp_recon.campaign.works import Quick

COLUMNS = {"case": int, "value": float, "status": str}


def row_of(case: int) -> dict[str, Any]:
    return {"case": case, "value": case / 3.0, "status": None if case % 3 else f"ü\n{case}"}


STEPS = st.lists(
    st.one_of(
        st.integers(0, 40).map(lambda case: ("add", case)),
        st.sampled_from([("crash", 0), ("torn", 0), ("close", 0), ("before the journal", 0)]),
    ),
    max_size=60,
)


@given(STEPS, st.integers(1, 6))
def test_no_row_is_lost_or_doubled(steps: list[tuple[str, int]], part_rows: int) -> None:
    """Rows are added once each, and between them the process ends in every way that it can."""
    with TemporaryDirectory() as name, pytest.MonkeyPatch.context() as patch:
        patch.setattr(table, "PART_ROWS", part_rows)
        patch.setattr("os.fsync", lambda _: None)
        folder, expected = Path(name), set[int]()
        store = Store(folder, COLUMNS)
        for step, case in steps:
            if step == "add":
                if case not in store.done:
                    store.add(row_of(case), {})
                    expected.add(case)
                continue
            journal = folder / ROWS / JOURNAL
            if step == "before the journal":  # a part is there, and its rows still in the journal
                kept = journal.read_bytes()
                store._end_part()
                journal.write_bytes(kept)
            store.close() if step == "close" else store._journal.close()
            if step == "torn":  # as a power cut leaves a line
                with journal.open("ab") as file:
                    file.write(b'{"case": 77, "val')
            store = Store(folder, COLUMNS)
            assert store.done == expected
        path = store.finish()
        rows = pyarrow.parquet.read_table(path).to_pylist()
        assert rows == [row_of(case) for case in sorted(expected)]
        assert not (folder / ROWS).exists()


def test_a_disk_that_is_full_ends_with_one_message_and_is_continued(tmp_path: Path) -> None:
    """The system itself refuses to make a file longer, in the middle of a line."""
    cases, unlimited = some_cases(50), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2_000, unlimited[1]))
    try:
        with pytest.raises(InputError, match=r"file too large.*same command goes on"):
            run(Quick(), cases, tmp_path / "a", here)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    kept = set(read_results(tmp_path / "a").case)
    assert 0 < len(kept) < 50
    seen: list[int] = []
    table_a = run(
        Quick(), cases, tmp_path / "a", here, lambda _d, _t, row: seen.append(row and row["case"])
    )
    assert set(seen[1:]) == set(range(50)) - kept
    assert table_a.equals(run(Quick(), cases, tmp_path / "b", here))


@pytest.mark.parametrize("name", ["part-000001", RESULTS])
def test_a_disk_that_is_full_for_a_part_loses_nothing(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table, "PART_ROWS", 7)
    real = files.write_atomically

    def full(path: Path, content: Any) -> Path:
        if path.name.startswith(name):
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(path, content)

    cases = some_cases(20)
    with monkeypatch.context() as patch:
        patch.setattr(table, "write_atomically", full)
        with pytest.raises(InputError, match="no space left on device"):
            run(Quick(), cases, tmp_path / "a", here)
    assert len(read_results(tmp_path / "a")) == (7 if name != RESULTS else 20)
    assert run(Quick(), cases, tmp_path / "a", here).equals(
        run(Quick(), cases, tmp_path / "b", here)
    )


def test_two_campaigns_in_one_folder_are_refused(tmp_path: Path) -> None:
    def again(*_: object) -> None:
        with pytest.raises(InputError, match="at work"):
            run(Quick(), some_cases(3), tmp_path, here)

    run(Quick(), some_cases(3), tmp_path, here, again)
    with pytest.raises(InputError, match="holds another campaign"):
        run_cases(Quick(), some_cases(3), tmp_path, here, {"hash": "another"}, {})


@pytest.mark.parametrize("left", [RESULTS, ROWS])
def test_rows_of_an_unknown_campaign_are_no_results(left: str, tmp_path: Path) -> None:
    """As where a table was copied: it would pass for this study's."""
    (tmp_path / left).mkdir() if left == ROWS else (tmp_path / left).write_bytes(b"")
    with pytest.raises(InputError, match=f"with {left} but no campaign.json; must be a folder of"):
        run(Quick(), some_cases(3), tmp_path, here)


@pytest.mark.parametrize("text", ["{", "[]", '{"schema": "scp_recon.campaign/0"}'])
def test_a_damaged_folder_is_refused_as_such(text: str, tmp_path: Path) -> None:
    (tmp_path / "campaign.json").write_text(text)
    with pytest.raises(InputError, match="is damaged or of another version"):
        run(Quick(), some_cases(3), tmp_path, here)


def test_a_finished_campaign_is_not_run_again_and_says_so(tmp_path: Path) -> None:
    def never(*_: object) -> Any:
        raise AssertionError

    seen: list[tuple[Any, ...]] = []
    first = run(Quick(), some_cases(3), tmp_path, here)
    assert run(Quick(), some_cases(3), tmp_path, never, lambda *s: seen.append(s)).equals(first)
    assert seen == [(3, 3, None)]


def test_a_table_has_all_rows_or_is_not_written(tmp_path: Path) -> None:
    """Whatever a runner leaves out."""
    with pytest.raises(RuntimeError, match="2 rows of 3 cases"):
        run(Quick(), some_cases(3), tmp_path, lambda work, cases: here(work, list(cases)[:2]))
    assert not (tmp_path / RESULTS).exists()
    assert len(run(Quick(), some_cases(3), tmp_path, here)) == 3


def test_a_folder_without_rows_has_no_results(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must hold a campaign"):
        read_results(tmp_path)


@pytest.mark.parametrize(
    ("values", "cells"),
    [
        ([1, 2.5], [1.0, 2.5]),
        ([True, False], [True, False]),
        ([1, True], ["1", "true"]),
        (["paper", 24, [1.5, "x"]], ["paper", "24", '[1.5, "x"]']),
    ],
)
def test_a_column_holds_all_values_of_an_entry(values: list[Any], cells: list[Any]) -> None:
    found = [cell(value, kind_of(values)) for value in values]
    assert found == cells
    assert list(map(type, found)) == list(map(type, cells))
