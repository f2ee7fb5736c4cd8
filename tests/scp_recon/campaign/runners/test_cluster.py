"""A campaign on a real cluster: a scheduler and three worker processes, which die as they may."""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from scp_recon import montecarlo
from scp_recon.campaign.engine.run import run_study
from scp_recon.campaign.rows.table import read_results
from scp_recon.campaign.runners.cluster import Cluster, Session
from scp_recon.campaign.runners.here import here
from scp_recon.campaign.study.study import Study
from scp_recon.errors import InputError
from scp_recon.monte_carlo.summary import FILE_NAME
from scp_recon.solution.file import Solution
from scp_recon.solution.verdict import Verification
from tests.scp_recon.campaign.support import LIMITS, computed, run, some_cases
from tests.scp_recon.campaign.works import ENDS, Naughty, Quick

distributed = pytest.importorskip("distributed")
PROJECT = Path(__file__).parents[4]
WORKERS = 3


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
        return subprocess.Popen(command, env=env, stdout=self._log, stderr=self._log)

    def _scheduler(self) -> subprocess.Popen[bytes]:
        words = ("--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard")
        return self._begin("dask_scheduler", *words)

    def _workers(self) -> subprocess.Popen[bytes]:
        words = ("--nworkers", str(WORKERS), "--nthreads", "1", "--no-dashboard")
        return self._begin("dask_worker", self.address, *words)

    def pids(self) -> list[int]:
        """Of the workers, once all are there."""
        with distributed.Client(self.address, timeout=60, set_as_default=False) as client:
            client.wait_for_workers(WORKERS, timeout=60)
            return sorted(client.run(os.getpid).values())

    def restart_scheduler(self) -> None:
        self.scheduler.kill()
        self.scheduler.wait()
        self.scheduler = self._scheduler()
        self.nannies.terminate()
        self.nannies.wait(timeout=60)
        self.nannies = self._workers()

    def close(self) -> None:
        for process in (self.nannies, self.scheduler):
            process.terminate()
        for process in (self.nannies, self.scheduler):
            try:
                process.wait(timeout=30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._log.close()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalCluster]:
    begun = LocalCluster(tmp_path_factory.mktemp("cluster") / "log.txt")
    yield begun
    begun.close()


class After:
    """Does something once, when so many cases are over."""

    def __init__(self, count: int, action: Any) -> None:
        self.count, self.action = count, action
        self.rows: list[Mapping[str, Any]] = []
        self.acted = False

    def __call__(self, done: int, total: int, row: Mapping[str, Any] | None) -> None:
        self.rows += [row] if row else []
        assert done <= total
        if done >= self.count and not self.acted:
            self.acted = True
            self.action()


def test_a_scheduler_without_workers_is_told_once_until_one_joins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    workers: list[dict[str, int]] = [{}, {}, {"a": 2}, {}]
    said: list[str] = []
    session = Session(Cluster("tcp://127.0.0.1:1", LIMITS, said.append), b"")
    session.client = SimpleNamespace(nthreads=lambda: workers.pop(0))
    monkeypatch.setattr("scp_recon.campaign.runners.cluster.LOOK_S", -1.0)
    counts = []
    while workers:
        session.room()
        counts.append(len(said))
    assert counts == [1, 1, 1, 2]
    assert "no workers" in said[0]


def test_a_worker_is_killed_in_mid_run(cluster: LocalCluster, tmp_path: Path) -> None:
    cases = some_cases(60)
    victim = cluster.pids()[0]
    killed = After(8, lambda: os.kill(victim, signal.SIGKILL))
    table = run(Quick(0.05), cases, tmp_path / "a", Cluster(cluster.address, LIMITS), killed)
    assert killed.acted
    assert sorted(row["case"] for row in killed.rows) == list(range(60))
    assert table.equals(run(Quick(), cases, tmp_path / "b", here))
    assert victim not in cluster.pids()


def test_cases_that_misbehave_are_rows(cluster: LocalCluster, tmp_path: Path) -> None:
    cases = some_cases(20)
    ways = dict(zip((2, 5, 7, 11, 13, 17), ENDS, strict=True))
    work = Naughty(ways=tuple(ways.items()))
    before = cluster.pids()
    run(work, cases, tmp_path / "a", Cluster(cluster.address, LIMITS))
    found = read_results(tmp_path / "a").set_index("case")
    assert {n: found.status[n] for n in ways} == {n: ENDS[way] for n, way in ways.items()}
    assert {n for n in found.index if found.tries[n] == 3} == {n for n in ways if ways[n] == "die"}
    tame = read_results(tmp_path / "a").set_index("case").drop(index=list(ways))
    run(Quick(), cases, tmp_path / "b", here)
    serial = read_results(tmp_path / "b").set_index("case").drop(index=list(ways))
    assert tame[["x", "seed", "status", "value"]].equals(serial[["x", "seed", "status", "value"]])
    assert cluster.pids() == before, "no worker has died of it"


def test_the_scheduler_is_restarted_in_mid_run(cluster: LocalCluster, tmp_path: Path) -> None:
    cases, said = some_cases(60), list[str]()
    cluster.pids()
    restarting = threading.Thread(target=cluster.restart_scheduler)
    seen = After(8, restarting.start)
    runner = Cluster(cluster.address, LIMITS, said.append)
    table = run(Quick(0.05), cases, tmp_path / "a", runner, seen)
    restarting.join()
    assert any("sent again" in line for line in said)
    assert sorted(row["case"] for row in seen.rows) == list(range(60))
    assert table.equals(run(Quick(), cases, tmp_path / "b", here))


def test_real_plans_have_the_same_bits_on_a_cluster(cluster: LocalCluster, tmp_path: Path) -> None:
    study = Study.validated(
        {
            "campaign": {"keep_solutions": True},
            "axis": [{"entry": "risk.p_chance", "values": [0.7]}],
        }
    )
    for name, runner in (("a", Cluster(cluster.address, LIMITS_OF_PLANS)), ("b", here)):
        run_study(study, tmp_path / name, runner)
    assert computed(tmp_path / "a").equals(computed(tmp_path / "b"))
    rows = read_results(tmp_path / "a")
    assert list(rows.verdict) == ["verified"]
    assert f"{rows.total_dv_m_s[0]:.6f}" == "0.140135"


LIMITS_OF_PLANS = type(LIMITS)(200.0, 4096)


def test_a_lost_scheduler_is_told_in_one_line_not_in_a_traceback(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Dask's client logs one; other programs' logs are theirs again afterwards."""
    log, seen = logging.getLogger("distributed.client"), list[str]()

    class Heard(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            seen.append(record.getMessage())

    heard = Heard()
    log.addHandler(heard)

    def lost(*_: object, **__: object) -> None:
        log.error("a traceback")
        raise TimeoutError  # which says nothing

    monkeypatch.setattr(distributed, "Client", lost)
    try:
        with pytest.raises(InputError, match=r"where none answers \(TimeoutError\)"):
            list(Cluster("tcp://127.0.0.1:9", LIMITS)(Quick(), some_cases(1)))
        log.error("another's")
    finally:
        log.removeHandler(heard)
    assert seen == ["another's"]


def test_without_a_scheduler_there_is_one_message(tmp_path: Path) -> None:
    began = time.monotonic()
    with pytest.raises(InputError, match="where none answers") as caught:
        run(Quick(), some_cases(3), tmp_path, Cluster("tcp://127.0.0.1:9", LIMITS))
    assert caught.value.entry == "--scheduler"
    assert time.monotonic() - began < 60


@pytest.mark.parametrize("address", ["foo", "", "tcp://127.0.0.1:x"])
def test_what_is_no_address_is_told_at_once(tmp_path: Path, address: str) -> None:
    with pytest.raises(InputError, match="must be the address of a Dask scheduler"):
        run(Quick(), some_cases(2), tmp_path / "a", Cluster(address, LIMITS))


def test_flights_are_the_same_on_a_cluster(
    cluster: LocalCluster, solution: Solution, verification: Verification, tmp_path: Path
) -> None:
    solution.model_copy(update={"verification": verification}).write(tmp_path)
    words = [str(tmp_path), "--samples", "5000", "--seed", "4"]
    assert montecarlo.main(words) == 0
    alone = (tmp_path / FILE_NAME).read_bytes()
    assert montecarlo.main([*words, "--scheduler", cluster.address]) == 0
    assert (tmp_path / FILE_NAME).read_bytes() == alone
