"""Jobs, their outcomes and seeds; run jobs in this process, and put outcomes in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from time import perf_counter, process_time
from typing import Any, NamedTuple

import numpy as np

from scp_recon.errors import InputError, option, printable

WORD = 2**32
"""A larger seed fills several words, the second of which would be taken for a place."""


def sequence(seed: int, *places: int) -> np.random.SeedSequence:
    """What a seed and some places, such as the number of a block of flights, draw from.

    Different seeds and places give different numbers. A seed below `WORD` and its places are one list
    of words; of a larger seed the places are a spawn key, which numpy sets apart from the seed.
    """
    if seed < WORD:
        return np.random.SeedSequence([seed, *places])
    return np.random.SeedSequence(seed, spawn_key=places)


def generator(seed: int, *places: int) -> np.random.Generator:
    """The generator of a seed at some places: see `sequence`."""
    return np.random.default_rng(sequence(seed, *places))


REFUSED, FAILED, OUT_OF_MEMORY = "refused", "failed", "out of memory"
TIMED_OUT, DIED = "timed out", "died"

Key = str | int


class Job(NamedTuple):
    """A piece of work: a unique key, which names its row in a store, and inputs, which pickle.

    The result depends on the work and the inputs alone.
    """

    key: Key
    inputs: Any = None


class Failure(NamedTuple):
    """The reason for which a job has no result.

    Attributes:
        status: `REFUSED` (the work raised InputError), `FAILED` (another exception), `OUT_OF_MEMORY`,
            `TIMED_OUT` or `DIED` (its process ended, in each try).
        message: for the user.
        error: the exception that the work raised, if known and picklable.
    """

    status: str
    message: str
    error: Exception | None = None


class Done(NamedTuple):
    """A job that has ended after `tries` tries, with the work's result or a failure.

    `seconds` is wall time; `cpu_s` is processor time, None where the process died.
    """

    key: Key
    value: Any
    failure: Failure | None
    seconds: float
    cpu_s: float | None
    tries: int

    def result(self, entry: str = option("workers"), name: str = "job") -> Any:
        """The work's result; the message of a lost process names `entry` and calls the job a `name`.

        Raises:
            Exception: the exception that the work raised.
            InputError: if its process was ended, or died.
        """
        if self.failure is None:
            return self.value
        if self.failure.error is not None:
            raise self.failure.error
        status, message, _ = self.failure
        given = f"{name} {self.key}, {status}: {message}"
        raise InputError(entry, given, f"every {name} must end with a result")


Work = Callable[[Any], Any]
"""Makes a job's result from its inputs; must pickle."""
Executor = Callable[[Work, Iterable[Job]], Generator[Done, None, None]]
"""Runs jobs, taken one by one, and yields them as they end. Closing the generator kills its workers."""


def in_order(executor: Executor, work: Work, jobs: Iterable[Job]) -> Generator[Done, None, None]:
    """Run jobs by an executor, and yield them in the given order, whatever order they end in."""
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
    """Run jobs one after the other in this process, without limits."""
    for job in jobs:
        yield attempt(work, job)


def attempt(work: Work, job: Job) -> Done:
    """Run a job once in this process; an exception becomes its failure.

    Raises:
        KeyboardInterrupt: if the user interrupts.
    """
    wall, cpu = perf_counter(), process_time()
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
    return Done(job.key, value, failure, perf_counter() - wall, process_time() - cpu, 1)
