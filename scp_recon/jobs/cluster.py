"""Run jobs on a Dask cluster, each in a process of its own, with the limits of local processes.

The scheduler may be restarted and workers may die: unfinished jobs are sent again, and a result that
comes twice counts once.
"""

from __future__ import annotations

import itertools
import logging
import pickle
import queue
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from time import monotonic
from typing import Any

from scp_recon.errors import InputError, needing, option
from scp_recon.jobs.job import DIED, Done, Failure, Job, Key, Work
from scp_recon.jobs.processes import TRIES, Child, Limits, UnfitError
from scp_recon.jobs.store import versions

AHEAD = 4
"""Jobs sent for each thread of the cluster; more would wait in the scheduler's memory."""
LEAST_AHEAD = 32
"""Jobs sent at least, however small the cluster."""
LOOK_S = 1.0
"""Seconds between looks whether the scheduler is there, and how many workers it has."""
ANSWER_S = 5.0
"""Within which a scheduler has to answer a new client."""
GATHER_S = 60.0
"""Longest time to fetch results, s."""
GONE_S = 120.0
"""Longest time for which a scheduler may be away, s."""


@dataclass(frozen=True)
class Cluster:
    """An executor on a scheduler's cluster; the scheduler may be away for up to `gone_s`.

    `say` is called with each line worth showing. `ahead` is the number of jobs sent at once; by
    default it follows the size of the cluster.
    """

    address: str
    limits: Limits
    say: Callable[[str], None] = lambda _: None
    ahead: int | None = None
    gone_s: float = GONE_S

    def __call__(self, work: Work, jobs: Iterable[Job]) -> Generator[Done, None, None]:
        """Run jobs as workers become free; they are yielded as they end.

        Raises:
            InputError: if the extra is missing, or the scheduler does not answer.
        """
        session = Session(self, pickle.dumps((versions(), pickle.dumps(work))))
        with without_tracebacks(), closing(session):
            yield from self._run(session, iter(jobs))

    def _run(self, session: Session, left: Iterator[Job]) -> Generator[Done, None, None]:
        tries: dict[Key, int] = {}
        session.connect(first=True)
        while True:
            for job in itertools.islice(left, session.room()):
                session.send(job)
            if not session.out:
                return
            for job, done, error in session.ended():
                if done is not None:
                    tries.pop(job.key, None)
                    yield done
                elif (count := tries.get(job.key, 0) + 1) < TRIES:
                    tries[job.key] = count
                    session.send(job)
                else:
                    message = f"ended its worker in each of {TRIES} tries: {error}"
                    yield Done(job.key, None, Failure(DIED, message), 0.0, None, TRIES)


@contextmanager
def without_tracebacks() -> Iterator[None]:
    """Keep Dask's client from logging a lost scheduler: a `Session` says so itself, in one line."""
    log = logging.getLogger("distributed.client")
    before = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        log.setLevel(before)


Ended = tuple[Job, Done | None, str]


class Session:
    """A connection to a scheduler, and the jobs that are out."""

    def __init__(self, cluster: Cluster, pickled: bytes) -> None:
        with needing(option("scheduler"), "cluster"):
            import distributed
        self._distributed = distributed
        self._cluster, self._pickled = cluster, pickled
        self.client: Any = None
        self._work: Any = None
        self._events: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.out: dict[str, tuple[Job, Any]] = {}
        self._threads, self._looked = 1, 0.0

    def connect(self, *, first: bool = False) -> None:
        """Connect to the scheduler, and send again the jobs that are out.

        Raises:
            InputError: if it does not answer.
        """
        address, until = self._cluster.address, monotonic() + self._cluster.gone_s
        if first:
            self._check_address(address)
        while True:
            try:
                self.client = self._distributed.Client(
                    address, timeout=ANSWER_S, set_as_default=False
                )
                break
            except (OSError, TimeoutError, ValueError) as error:
                if first or monotonic() > until:
                    said = (str(error).splitlines() or [type(error).__name__])[0]
                    raise InputError(
                        option("scheduler"),
                        f"{address}, where none answers ({said[:120]})",
                        "must be the address of a Dask scheduler, e.g. tcp://127.0.0.1:8786; "
                        "all rows so far are kept; run the same command to continue",
                    ) from None
        if first:
            self._cluster.say(f"dashboard: {self.client.dashboard_link}")
        # The scheduler can make it again wherever it is lost, as it could not with scattered data.
        self._work = self.client.submit(bytes, self._pickled, pure=False)
        again, self.out = self.out, {}
        for job, _ in again.values():
            self.send(job)

    def _check_address(self, address: str) -> None:
        addressing = self._distributed.comm.addressing
        try:
            addressing.parse_host_port(addressing.parse_address(address)[1])
        except ValueError as error:
            raise InputError(
                option("scheduler"),
                f"{address!r}: {error}",
                "must be the address of a Dask scheduler, e.g. tcp://127.0.0.1:8786",
            ) from None

    def room(self) -> int:
        """Number of jobs that may still be sent."""
        if self._cluster.ahead is not None:
            return max(0, self._cluster.ahead - len(self.out))
        if monotonic() - self._looked > LOOK_S:
            self._looked = monotonic()
            with suppress(OSError, TimeoutError, ValueError):
                before, self._threads = self._threads, sum(self.client.nthreads().values())
                if before and not self._threads:
                    self._cluster.say("the scheduler has no workers: jobs wait until one joins it")
        return max(0, max(LEAST_AHEAD, AHEAD * self._threads) - len(self.out))

    def send(self, job: Job) -> None:
        """Send a job, pickled: Dask would look for its own things in it.

        A client whose scheduler was away for too long has closed itself; `ended` sends its jobs again.
        """
        try:
            future = self.client.submit(
                run_in_child, self._work, pickle.dumps(job), self._cluster.limits, pure=False
            )
        except self._distributed.client.ClosedClientError:
            self.out[f"not sent: {job.key!r}"] = (job, None)
            return
        self.out[future.key] = (job, future)
        future.add_done_callback(self._events.put)

    def ended(self) -> list[Ended]:
        """Wait a while for jobs that have ended; send again those lost with a scheduler."""
        try:
            events = [self._events.get(timeout=LOOK_S)]
        except queue.Empty:
            if self.client.status != "running":
                self._again()
            return []
        with suppress(queue.Empty):
            while True:
                events.append(self._events.get_nowait())
        ours = {future.key: future for future in events if future.key in self.out}
        results = self._gathered([f for f in ours.values() if f.status == "finished"])
        found: list[Ended] = []
        for key, future in ours.items():
            job, _ = self.out[key]
            if done := results.get(key):
                found.append((job, done, ""))
            elif future.status == "error":
                error = future.exception(timeout=GATHER_S)
                if isinstance(error, UnfitError):
                    allowed = "must have workers with this very program"
                    raise InputError(option("scheduler"), str(error), allowed) from None
                # Its worker died of it, as far as the scheduler can tell.
                found.append((job, None, f"{type(error).__name__}: {str(error)[:200]}"))
            else:
                continue
            del self.out[key]
        if len(found) < len(ours):
            self._again()
        return found

    def _gathered(self, futures: list[Any]) -> dict[str, Done | None]:
        """Fetch results by key; a lost result is None, and all are if the scheduler is lost."""

        async def fetch() -> Any:  # of a list Dask leaves out what it skips: the rest would shift
            by_key = {future.key: future for future in futures}
            return await self.client.gather(by_key, errors="skip", asynchronous=True)

        try:
            return self.client.sync(fetch, callback_timeout=GATHER_S) if futures else {}
        except (OSError, TimeoutError, self._distributed.CancelledError):
            return {}

    def _again(self) -> None:
        self._cluster.say("the scheduler was lost: unfinished jobs are sent again")
        self._leave()
        self.connect()

    def _leave(self) -> None:
        if self.client is not None:
            client, self.client = self.client, None
            with suppress(Exception):  # it is gone, or is being lost at this moment
                client.close(timeout=2.0)

    def close(self) -> None:
        """Cancel the jobs that are out, and leave."""
        if self.client is not None:
            with suppress(Exception):
                sent = [future for _, future in self.out.values() if future is not None]
                self.client.cancel(sent, force=True)
        self._leave()


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
