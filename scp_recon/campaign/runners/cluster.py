"""Cases on a Dask cluster, each in a process of its own beside the worker: same limits, same bits.

The scheduler may be restarted and workers may die: what had not come back is sent again, and what comes
twice is taken once.
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

from scp_recon.campaign.rows.case import DIED, Case, Done, Work, trouble
from scp_recon.campaign.rows.versions import versions
from scp_recon.campaign.runners.child import TRIES, Child, Limits, UnfitError
from scp_recon.errors import InputError, needing

AHEAD = 4
"""Cases sent for each thread of the cluster; more would wait in the scheduler's memory."""
LEAST_AHEAD = 32
"""Cases sent at least, however small the cluster."""
LOOK_S = 1.0
"""Seconds between looks whether the scheduler is there, and how many workers it has."""
GATHER_S = 60.0
"""Seconds for which results may be on their way."""
GONE_S = 120.0
"""Seconds for which a scheduler may be away before the campaign gives up."""


@dataclass(frozen=True)
class Cluster:
    """A runner on the cluster of a scheduler.

    Attributes:
        address: of the scheduler.
        limits: of a case.
        say: told a line when there is something to tell.
        ahead: cases that are sent at once; by the size of the cluster if None.
        gone_s: for how long the scheduler may be away.
    """

    address: str
    limits: Limits
    say: Callable[[str], None] = lambda _: None
    ahead: int | None = None
    gone_s: float = GONE_S

    def __call__(self, work: Work, cases: Iterable[Case]) -> Generator[Done, None, None]:
        """Run cases as workers become free; they are given as they are over.

        Raises:
            InputError: if the extra is missing, or the scheduler is not there.
        """
        session = Session(self, pickle.dumps((versions(), pickle.dumps(work))))
        with without_tracebacks(), closing(session):
            yield from self._run(session, iter(cases))

    def _run(self, session: Session, left: Iterator[Case]) -> Generator[Done, None, None]:
        tries: dict[int, int] = {}
        session.connect(first=True)
        while True:
            for case in itertools.islice(left, session.room()):
                session.send(case)
            if not session.out:
                return
            for case, done, error in session.over():
                if done is not None:
                    tries.pop(case.number, None)
                    yield done
                elif (count := tries.get(case.number, 0) + 1) < TRIES:
                    tries[case.number] = count
                    session.send(case)
                else:
                    message = f"ended its worker in each of {TRIES} tries: {error}"
                    yield Done(case, trouble(DIED, message), 0.0, None, TRIES)


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


Over = tuple[Case, Done | None, str]


class Session:
    """Connection to a scheduler, and what is out."""

    def __init__(self, cluster: Cluster, pickled: bytes) -> None:
        with needing("--scheduler", "cluster"):
            import distributed
        self._distributed = distributed
        self._cluster, self._pickled = cluster, pickled
        self.client: Any = None
        self._work: Any = None
        self._events: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.out: dict[str, tuple[Case, Any]] = {}
        self._threads, self._looked = 1, 0.0

    def connect(self, *, first: bool = False) -> None:
        """Find the scheduler, and send again what is out.

        Raises:
            InputError: if it does not answer.
        """
        address, until = self._cluster.address, monotonic() + self._cluster.gone_s
        if first:
            self._check_address(address)
        while True:
            try:
                self.client = self._distributed.Client(address, timeout=5.0, set_as_default=False)
                break
            except (OSError, TimeoutError, ValueError) as error:
                if first or monotonic() > until:
                    said = (str(error).splitlines() or [type(error).__name__])[0]
                    raise InputError(
                        "--scheduler",
                        f"{address}, where none answers ({said[:120]})",
                        "must be the address of a Dask scheduler, e.g. tcp://127.0.0.1:8786; "
                        "every row until now is kept, and the same command goes on",
                    ) from None
        if first:
            self._cluster.say(f"dashboard: {self.client.dashboard_link}")
        # The scheduler can make it again wherever it is lost, as it could not with scattered data.
        self._work = self.client.submit(bytes, self._pickled, pure=False)
        again, self.out = self.out, {}
        for case, _ in again.values():
            self.send(case)

    def _check_address(self, address: str) -> None:
        addressing = self._distributed.comm.addressing
        try:
            addressing.parse_host_port(addressing.parse_address(address)[1])
        except ValueError as error:
            raise InputError(
                "--scheduler",
                f"{address!r}: {error}",
                "must be the address of a Dask scheduler, e.g. tcp://127.0.0.1:8786",
            ) from None

    def room(self) -> int:
        """How many more cases may be sent."""
        if self._cluster.ahead is not None:
            return max(0, self._cluster.ahead - len(self.out))
        if monotonic() - self._looked > LOOK_S:
            self._looked = monotonic()
            with suppress(OSError, TimeoutError, ValueError):
                before, self._threads = self._threads, sum(self.client.nthreads().values())
                if before and not self._threads:
                    self._cluster.say("the scheduler has no workers: cases wait until one joins it")
        return max(0, max(LEAST_AHEAD, AHEAD * self._threads) - len(self.out))

    def send(self, case: Case) -> None:
        """Send a case."""
        future = self.client.submit(
            run_in_child, self._work, tuple(case), self._cluster.limits, pure=False
        )
        self.out[future.key] = (case, future)
        future.add_done_callback(self._events.put)

    def over(self) -> list[Over]:
        """What has come back; waits a while for it, and sends again what was lost with a scheduler."""
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
        found: list[Over] = []
        for key, future in ours.items():
            case, _ = self.out[key]
            if (done := results.get(key)) is not None:
                found.append((case, done._replace(case=case), ""))
            elif future.status == "error":
                error = future.exception(timeout=GATHER_S)
                if isinstance(error, UnfitError):
                    allowed = "must have workers with this very program"
                    raise InputError("--scheduler", str(error), allowed) from None
                # Its worker died of it, as far as the scheduler can tell.
                found.append((case, None, f"{type(error).__name__}: {str(error)[:200]}"))
            else:
                continue
            del self.out[key]
        if len(found) < len(ours):
            self._again()
        return found

    def _gathered(self, futures: list[Any]) -> dict[str, Done | None]:
        """Results by key, fetched together; of what is lost there is none."""

        async def fetch() -> Any:
            return await self.client.gather(futures, errors="skip", asynchronous=True)

        try:
            results = self.client.sync(fetch, callback_timeout=GATHER_S) if futures else []
        except (OSError, TimeoutError, self._distributed.CancelledError):
            return {}
        return {future.key: done for future, done in zip(futures, results, strict=True)}

    def _again(self) -> None:
        self._cluster.say("the scheduler was lost: what had not come back is sent again")
        self._leave()
        self.connect()

    def _leave(self) -> None:
        if self.client is not None:
            client, self.client = self.client, None
            with suppress(Exception):  # it is gone, or is being lost at this moment
                client.close(timeout=2.0)

    def close(self) -> None:
        """Give up what is out."""
        if self.client is not None:
            with suppress(Exception):
                self.client.cancel([future for _, future in self.out.values()], force=True)
        self._leave()


_CHILDREN = threading.local()


def run_in_child(pickled: bytes, case: tuple[Any, ...], limits: Limits) -> Done:
    """Run a case in the process of this worker's thread, which is kept for the next one.

    Raises:
        UnfitError: if it would be run by other versions than the campaign's, or not at all.
    """
    child: Child | None = getattr(_CHILDREN, "child", None)
    if child is None or (_CHILDREN.pickled, child.limits) != (pickled, limits):
        if child is not None:
            child.end()
        asked, work = pickle.loads(pickled)
        if asked != (own := versions()):
            raise UnfitError(f"a worker with {own} instead of {asked}")
        child, _CHILDREN.pickled = Child(work, limits), pickled
        _CHILDREN.child = child
    return child.run(Case(*case))
