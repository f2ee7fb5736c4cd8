"""A campaign's rows on the disk: none is lost and none is there twice, wherever the work stops.

A row goes to `rows/journal.jsonl` as it comes, and after `PART_ROWS` of them the journal becomes
`rows/part-*.parquet`. At the end the parts become `results.parquet`, in the order of the cases.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import IO, TYPE_CHECKING, Any

from scp_recon.errors import InputError, needing
from scp_recon.files import unwritable, write_atomically

if TYPE_CHECKING:
    import pandas

RESULTS, ROWS, JOURNAL = "results.parquet", "rows", "journal.jsonl"
MEASURED = ("seconds", "cpu_s", "tries")
"""Columns that differ from run to run; all others are the same to the last bit."""
PART_ROWS = 5_000
SYNC_S = 1.0
"""Seconds that a power cut may cost; what the process alone loses is nothing."""

Row = Mapping[str, Any]


def needing_parquet() -> Any:
    """The package pyarrow, with its module for Parquet.

    Raises:
        InputError: if there is none.
    """
    with needing("campaign", "campaign", "pyarrow"):
        import pyarrow
        import pyarrow.parquet
    return pyarrow


class Store:
    """Rows in a folder, which is locked by whoever has one."""

    def __init__(self, folder: Path, columns: Mapping[str, type]) -> None:
        """Take up what is there.

        Args:
            folder: of the campaign.
            columns: str, int, float or bool by column; `case` is one of them.

        Raises:
            InputError: if pyarrow is missing, or the folder cannot be written.
        """
        self.folder, self.columns = folder, columns
        self._arrow = needing_parquet()
        self._rows: list[Row] = []
        self._synced = monotonic()
        self.done: set[int] = set()
        with self._writing():
            self._home.mkdir(parents=True, exist_ok=True)
            for part in self._parts():
                cases = self._arrow.parquet.read_table(part, columns=["case"])
                self.done.update(cases["case"].to_pylist())
            if not self._parts():  # whose columns tell what the journal's rows hold
                write_atomically(self._part(0), self._bytes(self._table([])))
            self._journal = self._opened()

    @property
    def _home(self) -> Path:
        return self.folder / ROWS

    def _part(self, number: int) -> Path:
        return self._home / f"part-{number:06d}.parquet"

    def _parts(self) -> list[Path]:
        return sorted(self._home.glob("part-*.parquet"))

    def _opened(self) -> IO[bytes]:
        """The journal, without a torn line at its end and rows that a part has already."""
        path = self._home / JOURNAL
        rows = list(_whole_lines(path.read_bytes())) if path.is_file() else []
        self._rows = [row for row in rows if row["case"] not in self.done]
        self.done.update(row["case"] for row in self._rows)
        write_atomically(path, b"".join(map(_line, self._rows)))
        return path.open("ab")

    def add(self, row: Row, files: Mapping[str, bytes]) -> None:
        """Keep a row, and before it what belongs to it.

        Raises:
            InputError: if the folder cannot be written; the row counts as not done.
        """
        with self._writing():
            for name, content in files.items():
                path = self.folder / name
                path.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(path, content)
            before = self._journal.tell()
            try:
                self._journal.write(_line(row))
                self._journal.flush()
                if monotonic() - self._synced > SYNC_S:
                    os.fsync(self._journal.fileno())
                    self._synced = monotonic()
            except OSError:
                self._forget_from(before)
                raise
        self._rows.append(row)
        self.done.add(row["case"])
        if len(self._rows) >= PART_ROWS:
            self._end_part()

    def _forget_from(self, place: int) -> None:
        """Cut off what was not written whole; if that fails too the next reader does."""
        with suppress(OSError):  # which tries to write the rest
            self._journal.close()
        with suppress(OSError):
            os.truncate(self._home / JOURNAL, place)

    def _end_part(self) -> None:
        """The journal's rows become a part; what is in both after a crash is taken once."""
        if not self._rows:
            return
        with self._writing():
            content = self._bytes(self._table(self._rows))
            write_atomically(self._part(len(self._parts())), content)
            self._journal.close()
            self._rows = []
            write_atomically(self._home / JOURNAL, b"")
            self._journal = (self._home / JOURNAL).open("ab")

    def table(self) -> Any:
        """All rows in the order of the cases, as a pyarrow table."""
        parts = [self._arrow.parquet.read_table(part) for part in self._parts()]
        whole = self._arrow.concat_tables([*parts, self._table(self._rows)])
        return whole.sort_by("case")

    def finish(self) -> Path:
        """Write `results.parquet`, and take away what it was made of.

        Raises:
            InputError: if the folder cannot be written.
        """
        with self._writing():
            path = write_atomically(self.folder / RESULTS, self._bytes(self.table()))
            self._journal.close()
            for part in [*self._parts(), self._home / JOURNAL]:
                part.unlink()
            self._home.rmdir()
        return path

    def close(self) -> None:
        """Leave it so that another one takes it up."""
        with suppress(OSError):
            if not self._journal.closed:
                os.fsync(self._journal.fileno())
                self._journal.close()

    def _table(self, rows: list[Row]) -> Any:
        arrow = self._arrow
        kinds = {
            str: arrow.string(),
            int: arrow.int64(),
            float: arrow.float64(),
            bool: arrow.bool_(),
        }
        schema = arrow.schema([(name, kinds[kind]) for name, kind in self.columns.items()])
        return arrow.Table.from_pylist(rows, schema=schema)

    def _bytes(self, table: Any) -> bytes:
        buffer = io.BytesIO()
        self._arrow.parquet.write_table(table, buffer)
        return buffer.getvalue()

    def _writing(self) -> _Writing:
        return _Writing(self.folder)


class _Writing:
    """Around writes: an error of the file system is one message."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __enter__(self) -> None: ...

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, OSError):
            found = unwritable(self.folder, "--out", error)
            raise InputError(
                found.entry,
                found.given,
                f"{found.allowed}; every row until then is kept, and the same command goes on",
            ) from None


def read_results(folder: Path) -> pandas.DataFrame:
    """The rows of a campaign by case, finished or not; what is not known is missing.

    Raises:
        InputError: if there is none, or the extra is missing.
    """
    arrow = needing_parquet()
    with needing("campaign", "campaign", "pandas"):
        import pandas  # noqa: F401 -- whether it is there
    path = folder / RESULTS
    files = [path] if path.is_file() else sorted((folder / ROWS).glob("part-*.parquet"))
    journal = folder / ROWS / JOURNAL
    try:
        tables = [arrow.parquet.read_table(file) for file in files]
        rows = list(_whole_lines(journal.read_bytes())) if journal.is_file() else []
    except (OSError, arrow.ArrowException) as error:
        raise InputError("folder", str(error)[:200], "must hold a campaign") from None
    seen = {case for table in tables for case in table["case"].to_pylist()}
    rows = [row for row in rows if row["case"] not in seen]
    if not rows and not any(map(len, tables)):
        raise InputError("folder", f"{folder}, without rows", "must hold a campaign")
    if rows:
        tables.append(arrow.Table.from_pylist(rows, schema=tables[0].schema))
    found: pandas.DataFrame = arrow.concat_tables(tables).sort_by("case").to_pandas()
    return found


def status_counts(path: Path) -> dict[str, int]:
    """How the cases of a file of results ended, the most frequent first."""
    column = needing_parquet().parquet.read_table(path, columns=["status"])["status"]
    counts = {
        str(item["values"]): int(item["counts"]) for item in column.value_counts().to_pylist()
    }
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def cell(value: Any, kind: type) -> Any:
    """A value of an entry as a cell of a column; in one of text what is none becomes JSON."""
    if kind is str:
        return value if isinstance(value, str) else json.dumps(value, default=str)
    return kind(value)


def kind_of(values: Iterable[Any]) -> type:
    """What a column of such values holds; text where they are of several kinds."""
    known = list(values)
    kinds = {type(value) for value in known}
    if kinds == {bool}:
        return bool
    if kinds == {int} and all(abs(value) < 2**63 for value in known):
        return int
    return float if kinds <= {int, float} else str


def _line(row: Row) -> bytes:
    return json.dumps(row).encode() + b"\n"


def _whole_lines(data: bytes) -> Iterator[Row]:
    """Rows of a journal; what was being written when it ended is none."""
    for line in data.split(b"\n")[:-1]:
        try:
            row = json.loads(line)
        except ValueError:
            return
        yield row
