"""Run jobs on a Dask cluster, each in a process of its own, with the limits of local processes.

Workers may die: Dask sends their jobs again. Without its scheduler a run ends with an error; a store
keeps the rows so far, and the next run continues with the other jobs.
"""

from __future__ import annotations

import itertools
import logging
import pickle
import queue
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from math import inf
from time import monotonic
from typing import Any

from scp_recon.errors import InputError, needing, option, whole_number
from scp_recon.jobs.cores import WORKERS_MAX
from scp_recon.jobs.job import DIED, Done, Executor, Failure, Job, Key, Work, here
from scp_recon.jobs.processes import TRIES, Child, Limits, Processes, UnfitError
from scp_recon.jobs.store import versions

AHEAD = 4
"""Jobs sent for each thread of the cluster; more would wait in the scheduler's memory."""
LEAST_AHEAD = 32
"""Jobs sent at least, however small the cluster."""
LOOK_S = 1.0
"""Seconds between checks that the scheduler is there, and of the number of its threads."""
ANSWER_S = 5.0
"""Seconds within which a scheduler has to answer."""
FETCH_S = 60.0
"""Longest time to fetch a result, s."""
EXAMPLE = "must be the address of a Dask scheduler, e.g. tcp://127.0.0.1:8786"


@dataclass(frozen=True)
class Cluster:
    """An executor on a scheduler's cluster; `say` is called with each line worth showing."""

    address: str
    limits: Limits
    say: Callable[[str], None] = lambda _: None

    def __call__(self, work: Work, jobs: Iterable[Job]) -> Generator[Done, None, None]:
        """Run jobs as workers become free; they are yielded as they end.

        Raises:
            InputError: if the extra is missing, or the scheduler does not answer or is lost.
        """
        with needing(option("scheduler"), "cluster"):
            import distributed
        with without_tracebacks():
            client = self._connected(distributed)
            self.say(f"dashboard: {client.dashboard_link}")
            try:
                yield from self._run(client, pickle.dumps((versions(), pickle.dumps(work))), jobs)
            except (distributed.client.ClosedClientError, OSError):
                if client.status == "running":  # an error of the jobs' source
                    raise
                raise self._lost() from None
            finally:
                with suppress(Exception):  # the scheduler is gone, or is being lost at this moment
                    client.close(timeout=2.0)

    def _connected(self, distributed: Any) -> Any:
        """A client of the scheduler."""
        try:
            addressing = distributed.comm.addressing
            addressing.parse_host_port(addressing.parse_address(self.address)[1])
            return distributed.Client(self.address, timeout=ANSWER_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            said = (str(error).splitlines() or [type(error).__name__])[0]
            given = f"{self.address!r}, where none answers ({said[:120]})"
            raise InputError(option("scheduler"), given, EXAMPLE) from None

    def _run(self, client: Any, pickled: bytes, jobs: Iterable[Job]) -> Iterator[Done]:
        # A task, not scattered data: the scheduler can make the work again wherever it is lost.
        shared, left = client.submit(bytes, pickled, pure=False), iter(jobs)
        out: dict[str, tuple[Job, Any]] = {}
        tries: dict[Key, int] = {}
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()

        def send(job: Job) -> None:
            # The job is pickled here: Dask would search its inputs for futures.
            call = (run_in_child, shared, pickle.dumps(job), self.limits)
            future = client.submit(*call, pure=False)
            out[future.key] = job, future
            future.add_done_callback(ended.put)

        checked, threads = -inf, 1
        while True:
            if monotonic() - checked > LOOK_S:
                checked = monotonic()
                threads = self._threads(client, threads)
            for job in itertools.islice(left, max(LEAST_AHEAD, AHEAD * threads) - len(out)):
                send(job)
            if not out:
                return
            try:
                ended_one = ended.get(timeout=LOOK_S)
            except queue.Empty:
                if client.status != "running" or any(f.status == "lost" for _, f in out.values()):
                    raise self._lost() from None
                continue
            job, future = out.pop(ended_one.key)
            if future.status == "finished":
                tries.pop(job.key, None)
                yield future.result(timeout=FETCH_S)
            elif future.status != "error":  # cancelled by a client that has lost its scheduler
                raise self._lost()
            else:
                error = future.exception(timeout=FETCH_S)
                if isinstance(error, UnfitError):
                    allowed = "must have workers with this very program"
                    raise InputError(option("scheduler"), str(error), allowed)
                tries[job.key] = tries.get(job.key, 0) + 1
                if tries[job.key] < TRIES:
                    send(job)
                    continue
                said = f"{type(error).__name__}: {str(error)[:200]}"
                message = f"ended its worker in each of {TRIES} tries: {said}"
                yield Done(job.key, None, Failure(DIED, message), 0.0, None, TRIES)

    def _threads(self, client: Any, before: int) -> int:
        """Number of the cluster's threads; says so if they have all gone."""
        try:
            threads = sum(client.nthreads().values())
        except (OSError, TimeoutError, ValueError):
            return before
        if before and not threads:
            self.say("the scheduler has no workers: jobs wait until one joins it")
        return threads

    def _lost(self) -> InputError:
        kept = "must stay until the end; all rows so far are kept, and the same command continues"
        return InputError(option("scheduler"), f"{self.address}, which was lost", kept)


@contextmanager
def without_tracebacks() -> Iterator[None]:
    """Keep Dask's client from logging a lost scheduler: the error that `Cluster` raises is enough."""
    log = logging.getLogger("distributed.client")
    before = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        log.setLevel(before)


_CHILDREN = threading.local()


def run_in_child(pickled: bytes, job: bytes, limits: Limits) -> Done:
    """Run a job in the process of this worker's thread, which is kept for the next one.

    Raises:
        UnfitError: if the process has other versions than the caller, or cannot run the job.
    """
    child: Child | None = getattr(_CHILDREN, "child", None)
    if child is None or (_CHILDREN.pickled, child.limits) != (pickled, limits):
        if child is not None:
            child.end()
        required, work = pickle.loads(pickled)
        if required != (own := versions()):
            raise UnfitError(f"a worker with {own} instead of {required}")
        child, _CHILDREN.pickled = Child(work, limits), pickled
        _CHILDREN.child = child
    return child.run(pickle.loads(job))


def check_workers(workers: object, scheduler: str | None, least: int) -> int | None:
    """Check the number of processes, None for the default.

    Raises:
        InputError: if the number is out of bounds, or given beside a scheduler.
    """
    if workers is None:
        return None
    found = whole_number(option("workers"), workers, least, WORKERS_MAX)
    if scheduler is not None:
        allowed = f"must be left out with {option('scheduler')}"
        raise InputError(option("workers"), str(found), allowed)
    return found


def executor_for(
    workers: int, scheduler: str | None, limits: Limits, say: Callable[[str], None]
) -> Executor:
    """Choose an executor: `workers` processes, for 0 this process, or the Dask cluster of an address.

    `say` is called with each line worth showing.
    """
    if scheduler is not None:
        return Cluster(scheduler, limits, say)
    return Processes(workers, limits) if workers else here
