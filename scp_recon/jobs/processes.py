"""Run jobs in processes of this machine, with limits; a failed process harms no other job.

The parent sends a child the work, then job by job, over a socket. The operating system ends a child
that takes too long, even if Python is blocked, by the default action of SIGALRM and SIGPROF. A child
ends itself when its parent is gone.
"""

from __future__ import annotations

import os
import pickle
import resource
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from math import inf, isfinite
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from signal import SIGALRM, SIGKILL, SIGPROF
from typing import Any

from scp_recon.errors import InputError, option
from scp_recon.jobs.job import (
    DIED,
    FAILED,
    OUT_OF_MEMORY,
    TIMED_OUT,
    Done,
    Failure,
    Job,
    Stopwatch,
    Work,
    attempt,
)

SERVE = "from scp_recon.jobs.processes import serve; serve({})"
READY = "ready"
TRIES = 3
"""Number of tries of a job that kills its process."""
GRACE_S = 5.0
"""Seconds past a job's limit after which the parent ends a child that its alarm has not ended."""
START_S = 600.0
"""Seconds that a process may take to import its modules: a busy file server is slow."""
LOOK_S = 1.0
"""Seconds between a child's checks that its parent is alive."""
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"), "1"
)
"""A process works on one core: many share a machine, and no sum depends on how many cores it has."""


@dataclass(frozen=True)
class Limits:
    """Limits of a job.

    Attributes:
        seconds, cpu_s: wall and processor time.
        memory_mb: megabytes beyond the process's own memory.
        apart: run each job in a copy of a process that has run none, and has only imported the work.
    """

    seconds: float = inf
    cpu_s: float = inf
    memory_mb: int | None = None
    apart: bool = False


class StoppedError(Exception):
    """The child was ended: its job is no longer wanted."""


class UnfitError(Exception):
    """A process cannot run any job: it lacks modules, or has other versions than the caller."""


@dataclass(frozen=True)
class Processes:
    """An executor on `count` processes."""

    workers: int
    limits: Limits = Limits()

    def __call__(self, work: Work, jobs: Iterable[Job]) -> Generator[Done, None, None]:
        """Run jobs as processes become free; they are yielded as they end.

        Raises:
            InputError: if the processes cannot load the work.
        """
        children = [Child(pickle.dumps(work), self.limits) for _ in range(self.workers)]
        left, running = iter(jobs), dict[Future[Done], Child]()
        pool = ThreadPoolExecutor(self.workers)

        def begin(child: Child) -> None:
            for job in islice(left, 1):
                running[pool.submit(child.run, job)] = child

        try:
            for child in children:
                begin(child)
            while running:
                for ended in wait(running, return_when=FIRST_COMPLETED).done:
                    done = ended.result()
                    begin(running.pop(ended))
                    yield done
        except UnfitError as error:
            allowed = "must be able to run the work"
            raise InputError(option("workers"), str(error), allowed) from None
        finally:
            for child in children:
                child.stop()
            pool.shutdown()
            for child in children:
                child.end()


class Child:
    """A process for jobs, started with the first job and restarted after it has died."""

    def __init__(self, pickled_work: bytes, limits: Limits) -> None:
        self.work, self.limits = pickled_work, limits
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection
        self._used = False
        self._stopped = threading.Event()

    def run(self, job: Job) -> Done:
        """Run a job, up to `TRIES` times while it kills the process.

        Raises:
            StoppedError: if `stop` is called during the job.
            UnfitError: if no job can be run here.
        """
        watch, status, tries = Stopwatch(), 0, 0
        limits = self.limits
        too_long = {
            -SIGALRM: f"took longer than {limits.seconds:g} s",
            -SIGPROF: f"took longer than {limits.cpu_s:g} s of the processor",
        }
        while tries < TRIES:
            tries += 1
            used = self._used
            done, status = self._try(job)
            if self._stopped.is_set():
                raise StoppedError
            if done is not None and done.failure and done.failure.status == OUT_OF_MEMORY:
                self.end()  # what it could not finish may be half done
                if used:  # and earlier jobs may have left it less than their due
                    continue
            if done is not None:
                return done._replace(tries=tries)
            if status in too_long:
                failure = Failure(TIMED_OUT, too_long[status])
                return Done(job.key, None, failure, watch.read()[0], None, tries)
        message = f"ended its process in each of {TRIES} tries, at last with status {status}"
        return Done(job.key, None, Failure(DIED, message), watch.read()[0], None, tries)

    def _try(self, job: Job) -> tuple[Done | None, int]:
        """Try a job once: its outcome, or the exit status of a process that died."""
        try:
            if self._process is None:
                self._begin()
                if (answer := self._answer(START_S)) != READY:
                    raise UnfitError(answer)
            self._used = True
            self._pipe.send(job)
            return self._answer(self.limits.seconds + GRACE_S), 0
        except TimeoutError:
            late = -SIGALRM if self._used else -SIGKILL
            self.end()
            return None, late
        except (OSError, EOFError, pickle.UnpicklingError):
            return None, self.end(patience_s=GRACE_S)

    def _answer(self, limit_s: float) -> Any:
        if not self._pipe.poll(limit_s if isfinite(limit_s) else None):
            raise TimeoutError
        return self._pipe.recv()

    def _begin(self) -> None:
        """Start a process, which sends READY once it can run jobs."""
        paths = os.pathsep.join(path or str(Path.cwd()) for path in sys.path)
        self._pipe, far = Pipe()
        with far:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", SERVE.format(far.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=2,  # what a job prints is no answer
                pass_fds=[far.fileno()],
                env={**os.environ, **ONE_THREAD, "PYTHONPATH": paths},
                start_new_session=True,  # Ctrl-C is the parent's to handle
            )
        if self._stopped.is_set():  # meanwhile
            self._process.kill()
        self._pipe.send((self.work, self.limits))

    def stop(self) -> None:
        """End the process for good, from any thread, and drop the result of its job."""
        self._stopped.set()
        process = self._process
        if process is not None:
            process.kill()

    def end(self, patience_s: float = 0.0) -> int:
        """Wait for the process to end, then kill it; its exit status. The next job starts another."""
        process, self._process, self._used = self._process, None, False
        if process is None:
            return 0
        self._pipe.close()
        with suppress(subprocess.TimeoutExpired):
            return process.wait(patience_s)
        process.kill()
        return process.wait()


def serve(socket: int) -> None:
    """Run jobs from a socket until there are no more: the main function of a child."""
    pipe = Connection(socket)
    signal.signal(SIGALRM, signal.SIG_DFL)
    signal.signal(SIGPROF, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    pickled, limits = pipe.recv()
    try:
        work = pickle.loads(pickled)
    except Exception as error:  # a module that is not here, or is another
        pipe.send(f"{type(error).__name__}: {error}")
        sys.exit(1)
    pipe.send(READY)
    _limit_memory(limits)
    timers = ((signal.ITIMER_REAL, limits.seconds), (signal.ITIMER_PROF, limits.cpu_s))
    kept = [(timer, limit_s) for timer, limit_s in timers if isfinite(limit_s)]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=RuntimeWarning)  # as `run_command` does
        while True:
            try:
                job = pipe.recv()
            except (EOFError, OSError):  # the parent is done, or gone
                return
            if limits.apart and _left_to_a_copy():
                continue
            for timer, limit_s in kept:
                signal.setitimer(timer, limit_s)
            done = attempt(work, job)
            for timer, _ in kept:
                signal.setitimer(timer, 0.0)
            pipe.send(_portable(done))
            if limits.apart:
                os._exit(0)


def _left_to_a_copy() -> bool:
    """Copy this process: False in the copy, True once that has ended well. Dies as the copy does."""
    here = os.getpid()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=DeprecationWarning)  # of the thread that watches
        copy = os.fork()
    if copy == 0:
        threading.Thread(target=_end_with, args=(here,), daemon=True).start()
        return False
    status = os.waitstatus_to_exitcode(os.waitpid(copy, 0)[1])
    if status < 0:
        os.kill(here, -status)
    elif status:
        os._exit(status)
    return True


def _portable(done: Done) -> Done:
    """A job's outcome without an exception or a result that does not pickle."""
    try:
        if done.failure and done.failure.error:
            pickle.loads(pickle.dumps(done.failure.error))
        pickle.dumps(done.value)
    except Exception as error:  # whatever a class does there
        failure = done.failure or Failure(FAILED, f"{type(error).__name__}: {error}")
        return done._replace(value=None, failure=failure._replace(error=None))
    return done


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    os._exit(1)


def _limit_memory(limits: Limits) -> None:
    """Limit the memory beyond the process's present size, where the system supports it (Linux)."""
    own = Path("/proc/self/statm")
    if limits.memory_mb is not None and own.exists():
        pages = int(own.read_text("ascii").split()[0])
        most = pages * resource.getpagesize() + limits.memory_mb * 1_000_000
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        if hard == resource.RLIM_INFINITY or most < hard:
            resource.setrlimit(resource.RLIMIT_AS, (most, hard))
