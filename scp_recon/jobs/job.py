"""Describe jobs and how they end, run them in this process, and put results in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from time import perf_counter, process_time
from typing import Any, NamedTuple

from scp_recon.errors import InputError, option, printable

REFUSED, FAILED, OUT_OF_MEMORY = "refused", "failed", "out of memory"
TIMED_OUT, DIED = "timed out", "died"

Key = str | int


class Job(NamedTuple):
    """A piece of work: a unique key, which names its row in a store, and inputs, which pickle.

    The inputs are all that the work's result depends on besides the work.
    """

    key: Key
    inputs: Any = None


class Failure(NamedTuple):
    """Why a job has no result.

    Attributes:
        status: `REFUSED` (the work raised InputError), `FAILED` (another exception), `OUT_OF_MEMORY`,
            `TIMED_OUT` or `DIED` (its process ended, in each try).
        message: for the user.
        error: what the work raised, where that is known and pickles.
    """

    status: str
    message: str
    error: Exception | None = None


class Done(NamedTuple):
    """A job that has ended, `tries` times begun: what the work returned, or why it did not.

    `seconds` are wall time; `cpu_s` is processor time, which is None where the process died and took
    that knowledge with it.
    """

    key: Key
    value: Any
    failure: Failure | None
    seconds: float
    cpu_s: float | None
    tries: int

    def result(self, entry: str = option("workers"), name: str = "job") -> Any:
        """What the work returned; messages of a lost process name the entry and what a job is.

        Raises:
            Exception: what the work raised.
            InputError: if its process was ended, or died.
        """
        if self.failure is None:
            return self.value
        if self.failure.error is not None:
            raise self.failure.error
        status, message, _ = self.failure
        given = f"{name} {self.key}, {status}: {message}"
        raise InputError(entry, given, f"every {name} must be done")


Work = Callable[[Any], Any]
"""From a job's inputs to its result. It pickles."""
Executor = Callable[[Work, Iterable[Job]], Generator[Done, None, None]]
"""Runs jobs, taken one by one, and yields them as they end; closed early, it ends its processes."""


def in_order(executor: Executor, work: Work, jobs: Iterable[Job]) -> Generator[Done, None, None]:
    """Run jobs anywhere, and yield them in the order in which they are given; early ones wait."""
    keys: deque[Key] = deque()
    waiting: dict[Key, Done] = {}

    def noted() -> Iterator[Job]:
        for job in jobs:
            keys.append(job.key)
            yield job

    with closing(executor(work, noted())) as ended:
        for done in ended:
            waiting[done.key] = done
            while keys and keys[0] in waiting:
                yield waiting.pop(keys.popleft())


def here(work: Work, jobs: Iterable[Job]) -> Generator[Done, None, None]:
    """Run jobs in this process, one after the other: nothing is started, and no limit is kept."""
    for job in jobs:
        yield attempt(work, job)


def attempt(work: Work, job: Job) -> Done:
    """Run a job once, here; an exception becomes its failure.

    Raises:
        KeyboardInterrupt: the user's.
    """
    watch = Stopwatch()
    value, failure = None, None
    try:
        value = work(job.inputs)
    except InputError as error:
        failure = Failure(REFUSED, str(error), error)
    except MemoryError:
        failure = Failure(OUT_OF_MEMORY, "more memory than a job may take")
    except Exception as error:  # whatever the work raises is the job's: the others go on
        failure = Failure(FAILED, printable(f"{type(error).__name__}: {error}"), error)
    except SystemExit as error:
        failure = Failure(FAILED, printable(f"SystemExit: {error}"))
    return Done(job.key, value, failure, *watch.read(), 1)


@dataclass
class Stopwatch:
    """Wall and processor time since it was made, s."""

    wall: float = field(default_factory=perf_counter)
    cpu: float = field(default_factory=process_time)

    def read(self) -> tuple[float, float]:
        """Wall and processor time so far, s."""
        return perf_counter() - self.wall, process_time() - self.cpu
