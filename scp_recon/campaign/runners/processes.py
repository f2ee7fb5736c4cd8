"""Cases on processes of this machine, each of which can be ended at any time."""

from __future__ import annotations

import pickle
import queue
import threading
from collections.abc import Generator, Iterable
from dataclasses import dataclass

from scp_recon.campaign.rows.case import Case, Done, Work
from scp_recon.campaign.runners.child import Child, Limits, StoppedError, UnfitError
from scp_recon.errors import InputError


@dataclass(frozen=True)
class Processes:
    """A runner, on so many processes."""

    workers: int
    limits: Limits

    def __call__(self, work: Work, cases: Iterable[Case]) -> Generator[Done, None, None]:
        """Run cases as processes become free; they are given as they are over."""
        pickled = pickle.dumps(work)
        children = [Child(pickled, self.limits) for _ in range(self.workers)]
        # A few ahead of who takes them: memory stays bounded.
        over: queue.Queue[Done | BaseException | None] = queue.Queue(4 * self.workers)
        left, taking, ended = iter(cases), threading.Lock(), threading.Event()

        def put(item: Done | BaseException | None) -> None:
            while not ended.is_set():
                try:
                    return over.put(item, timeout=0.5)
                except queue.Full:
                    continue
            return None

        def serve(child: Child) -> None:
            try:
                while not ended.is_set():
                    with taking:
                        case = next(left, None)
                    if case is None:
                        break
                    put(child.run(case))
            except StoppedError:
                return
            except UnfitError as error:
                put(InputError("--workers", str(error), "must be able to run the study"))
            except BaseException as error:  # of the cases' source, or of this machine
                put(error)
            put(None)

        threads = [threading.Thread(target=serve, args=(c,), daemon=True) for c in children]
        try:
            for thread in threads:
                thread.start()
            working = len(threads)
            while working:
                item = over.get()
                if isinstance(item, BaseException):
                    raise item
                if item is None:
                    working -= 1
                else:
                    yield item
        finally:
            ended.set()
            for child in children:
                child.stop()
            for thread in threads:
                if thread.is_alive():
                    thread.join()
            for child in children:
                child.end()
