"""Jobs on a real cluster: a scheduler and two worker processes, which die as they may."""

from __future__ import annotations

import asyncio
import logging
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from scp_recon.cli.commands import montecarlo
from scp_recon.errors import InputError
from scp_recon.jobs.cluster import Cluster, Session, run_in_child
from scp_recon.jobs.job import Done, Key, attempt
from scp_recon.jobs.processes import UnfitError
from scp_recon.monte_carlo.summary import FILE_NAME
from tests.helpers import nightly
from tests.scp_recon.jobs.support import LIMITS, computed, run_all, some_jobs
from tests.scp_recon.jobs.works import ENDS, Naughty, Quick

distributed = pytest.importorskip("distributed")
PROJECT = Path(__file__).parents[4]
WORKERS = 2


class LocalCluster:
    """Processes as an administrator would have them: what ends is begun again."""

    def __init__(self, log: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        self._log = log.open("ab")
        self.scheduler = self._scheduler()
        self.nannies = self._workers()

    def _begin(self, *words: str) -> subprocess.Popen[bytes]:
        env = {**os.environ, "PYTHONPATH": str(PROJECT), "PYTHONWARNINGS": "ignore"}
        command = [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]]
        # Of a session of its own: a nanny ends with its workers, and at once.
        return subprocess.Popen(
            command, env=env, stdout=self._log, stderr=self._log, start_new_session=True
        )

    def _scheduler(self) -> subprocess.Popen[bytes]:
        words = ("--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard")
        return self._begin("dask_scheduler", *words)

    def _workers(self) -> subprocess.Popen[bytes]:
        words = ("--nworkers", str(WORKERS), "--nthreads", "1", "--no-dashboard")
        return self._begin("dask_worker", self.address, *words)

    def pids(self) -> list[int]:
        """Of the workers, once all are there."""
        with distributed.Client(self.address, timeout=180, set_as_default=False) as client:
            client.wait_for_workers(WORKERS, timeout=180)
            return sorted(client.run(os.getpid).values())

    def kill_scheduler(self) -> None:
        self.scheduler.kill()
        self.scheduler.wait()

    def begin_again(self) -> None:
        """Another scheduler at the same address, with workers of its own."""
        self.scheduler = self._scheduler()
        end(self.nannies)
        self.nannies = self._workers()

    def close(self) -> None:
        end(self.nannies, self.scheduler)
        self._log.close()


def end(*processes: subprocess.Popen[bytes]) -> None:
    for process in processes:
        with suppress(ProcessLookupError):  # it has ended by itself
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory) -> Iterator[LocalCluster]:
    begun = LocalCluster(tmp_path_factory.mktemp("cluster") / "log.txt")
    yield begun
    begun.close()


class After:
    """Does something once, when so many jobs have ended."""

    def __init__(self, count: int, action: Any) -> None:
        self.count, self.action = count, action
        self.keys: list[Key] = []
        self.acted = False

    def __call__(self, key: Key, _: Mapping[str, Any]) -> None:
        self.keys.append(key)
        if len(self.keys) >= self.count and not self.acted:
            self.acted = True
            self.action()


def test_a_scheduler_without_workers_is_told_once_until_one_joins(monkeypatch):
    workers: list[dict[str, int]] = [{}, {}, {"a": 2}, {}]
    said: list[str] = []
    session = Session(Cluster("tcp://127.0.0.1:1", LIMITS, said.append), b"")
    session.client = SimpleNamespace(nthreads=lambda: workers.pop(0))
    monkeypatch.setattr("scp_recon.jobs.cluster.LOOK_S", -1.0)
    counts = []
    while workers:
        session.room()
        counts.append(len(said))
    assert counts == [1, 1, 1, 2]
    assert "no workers" in said[0]


class Held(distributed.utils_comm.TaskRef):  # type: ignore[misc,name-defined]  # Dask's are not typed
    """A job's future: finished, until its result is found to be lost."""

    def __init__(self, client: LosingClient, key: str) -> None:
        super().__init__(key)
        self.client, self.status = client, "finished"

    async def wait(self) -> None:
        """It has ended."""

    def reset(self) -> None:
        self.status = "cancelled"

    def add_done_callback(self, call: Callable[[Held], None]) -> None:
        call(self)


class LosingClient:
    """Dask's own `gather`, of results of which the scheduler has lost some; may close itself."""

    gather, _gather = distributed.Client.gather, distributed.Client._gather
    direct_to_workers, dashboard_link = False, ""

    def __init__(self, *, lost: Collection[int] = (), takes: int = 99) -> None:
        self.lost, self.takes = lost, takes
        self.sent: list[int] = []
        self.results: dict[str, Done] = {}
        self.futures: dict[str, Held] = {}
        self.status = "running"
        self._gather_keys: Any = None
        self._gather_future: Any = None

    def submit(self, function: Any, *inputs: Any, **_: bool) -> Held | None:
        if function is not run_in_child:
            return None  # the work
        if len(self.sent) == self.takes:
            self.status = "closed"
            raise distributed.client.ClosedClientError
        job = pickle.loads(inputs[1])
        self.sent.append(job.key)
        key = f"run-{len(self.sent)}"
        self.futures[key] = Held(self, key)
        self.results[key] = attempt(Quick(), job)
        return self.futures[key]

    def sync(self, call: Any, *args: Any, asynchronous: bool = False, **options: Any) -> Any:
        options.pop("callback_timeout", None)
        coming = call(*args, **options)
        return coming if asynchronous else asyncio.run(coming)

    async def _gather_remote(self, *_: object) -> dict[str, Any]:
        """The scheduler's answer, as `Scheduler.gather` gives it."""
        keys, self._gather_keys, self._gather_future = self._gather_keys, None, None
        if lost := [key for key in keys if self.results[key].key in self.lost]:
            return {"status": "error", "keys": lost}
        return {"status": "OK", "data": {key: self.results[key] for key in keys}}

    def _send_to_scheduler(self, message: dict[str, str]) -> None:
        assert message["op"] == "report-key"  # which a scheduler that is gone cannot

    def nthreads(self) -> dict[str, int]:
        return {"a worker": 1}

    def close(self, **_: float) -> None:
        self.status = "closed"


@pytest.mark.parametrize(
    ("first", "sent"),
    [
        ({"lost": {1}}, [[0, 1, 2], [1]]),
        ({"lost": {0, 2}}, [[0, 1, 2], [0, 2]]),
        ({"takes": 1}, [[0], [1, 2]]),
    ],
)
def test_what_is_lost_or_refused_is_sent_again_and_nothing_else(monkeypatch, first, sent):
    """Dask's client closes itself once its scheduler has been away for its timeout."""
    clients = [LosingClient(**first), LosingClient()]
    found, said = ran_with(clients, monkeypatch)
    assert [client.sent for client in clients] == sent
    assert {done.key: done.value for done in found} == {n: Quick()(n) for n in range(3)}
    assert len(found) == 3
    assert sum("sent again" in line for line in said) == 1


def ran_with(clients: list[LosingClient], monkeypatch) -> tuple[list[Done], list[str]]:
    """Three jobs over one client after the other, and what was said."""
    coming, said = iter(clients), list[str]()
    monkeypatch.setattr(distributed, "Client", lambda *_, **__: next(coming))
    monkeypatch.setattr("scp_recon.jobs.cluster.LOOK_S", 0.01)
    executor = Cluster("tcp://127.0.0.1:1", LIMITS, said.append, ahead=3)
    return list(executor(Quick(), some_jobs(3))), said


@nightly
def test_a_worker_is_killed_in_mid_run(cluster, tmp_path):
    jobs = some_jobs(60)
    victim = cluster.pids()[0]
    killed = After(8, lambda: os.kill(victim, signal.SIGKILL))
    rows = run_all(Quick(0.05), jobs, tmp_path / "a", Cluster(cluster.address, LIMITS), killed)
    assert killed.acted
    assert sorted(killed.keys, key=int) == list(range(60))
    assert computed(rows) == computed(run_all(Quick(), jobs, tmp_path / "b"))
    assert victim not in cluster.pids()


@nightly
def test_jobs_that_misbehave_are_rows(cluster, tmp_path):
    jobs, ways = some_jobs(20), dict(zip((2, 5, 7, 8, 11, 13, 15, 17), ENDS, strict=True))
    before = cluster.pids()
    work = Naughty(ways=tuple(ways.items()))
    found = run_all(work, jobs, tmp_path / "a", Cluster(cluster.address, LIMITS))
    assert {n: found[n]["status"] for n in ways} == {n: ENDS[way] for n, way in ways.items()}
    assert {n for n in found if found[n]["tries"] == 3} == {n for n in ways if ways[n] == "die"}
    serial = run_all(Quick(), jobs, tmp_path / "b")
    assert all(found[n]["value"] == serial[n]["value"] for n in range(20) if n not in ways)
    assert cluster.pids() == before, "no worker has died of it"


@nightly
def test_the_scheduler_is_restarted_in_mid_run(cluster, tmp_path):
    jobs, said = some_jobs(60), list[str]()
    cluster.pids()
    restarting = threading.Thread(target=cluster.begin_again)

    def kill() -> None:  # here, so that it is gone before any other job can be sent
        cluster.kill_scheduler()
        restarting.start()

    seen = After(8, kill)
    executor = Cluster(cluster.address, LIMITS, said.append)
    rows = run_all(Quick(0.05), jobs, tmp_path / "a", executor, seen)
    restarting.join()
    assert any("sent again" in line for line in said)
    assert sorted(seen.keys, key=int) == list(range(60))
    assert computed(rows) == computed(run_all(Quick(), jobs, tmp_path / "b"))


def test_a_lost_scheduler_is_told_in_one_line_not_in_a_traceback(monkeypatch):
    """Dask's client would log one; other programs' logs are theirs again afterwards."""
    log, heard = logging.getLogger("distributed.client"), list[bool]()

    def lost(*_: object, **__: object) -> None:
        heard.append(log.isEnabledFor(logging.CRITICAL))
        raise TimeoutError  # which says nothing

    monkeypatch.setattr(distributed, "Client", lost)
    with pytest.raises(InputError, match=r"where none answers \(TimeoutError\)"):
        list(Cluster("tcp://127.0.0.1:9", LIMITS)(Quick(), some_jobs(1)))
    assert (heard, log.isEnabledFor(logging.CRITICAL)) == ([False], True)


def test_a_worker_of_other_versions_is_unfit():
    with pytest.raises(UnfitError, match="instead of"):
        run_in_child(pickle.dumps(({"scp_recon": "0"}, b"")), b"", LIMITS)


@pytest.mark.parametrize("address", ["foo", "", "tcp://127.0.0.1:x"])
def test_what_is_no_address_is_told_at_once(tmp_path, address):
    with pytest.raises(InputError, match="must be the address of a Dask scheduler"):
        run_all(Quick(), some_jobs(2), tmp_path / "a", Cluster(address, LIMITS))


def test_flights_are_the_same_on_a_cluster(cluster, solution, verification, tmp_path):
    replace(solution, verification=verification).write(tmp_path)
    words = [str(tmp_path), "--samples", "2500", "--seed", "4"]
    assert montecarlo.main(words) == 0
    alone = (tmp_path / FILE_NAME).read_bytes()
    assert montecarlo.main([*words, "--scheduler", cluster.address]) == 0
    assert (tmp_path / FILE_NAME).read_bytes() == alone
