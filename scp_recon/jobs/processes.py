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
import warnings
from collections.abc import Generator, Iterable
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from math import inf, isfinite
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from signal import SIGALRM, SIGPROF
from time import monotonic, sleep

from scp_recon.errors import InputError, option
from scp_recon.jobs.job import (
    DIED,
    FAILED,
    OUT_OF_MEMORY,
    TIMED_OUT,
    Done,
    Failure,
    Job,
    Work,
    attempt,
)

SERVE = "from scp_recon.jobs.processes import serve; serve({})"
TRIES = 3
"""Number of tries of a job that kills its process."""
GRACE_S = 5.0
"""Seconds past a job's limit after which the parent ends a child that its alarm has not ended."""
START_S = 600.0
"""Seconds more for the first job, while modules are imported: a busy file server is slow."""
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
    """

    seconds: float = inf
    cpu_s: float = inf
    memory_mb: int | None = None


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
        left = iter(jobs)

        def begin(child: Child) -> None:
            for job in islice(left, 1):
                child.begin(job)

        try:
            for child in children:
                begin(child)
            while running := {child.pipe: child for child in children if child.job is not None}:
                ready = wait(running, _until(min(child.deadline for child in running.values())))
                for pipe, child in running.items():
                    late = child.deadline <= monotonic()
                    if (pipe in ready or late) and (done := child.answer()) is not None:
                        begin(child)
                        yield done
        except UnfitError as error:
            allowed = "must be able to run the work"
            raise InputError(option("workers"), str(error), allowed) from None
        finally:
            for child in children:
                child.end()


class Child:
    """A process for jobs, started with its first job and again after it has died.

    Attributes:
        job: that is run; None while there is none.
        pipe: ready where `answer` need not wait.
        deadline: at which the process is ended, s of `monotonic`.
    """

    pipe: Connection
    deadline: float

    def __init__(self, pickled_work: bytes, limits: Limits) -> None:
        self.work, self.limits = pickled_work, limits
        self.job: Job | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._sent = 0

    def run(self, job: Job) -> Done:
        """Run a job, up to `TRIES` times while it kills the process.

        Raises:
            UnfitError: if no job can be run here.
        """
        self.begin(job)
        while (done := self.answer()) is None:
            pass
        return done

    def begin(self, job: Job) -> None:
        """Begin a job, whose outcome `answer` will have."""
        self.job, self._tries, self._begun = job, 0, monotonic()
        self._try()

    def _try(self) -> None:
        self._tries += 1
        self.deadline = monotonic() + self.limits.seconds + GRACE_S
        messages: list[object] = [self.job]
        if self._process is None:
            paths = os.pathsep.join(path or str(Path.cwd()) for path in sys.path)
            self.pipe, far = Pipe()
            with far:
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-c", SERVE.format(far.fileno())],
                    stdin=subprocess.DEVNULL,
                    stdout=2,  # what a job prints is no answer
                    pass_fds=[far.fileno()],
                    env={**os.environ, **ONE_THREAD, "PYTHONPATH": paths},
                    start_new_session=True,  # Ctrl-C is the parent's to handle
                )
            self.deadline += START_S
            messages.insert(0, (self.work, self.limits))
        self._sent += 1
        with suppress(OSError):  # it has died, which `answer` finds
            for message in messages:
                self.pipe.send(message)

    def answer(self) -> Done | None:
        """Wait for the process until the deadline; the job's outcome, None if it is tried again.

        Raises:
            UnfitError: if no job can be run here.
        """
        assert self.job is not None
        done, status = None, 0
        try:
            if self.pipe.poll(_until(self.deadline)):
                done = self.pipe.recv()
            else:
                status = -SIGALRM
                self.end()
        except (OSError, EOFError, pickle.UnpicklingError):
            status = self.end(patience_s=GRACE_S)
        if isinstance(done, str):
            raise UnfitError(done)
        if done is not None and done.failure and done.failure.status == OUT_OF_MEMORY:
            # What it could not finish may be half done, and earlier jobs may have left it too little.
            done = None if self._sent > 1 else done
            self.end()
        if done is None and (failure := self._failure(status)) is None:
            self._try()
            return None
        done = done or Done(self.job.key, None, failure, monotonic() - self._begun, None, 0)
        self.job = None
        return done._replace(tries=self._tries)

    def _failure(self, status: int) -> Failure | None:
        """The reason for which a process that ended with a status ends its job too, if it does."""
        if status == -SIGALRM:
            return Failure(TIMED_OUT, f"took longer than {self.limits.seconds:g} s")
        if status == -SIGPROF:
            return Failure(TIMED_OUT, f"took longer than {self.limits.cpu_s:g} s of the processor")
        if self._tries < TRIES:
            return None
        said = f"ended its process in each of {TRIES} tries, at last with status {status}"
        return Failure(DIED, said)

    def end(self, patience_s: float = 0.0) -> int:
        """Wait for the process to end, then kill it; its exit status. The next job starts another."""
        process, self._process, self._sent = self._process, None, 0
        if process is None:
            return 0
        self.pipe.close()
        with suppress(subprocess.TimeoutExpired):
            return process.wait(patience_s)
        process.kill()
        return process.wait()


def _until(deadline: float) -> float | None:
    """Seconds until a time of `monotonic`; None if that never comes."""
    return max(deadline - monotonic(), 0.0) if isfinite(deadline) else None


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
    _limit_memory(limits)
    timers = {signal.ITIMER_REAL: limits.seconds, signal.ITIMER_PROF: limits.cpu_s}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=RuntimeWarning)  # as `run_command` does
        while True:
            try:
                job = pipe.recv()
            except (EOFError, OSError):  # the parent is done, or gone
                return
            for timer, limit_s in timers.items():
                signal.setitimer(timer, limit_s if isfinite(limit_s) else 0.0)
            done = attempt(work, job)
            for timer in timers:
                signal.setitimer(timer, 0.0)
            pipe.send(_portable(done))


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
        sleep(LOOK_S)
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
