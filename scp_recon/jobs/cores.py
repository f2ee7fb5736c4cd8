"""Divide short work among this machine's cores, by forking this process.

A copy of this process has all its imports and begins at once. Processes of `processes` take a
second to start. Results do not depend on the number of cores. One core does the work if the process
cannot be copied, or has other threads.
"""

from __future__ import annotations

import os
import pickle
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import IO, TypeVar

CORES = "OMP_NUM_THREADS"
"""Says how many cores a process may use, as it says to NumPy."""
WORKERS_MAX = 256
"""Most processes that a command may be asked to start."""
FIRST = os.getpid()
"""The process that is not a copy."""

Item = TypeVar("Item")
Result = TypeVar("Result")


def each(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    report: Callable[[int], None] | None = None,
) -> list[Result]:
    """A function's results in the order of the items; the results must pickle.

    Each core has an interleaved share of the items, this process the first. `report` is called at times
    with the estimated number of finished items.
    """
    count = max(1, min(cores(), len(items)))

    def done(first: int) -> list[Result]:
        found = []
        for item in items[first::count]:
            found.append(function(item))
            if report and first == 0:
                report(min(len(items), len(found) * count))
        return found

    with ExitStack() as stack:
        others = [stack.enter_context(beside(partial(done, k))) for k in range(1, count)]
        shares = [done(0), *(other() for other in others)]
    return [shares[k % count][k // count] for k in range(len(items))]


@contextmanager
def beside(work: Callable[[], Result]) -> Iterator[Callable[[], Result]]:
    """Do work on another core; yield a function that waits for the result, which must pickle.

    Without another core, or if the copy fails, that function does the work.
    """
    child = _copied(work) if cores() > 1 else None
    if child is None:
        yield work
        return
    process, pipe = child

    def result() -> Result:
        try:
            found: Result = pickle.load(pipe)
        except (OSError, EOFError, pickle.UnpicklingError):  # an exception is raised again, here
            return work()
        return found

    try:
        yield result
    finally:
        pipe.close()
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
        with suppress(ChildProcessError):
            os.waitpid(process, 0)


def cores() -> int:
    """Number of cores that this process may use; 1 where it cannot be copied, or is a copy."""
    alone = threading.active_count() == 1 and threading.current_thread() is threading.main_thread()
    if not alone or os.getpid() != FIRST or not hasattr(os, "sched_getaffinity"):
        return 1
    here, limit = len(os.sched_getaffinity(0)), os.environ.get(CORES, "")
    return min(here, int(limit)) if limit.isdigit() and limit.strip("0") else here


def _copied(work: Callable[[], object]) -> tuple[int, IO[bytes]] | None:
    """Fork a copy of this process that does work; return it with the pipe to read its result from."""
    read, write = os.pipe()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=DeprecationWarning)  # NumPy's threads
            process = os.fork()
    except OSError:
        os.close(read)
        os.close(write)
        return None
    else:
        if process == 0:
            os.close(read)  # or it would never learn that nobody reads any more
            _do(work, write)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    os.close(write)
    return process, os.fdopen(read, "rb")


def _do(work: Callable[[], object], write: int) -> None:
    """Main function of a copy; the first process handles Ctrl-C and ends the copy."""
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        with os.fdopen(write, "wb") as pipe:
            pickle.dump(work(), pipe, pickle.HIGHEST_PROTOCOL)
    finally:
        os._exit(0)
