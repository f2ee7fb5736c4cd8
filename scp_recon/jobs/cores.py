"""Divide short work among this machine's cores, by forking this process; let BLAS use one of them.

A copy of this process has all its imports and begins at once. Processes of `processes` take a
second to start. Results do not depend on the number of cores. One core does the work if the process
cannot be copied, or has other threads.

NumPy's and SciPy's linear algebra has one thread while this library works. Matrices of the planner are
small: several threads of BLAS wait for each other in busy loops, and a plan of whole flights takes
three times as long where another process works too.
"""

from __future__ import annotations

import os
import pickle
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ContextDecorator, ExitStack, contextmanager, suppress
from functools import partial
from threading import Lock
from typing import IO, Any, TypeVar

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
            try:
                os.close(read)  # or it would never learn that nobody reads any more
                signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends the copy
                with os.fdopen(write, "wb") as pipe:
                    pickle.dump(work(), pipe, pickle.HIGHEST_PROTOCOL)
            finally:
                os._exit(0)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    os.close(write)
    return process, os.fdopen(read, "rb")


GIVEN = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables by which a user chooses the number of threads; the choice is kept."""


class OneThread(ContextDecorator):
    """Context, and decorator of a function, inside of which BLAS has one thread.

    The number of threads belongs to the whole process. The first thread that enters sets it, and the
    last one that leaves restores the user's number; in between others come and go.
    """

    def __init__(self) -> None:
        self._lock, self._inside = Lock(), 0
        self._limit: Any = None

    def __enter__(self) -> None:
        """Set the number, unless it is set."""
        with self._lock:
            if self._inside == 0 and not any(name in os.environ for name in GIVEN):
                import scipy.linalg  # noqa: F401 -- only libraries that are loaded are limited
                from threadpoolctl import threadpool_limits

                self._limit = threadpool_limits(limits=1, user_api="blas")
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        """Restore the user's number after the last one."""
        with self._lock:
            self._inside -= 1
            if self._inside == 0 and self._limit is not None:
                from threadpoolctl import OpenBLASController

                # Only the thread that set the number of OpenBLAS could restore it otherwise.
                OpenBLASController.clear_controlling_thread(force=True)
                self._limit.restore_original_limits()
                OpenBLASController.clear_controlling_thread(force=True)
                self._limit = None


one_thread = OneThread()
"""The limit of this process, as a decorator or context."""
