"""A process of its own for cases, which may hang, eat memory or die without taking more with it.

`serve` is what runs in it. The parent writes pickles to its standard input and reads them from its
standard output: first the work, then case by case.
"""

from __future__ import annotations

import os
import pickle
import select
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from signal import SIGALRM, SIGKILL
from typing import IO, Any

from scp_recon.campaign.rows.case import (
    DIED,
    OUT_OF_MEMORY,
    TIMED_OUT,
    Case,
    Done,
    Stopwatch,
    trouble,
)

SERVE = "scp_recon.campaign.runners.serve"
READY = "ready"
TRIES = 3
"""How often a case is tried that kills its process."""
GRACE_S = 5.0
"""Seconds past a case's limit after which the parent ends a child that its alarm has not ended."""
START_S = 600.0
"""Seconds that a process may take to read its modules: a busy file server is slow."""
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"), "1"
)
"""A process works on one core: many share a machine, and no sum depends on how many cores it has."""


@dataclass(frozen=True)
class Limits:
    """Limits of a case: wall time in s, memory beyond the process's own in megabytes."""

    seconds: float = 600.0
    memory_mb: int = 4096


class StoppedError(Exception):
    """The child was ended because nobody wants its case any more."""


class UnfitError(Exception):
    """A process cannot run any case: it lacks modules, or has other versions than the campaign."""


class Child:
    """A process for cases, begun with the first one and again after it has died."""

    def __init__(self, pickled_work: bytes, limits: Limits) -> None:
        self.work, self.limits = pickled_work, limits
        self._process: subprocess.Popen[bytes] | None = None
        self._used = False
        self._stopped = threading.Event()

    def run(self, case: Case) -> Done:
        """Run a case, up to `TRIES` times while it kills the process.

        Raises:
            StoppedError: if `stop` was called meanwhile.
            UnfitError: if no case can be run here.
        """
        watch, ended, tries = Stopwatch(), 0, 0
        while tries < TRIES:
            tries += 1
            used = self._used
            done, ended = self._try(case)
            if self._stopped.is_set():
                raise StoppedError
            if done is not None and done.found.row.get("status") == OUT_OF_MEMORY:
                self.end()  # what it could not finish may be half done
                if used:  # and earlier cases may have left it less than their due
                    continue
            if done is not None:
                return done._replace(tries=tries)
            if ended == -SIGALRM:
                message = f"took longer than {self.limits.seconds:g} s"
                return Done(case, trouble(TIMED_OUT, message), watch.read()[0], None, tries)
        message = f"ended its process in each of {TRIES} tries, at last with status {ended}"
        return Done(case, trouble(DIED, message), watch.read()[0], None, tries)

    def _try(self, case: Case) -> tuple[Done | None, int]:
        """What a case came to, or else how the process ended."""
        process = self._process
        try:
            if process is None:
                process = self._begun()
                if (answer := self._answer(process, START_S)) != READY:
                    raise UnfitError(answer)
            self._used = True
            write_message(process.stdin, case)
            return self._answer(process, self.limits.seconds + GRACE_S), 0
        except TimeoutError:
            late = -SIGALRM if self._used else -SIGKILL
            self.end()
            return None, late
        except (OSError, EOFError, pickle.UnpicklingError):
            return None, self.end(patience_s=GRACE_S)

    def _answer(self, process: subprocess.Popen[bytes], limit_s: float) -> Any:
        assert process.stdout is not None
        if not select.select([process.stdout], [], [], limit_s)[0]:
            raise TimeoutError
        return read_message(process.stdout)

    def _begun(self) -> subprocess.Popen[bytes]:
        """A new process, which says something when it is ready."""
        paths = os.pathsep.join(path or str(Path.cwd()) for path in sys.path)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", SERVE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **ONE_THREAD, "PYTHONPATH": paths},
            start_new_session=True,  # Ctrl-C is the parent's to handle
        )
        if self._stopped.is_set():  # meanwhile
            self._process.kill()
        write_message(self._process.stdin, (self.work, self.limits))
        return self._process

    def stop(self) -> None:
        """End it for good, from whatever thread; its case is nobody's."""
        self._stopped.set()
        process = self._process
        if process is not None:
            process.kill()

    def end(self, patience_s: float = 0.0) -> int:
        """End the process, if it does not end by itself, and say how; the next case begins another."""
        process, self._process, self._used = self._process, None, False
        if process is None:
            return 0
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()
        with suppress(subprocess.TimeoutExpired):
            return process.wait(patience_s)
        process.kill()
        return process.wait()


def write_message(pipe: IO[bytes] | None, content: object) -> None:
    """Send a pickle.

    Raises:
        OSError: if the other side is gone.
    """
    assert pipe is not None
    data = pickle.dumps(content, pickle.HIGHEST_PROTOCOL)
    pipe.write(len(data).to_bytes(8, "little") + data)
    pipe.flush()


def read_message(pipe: IO[bytes]) -> Any:
    """Receive one.

    Raises:
        EOFError: if the other side is gone.
    """
    return pickle.loads(_exactly(pipe, int.from_bytes(_exactly(pipe, 8), "little")))


def _exactly(pipe: IO[bytes], size: int) -> bytes:
    data = pipe.read(size)
    if len(data) < size:
        raise EOFError
    return data
