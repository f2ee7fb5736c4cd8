"""Jobs on a real cluster: a scheduler and two worker processes, which die as they may."""

from __future__ import annotations

import logging
import os
import pickle
import signal
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from scp_recon.cli.commands import montecarlo
from scp_recon.errors import InputError
from scp_recon.jobs.cluster import Cluster, run_in_child
from scp_recon.jobs.job import Key
from scp_recon.jobs.processes import UnfitError
from scp_recon.monte_carlo.summary import FILE_NAME
from tests.helpers import nightly
from tests.scp_recon.jobs.support import LIMITS, computed, run_all, some_jobs
from tests.scp_recon.jobs.works import ENDS, Naughty, Quick

distributed = pytest.importorskip("distributed")
PROJECT = Path(__file__).parents[4]
WORKERS = 2


def local_cluster() -> Any:
    """A scheduler here, and workers in processes: one that ends is begun again."""
    return distributed.LocalCluster(n_workers=WORKERS, threads_per_worker=1, dashboard_address=":0")


def pids(cluster: Any) -> list[int]:
    """Of the workers, once all are there."""
    with distributed.Client(cluster, timeout=180, set_as_default=False) as client:
        client.wait_for_workers(WORKERS, timeout=180)
        return sorted(client.run(os.getpid).values())


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with local_cluster() as begun:
        yield begun


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


def test_missing_workers_are_reported_once():
    workers = [{}, {}, {"a": 2}, {}]
    said: list[str] = []
    cluster = Cluster("tcp://127.0.0.1:1", LIMITS, said.append)
    client, threads, counts = SimpleNamespace(nthreads=lambda: workers.pop(0)), 1, []
    while workers:
        threads = cluster._threads(client, threads)
        counts.append(len(said))
    assert counts == [1, 1, 1, 2]


@pytest.mark.slow
@nightly
def test_killed_worker_loses_no_row(cluster, tmp_path):
    jobs = some_jobs(60)
    victim = pids(cluster)[0]
    killed = After(8, lambda: os.kill(victim, signal.SIGKILL))
    rows = run_all(
        Quick(0.05), jobs, tmp_path / "a", Cluster(cluster.scheduler_address, LIMITS), killed
    )
    assert killed.acted
    assert sorted(killed.keys, key=int) == list(range(60))
    assert computed(rows) == computed(run_all(Quick(), jobs, tmp_path / "b"))
    assert victim not in pids(cluster)


@nightly
def test_misbehaving_jobs_have_rows(cluster, tmp_path):
    jobs, ways = some_jobs(20), dict(zip((2, 5, 7, 8, 11, 13, 15, 17), ENDS, strict=True))
    before = pids(cluster)
    work = Naughty(ways=tuple(ways.items()))
    found = run_all(work, jobs, tmp_path / "a", Cluster(cluster.scheduler_address, LIMITS))
    assert {n: found[n]["status"] for n in ways} == {n: ENDS[way] for n, way in ways.items()}
    assert {n for n in found if found[n]["tries"] == 3} == {n for n in ways if ways[n] == "die"}
    serial = run_all(Quick(), jobs, tmp_path / "b")
    assert all(found[n]["value"] == serial[n]["value"] for n in range(20) if n not in ways)
    assert pids(cluster) == before, "no worker has died of it"


@pytest.mark.slow
@nightly
def test_lost_scheduler_stops_and_the_next_run_continues(cluster, tmp_path):
    jobs, lost = some_jobs(60), local_cluster()
    pids(lost)
    seen = After(8, lost.close)
    with pytest.raises(InputError, match="which was lost"):
        run_all(Quick(0.05), jobs, tmp_path / "a", Cluster(lost.scheduler_address, LIMITS), seen)
    again = After(99, lambda: None)
    executor = Cluster(cluster.scheduler_address, LIMITS)
    rows = run_all(Quick(0.05), jobs, tmp_path / "a", executor, again)
    assert not set(seen.keys) & set(again.keys)
    assert sorted([*seen.keys, *again.keys], key=int) == list(range(60))
    assert computed(rows) == computed(run_all(Quick(), jobs, tmp_path / "b"))


def test_absent_scheduler_is_an_input_error_without_traceback(monkeypatch):
    """Dask's client would log one; other programs' logs are theirs again afterwards."""
    log, heard = logging.getLogger("distributed.client"), list[bool]()

    def lost(*_: object, **__: object) -> None:
        heard.append(log.isEnabledFor(logging.CRITICAL))
        raise TimeoutError  # which says nothing

    monkeypatch.setattr(distributed, "Client", lost)
    with pytest.raises(InputError, match=r"none answers"):
        list(Cluster("tcp://127.0.0.1:9", LIMITS)(Quick(), some_jobs(1)))
    assert (heard, log.isEnabledFor(logging.CRITICAL)) == ([False], True)


def test_worker_of_other_versions_is_unfit():
    with pytest.raises(UnfitError, match="instead of"):
        run_in_child(pickle.dumps(({"scp_recon": "0"}, b"")), b"", LIMITS)


@pytest.mark.parametrize("address", ["foo", "", "tcp://127.0.0.1:x"])
def test_bad_address_is_refused(tmp_path, address):
    with pytest.raises(InputError, match="a Dask scheduler"):
        run_all(Quick(), some_jobs(2), tmp_path / "a", Cluster(address, LIMITS))


@pytest.mark.slow
def test_flights_on_a_cluster_are_the_same(cluster, solution, verification, tmp_path):
    replace(solution, verification=verification).write(tmp_path)
    words = [str(tmp_path), "--samples", "2500", "--seed", "4"]
    assert montecarlo.main(words) == 0
    alone = (tmp_path / FILE_NAME).read_bytes()
    assert montecarlo.main([*words, "--scheduler", cluster.scheduler_address]) == 0
    assert (tmp_path / FILE_NAME).read_bytes() == alone
