"""Keep rows of finished work in one file, so that stopped work continues without loss.

Each row is a line of JSON with its checksum. The first line holds everything that all rows depend
on. If it differs, the next row replaces the file. A row is on the disk when `put` returns, except
after a power cut. An incomplete last line is removed, and its job is done again.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from time import monotonic
from typing import IO, Any, NamedTuple, Self

from scp_recon.errors import InputError, option, version_of
from scp_recon.files import only_run_in, unwritable, write_atomically, writing
from scp_recon.jobs.job import Done, Executor, Job, Key, Work, here

SCHEMA = "scp_recon.jobs/1"
SYNC_S = 1.0
"""Seconds of work that a power cut may cost; what the process alone loses is nothing."""
OUT = option("out")
"""Name of the folder in messages."""
PACKAGES = ("scp_recon", "numpy", "scipy", "cvxpy", "clarabel")
"""Packages on whose versions the last bits of a result depend."""

Values = Mapping[str, Any]


class Row(NamedTuple):
    """A job's row: values that JSON can hold, and contents of files in the store's folder, by path.

    The files are written before the row.
    """

    values: Values
    files: Mapping[str, bytes] = {}


class Store:
    """Rows by key in a file, which one process at a time may open; its folder is created.

    `depends_on`, as JSON, is all that the rows depend on besides their jobs: entries of scenarios,
    options, and a version of the work, which is raised by hand when results change. Rows of a file
    that depends on anything else are ignored.

    Raises:
        InputError: if another process has it open, or the folder cannot be written.
    """

    def __init__(self, path: Path, depends_on: Values) -> None:
        self.path = path
        head = {"schema": SCHEMA, "depends_on": depends_on}
        self._head = json.dumps(head, sort_keys=True, default=str).encode() + b"\n"
        self._places: dict[Key, int] = {}
        self._end = 0  # of the last whole line; 0 where there are no rows of ours
        self._synced = monotonic()
        self._open = ExitStack()
        with writing(path.parent, OUT):
            path.parent.mkdir(parents=True, exist_ok=True)
        self._open.enter_context(only_run_in(path.parent, OUT, f".{path.name}.lock"))
        try:
            with writing(path.parent, OUT), suppress(FileNotFoundError), path.open("rb") as file:
                if file.readline() == self._head:
                    self._end = file.tell()
                    for key, _, place, self._end in _lines(file):
                        self._places[key] = place
        except InputError:
            self._open.close()
            raise

    def __enter__(self) -> Self:
        """The store itself, closed at the end."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        """Number of rows."""
        return len(self._places)

    def __contains__(self, key: Key) -> bool:
        """Whether a job has its row."""
        return key in self._places

    def __getitem__(self, key: Key) -> dict[str, Any]:
        """A row's values.

        Raises:
            KeyError: if there are none.
        """
        place = self._places[key]
        with self.path.open("rb") as file:
            file.seek(place)
            row: dict[str, Any] = json.loads(file.readline())["row"]
        return row

    def rows(self) -> Iterator[tuple[Key, dict[str, Any]]]:
        """Yield keys and values, in the order in which they were put."""
        return ((key, self[key]) for key in list(self._places))

    def put(self, key: Key, values: Values, files: Mapping[str, bytes] | None = None) -> None:
        """Keep a row's files, then the row, in place of an earlier one with its key.

        Raises:
            InputError: if the folder cannot be written; the row then counts as not done.
        """
        try:
            for name, content in (files or {}).items():
                path = self.path.parent / name
                path.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(path, content)
            self._append(key, _line(key, values))
        except OSError as error:
            found = unwritable(self.path.parent, OUT, error)
            allowed = f"{found.allowed}; all rows so far are kept; run the same command to continue"
            raise InputError(found.entry, found.given, allowed) from None

    def _append(self, key: Key, line: bytes) -> None:
        if not self._end:
            write_atomically(self.path, self._head)
            self._end = len(self._head)
        try:
            with self.path.open("r+b") as file:
                file.truncate(self._end)
                file.seek(self._end)
                file.write(line)
                file.flush()
                if monotonic() - self._synced > SYNC_S:
                    os.fsync(file.fileno())
                    self._synced = monotonic()
        except OSError:
            with suppress(OSError):
                os.truncate(self.path, self._end)
            raise
        self._places[key] = self._end
        self._end += len(line)

    def forget(self) -> None:
        """Delete the file, once its rows are kept elsewhere."""
        self._places, self._end = {}, 0
        self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Let another process open the file."""
        with suppress(OSError), self.path.open("rb") as file:
            os.fsync(file.fileno())
        self._open.close()


def run(
    work: Work,
    jobs: Iterable[Job],
    store: Store,
    executor: Executor | None = None,
    *,
    row_of: Callable[[Done], Row] = lambda done: Row(done.result()),
    on_done: Callable[[Key, Values], None] | None = None,
) -> None:
    """Run the jobs that have no row in a store, and keep each row as its job ends.

    Without an executor jobs run in this process. Without `row_of` the work returns the row's values,
    and a failure is raised. `on_done` is called with the key and the values of each row once kept.

    Raises:
        InputError: if the store cannot be written, or the executor cannot run the work.
    """
    missing = (job for job in jobs if job.key not in store)
    with closing((executor or here)(work, missing)) as ended:
        for done in ended:
            row = row_of(done)
            store.put(done.key, row.values, row.files)
            if on_done:
                on_done(done.key, row.values)


def read_head(path: Path) -> dict[str, Any]:
    """Read what the rows of a file depend on.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if it is no store.
    """
    with path.open("rb") as file:
        head = json.loads(file.readline())
    if not isinstance(head, dict) or head.get("schema") != SCHEMA:
        raise ValueError(f"{path} is no store of jobs")
    found: dict[str, Any] = head["depends_on"]
    return found


def read_rows(path: Path) -> Iterator[tuple[Key, dict[str, Any]]]:
    """Yield keys and values of a file that may be in use; of rows with one key the last counts."""
    with path.open("rb") as file:
        file.readline()
        for key, row, _, _ in _lines(file):
            yield key, row


def _lines(file: IO[bytes]) -> Iterator[tuple[Key, dict[str, Any], int, int]]:
    """Yield key, values, start and end of every line that is whole and has its checksum."""
    end = file.tell()
    for line in file:
        place, end = end, end + len(line)
        if not line.endswith(b"\n"):
            return
        try:
            entry = json.loads(line)
            key, row = entry["key"], entry["row"]
            if line == _line(key, row):
                yield key, row, place, end
        except (ValueError, KeyError, TypeError):
            continue  # damaged: its job is done again


def _line(key: Key, values: Values) -> bytes:
    row = json.dumps(values)
    return (
        f'{{"key": {json.dumps(key)}, "crc": {zlib.crc32(row.encode())}, "row": {row}}}\n'.encode()
    )


def versions() -> dict[str, str]:
    """Versions by name of the packages on which the last bits of a result depend."""
    return {name: version_of(name) for name in PACKAGES}
