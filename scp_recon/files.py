"""Read text files, write files atomically, and lock folders for one run at a time."""

from __future__ import annotations

import codecs
import os
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain, count
from pathlib import Path
from select import select
from stat import S_ISFIFO
from tempfile import TemporaryFile
from typing import BinaryIO
from uuid import uuid4

from scp_recon.errors import InputError

LOCK = ".lock"
PICTURE = b"atplotlib"
"""Text in pictures of the formats that name the program which wrote them."""
PAGE = b'<meta name="generator" content="scp_recon">'
"""Text in every page."""
ENDS = 1_000_000
"""Bytes at either end of a file that are searched for a mark."""
SILENT_S = 30.0
"""Longest time without a byte from a pipe that has a writer, which may compute before it writes."""
BYTES_MAX = 100_000_000
"""Thirty times the solution of the largest grid; /dev/zero ends here and not in the memory."""


def read_text(path: Path, entry: str, kind: str, bytes_max: int = BYTES_MAX) -> str:
    """Read the UTF-8 text of a file, with or without a byte-order mark; messages name entry and kind.

    Raises:
        InputError: if it cannot be read, is too large, or is no UTF-8 text.
    """
    try:
        with open(path, "rb", opener=_without_waiting) as file:
            is_pipe = S_ISFIFO(os.fstat(file.fileno()).st_mode)
            data = _of_pipe(file, bytes_max + 1) if is_pipe else file.read(bytes_max + 1)
    except OSError as error:
        raise InputError(entry, reason_of(error), f"must be a readable {kind}") from None
    except ValueError as error:  # of a path that no file can have
        raise InputError(entry, str(error), f"must be a readable {kind}") from None
    if is_pipe and not data:
        raise InputError(entry, "a pipe into which nothing is written", f"must be a {kind}")
    if len(data) > bytes_max:
        raise InputError(
            entry, f"more than {bytes_max / 1_000_000:g} megabytes", f"must be a {kind}"
        )
    try:
        return data.removeprefix(codecs.BOM_UTF8).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(entry, f"no UTF-8 text ({error.reason})", f"must be a {kind}") from None


def _of_pipe(pipe: BinaryIO, size: int) -> bytes:
    """Bytes of a pipe until its end, or up to a size."""
    data, number = b"", pipe.fileno()
    os.set_blocking(number, False)  # `select` would wait for a first writer too
    while len(data) < size:
        try:
            more = os.read(number, size - len(data))
        except BlockingIOError:
            if not select([number], [], [], SILENT_S)[0]:
                words = f"a pipe into which nothing is written for {SILENT_S:g} s"
                raise TimeoutError(None, words) from None
            continue
        if not more:
            break
        data += more
    return data


def _without_waiting(path: str, flags: int) -> int:
    """Open a file; a pipe that nothing writes to is at its end, and its writer is not waited for."""
    opened = os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
    if hasattr(os, "O_NONBLOCK"):
        os.set_blocking(opened, True)
    return opened


def reason_of(error: OSError) -> str:
    """The reason why a file could not be read or written, in words that follow "got"."""
    if isinstance(error, IsADirectoryError):
        return "a folder"
    return (error.strerror or "unusable").lower()


def check_ending(file: Path, entry: str, *endings: str) -> None:
    """Refuse the name of a file to write without one of some endings, such as .html, in any letters."""
    if file.is_dir() or file.suffix.lower() not in endings:
        allowed = f"must be a file that ends in {' or '.join(endings)}"
        raise InputError(entry, str(file), allowed)


def check_writable(folder: Path, name: str, entry: str) -> None:
    """Make a folder, and check before the work that a file of that name can be written there."""
    file = folder / name
    with writing(folder, entry):
        folder.mkdir(parents=True, exist_ok=True)
        if file.is_dir():
            raise InputError(entry, str(file), "must not be a folder")
        with TemporaryFile(dir=folder):
            pass


def unwritable(folder: Path, entry: str, error: OSError) -> InputError:
    """Error for a folder that cannot be written."""
    reason = reason_of(error)
    if isinstance(error, IsADirectoryError) and error.filename:
        reason = f"{Path(error.filename).name} is a folder"
    return InputError(entry, f"{folder} ({reason})", "must be a folder to write to")


@contextmanager
def writing(folder: Path, entry: str) -> Iterator[None]:
    """Context that turns a failure to write a file into the error of its folder."""
    try:
        yield
    except OSError as error:
        raise unwritable(folder, entry, error) from None


def check_own(file: Path, entry: str, mark: bytes, *endings: str) -> None:
    """Refuse to overwrite a file that this program did not write; or a name without its ending.

    A file of ours has the mark in its first megabyte or in its last; endings, such as .html, may be any
    where none are given.
    """
    if endings:
        check_ending(file, entry, *endings)
    with writing(file.parent, entry):
        if not file.exists() or file.is_dir():
            return  # a folder is refused by `check_writable`
        if file.is_file():
            with file.open("rb") as opened:
                begin = opened.read(ENDS)
                opened.seek(max(0, file.stat().st_size - ENDS))
                if mark in begin or mark in opened.read(ENDS):
                    return
    given = f"{file}, which holds something else"
    raise InputError(entry, given, "must be a new file, or one that this command wrote")


def write_for(entry: str, path: Path, content: str | bytes) -> Path:
    """Write a file atomically; a failure is the error of its folder, by the entry."""
    with writing(path.parent, entry):
        return write_atomically(path, content)


def write_atomically(path: Path, content: str | bytes) -> Path:
    """Write a temporary file and rename it, so that a reader sees the old file or the new one."""
    beside = path.with_name(f".{path.name}.{uuid4().hex}")
    try:
        with beside.open("xb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise
    return path


def set_aside(path: Path, to: Path) -> Path:
    """Rename a file, to a numbered name where another file has that name."""
    names = (to.with_name(f"{to.stem}_{number}{to.suffix}") for number in count(2))
    free = next(file for file in chain([to], names) if not os.path.lexists(file))
    return path.rename(free)


@contextmanager
def only_run_in(folder: Path, entry: str, name: str = LOCK) -> Iterator[None]:
    """Keep other runs out of a folder that exists; a lock left by a dead process does not count.

    `name` is of the lock file, if the lock is not for the whole folder.

    Raises:
        InputError: if another process is at work in it.
    """
    from filelock import SoftFileLock, Timeout

    lock = SoftFileLock(folder / name, timeout=0.0)
    try:
        lock.acquire()
    except Timeout:
        who = f"process {lock.pid}" if lock.pid else "another process"
        raise InputError(
            entry, f"{folder}, in which {who} is at work", "must be a folder of one run at a time"
        ) from None
    except OSError as error:
        raise unwritable(folder, entry, error) from None
    try:
        yield
    finally:
        lock.release()
