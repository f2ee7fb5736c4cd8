"""Time a campaign's overhead per case: `python -m benchmarks.campaign_scale`.

Plans are those of `recon_b` with their verification; empty cases do nothing, so that their time is the
overhead. Figures are differences between many and few cases, per case, so that the start cancels.
Processor time is that of all processes involved, and hardly depends on other work; throughput and
efficiency are by wall time, and need an idle machine.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import os
import pickle
import resource
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import empty
from experiments.harness import Findings, Record, Session, Study, number, records
from experiments.harness import run as run_command
from scp_recon.api.campaigns import work_of
from scp_recon.campaigns.cases import Cases
from scp_recon.campaigns.run import CaseWork, run_study
from scp_recon.campaigns.study import Study as Campaign
from scp_recon.errors import imported
from scp_recon.jobs.cluster import Cluster, run_in_child
from scp_recon.jobs.job import Executor, Job, here
from scp_recon.jobs.processes import Limits, Processes
from scp_recon.jobs.store import versions

LIMITS = Limits(600.0, memory_mb=4096)
FEW, MANY = 200, 2_200


class Spent(NamedTuple):
    """Wall time and processor time of all processes, of the campaign's and of Dask's scheduler, s."""

    wall: float
    cpu: float
    campaign: float
    scheduler: float

    def a_case(self, fewer: Spent, cases: int) -> Spent:
        """Times per case, over those of a run with fewer cases."""
        return Spent(*((more - less) / cases for more, less in zip(self, fewer, strict=True)))


def measure(session: Session) -> Findings:
    """Time empty cases and plans by every executor, and a scheduler's queue."""
    imported("cluster", "cluster", "distributed", "psutil")
    count, queued = session.options.plans, session.options.queued
    axis = {"entry": "risk.p_chance", "grid": {"from": 0.7, "to": 0.8, "count": count}}
    study = Campaign.validated({"axis": [axis]})
    plans = work_of(study)
    first = replace(study, axes=tuple(rows[:2] for rows in study.axes))
    few, many = (replace(study, axes=([{}] * cases,)) for cases in (FEW, MANY))
    found = list[Record]()
    for name, cores, executor in _executors():
        overhead = spent(empty, many, executor).a_case(spent(empty, few, executor), MANY - FEW)
        started = spent(plans, first, executor)
        a_plan = spent(plans, study, executor).a_case(started, count - len(first.cases))
        found.append(
            {
                "where": name,
                "empty_s": overhead.cpu,
                "empty_campaign_s": overhead.campaign,
                "empty_scheduler_s": overhead.scheduler,
                "plan_s": a_plan.cpu,
                "plans_a_second": 1.0 / a_plan.wall,
                "cores": cores,
            }
        )
        found[-1]["efficiency"] = found[-1]["plans_a_second"] / cores / found[0]["plans_a_second"]
        session.say(", ".join(f"{key} {value}" for key, value in found[-1].items()))
    before, after, seconds = scheduler_memory(queued)
    queue = {"queued": queued, "before_mb": before, "after_mb": after, "scheduler_s": seconds}
    tables = {"campaign_scale.csv": records(found), "scheduler.csv": records([queue])}
    return Findings([], tables)


def _executors() -> Iterator[tuple[str, int, Executor]]:
    yield "this process", 1, here
    for workers in (1, 2):
        yield f"{workers} process{'es' * (workers > 1)}", workers, Processes(workers, LIMITS)
    for workers in (1, 2):
        with local_cluster(workers) as address:
            name = f"Dask, {workers} worker{'s' * (workers > 1)}"
            yield name, workers, Cluster(address, LIMITS)


def spent(work: CaseWork, study: Campaign, executor: Executor) -> Spent:
    """Times of running a study into a new folder."""
    with tempfile.TemporaryDirectory() as folder:
        before = _clocks()
        run_study(study, Path(folder), work, executor)
        return _clocks().a_case(before, 1)


def _clocks() -> Spent:
    """Processor time of this process, of its ended children and of those still running."""
    import psutil

    own, ended = time.process_time(), resource.getrusage(resource.RUSAGE_CHILDREN)
    total, scheduler = own + ended.ru_utime + ended.ru_stime, 0.0
    for process in psutil.Process().children(recursive=True):
        times = process.cpu_times()
        total += sum(times[:4])  # its own, and its children's that have ended
        if "scheduler" in " ".join(process.cmdline()):  # Dask sets its processes' titles
            scheduler += sum(times[:2])
    return Spent(time.perf_counter(), total, own, scheduler)


@contextmanager
def local_cluster(workers: int) -> Iterator[str]:
    """A scheduler and workers of one thread each, as processes of their own."""
    port = _free_port()
    address = f"tcp://127.0.0.1:{port}"
    begun = [_dask("dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")]
    if workers:
        words = ("--nworkers", str(workers), "--nthreads", "1", "--no-dashboard")
        begun.append(_dask("dask_worker", address, *words))
    try:
        import distributed

        with distributed.Client(address, timeout=120, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=120) if workers else None
        yield address
    finally:
        for process in reversed(begun):
            process.terminate()
            process.wait()


def _dask(command: str, *words: str) -> subprocess.Popen[bytes]:
    root = str(Path(__file__).parents[1])
    return subprocess.Popen(
        [sys.executable, "-m", f"distributed.cli.{command}", *words],
        env={**os.environ, "PYTHONPATH": root},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def scheduler_memory(queued: int) -> tuple[float, float, float]:
    """Megabytes of a scheduler without and with queued cases, and its processor time for them, s."""
    import distributed
    import psutil

    cases = Cases(([{}] * queued,), 0)
    jobs = [pickle.dumps(Job(case.number, case)) for case in cases]
    with (
        local_cluster(0) as address,
        distributed.Client(address, timeout=120, set_as_default=False) as client,
    ):
        work = client.submit(bytes, pickle.dumps((versions(), pickle.dumps(empty))), pure=False)
        process = psutil.Process().children()[0]
        before, cpu = process.memory_info().rss, sum(process.cpu_times()[:2])
        some = {"pure": False, "batch_size": 10_000}
        sent = client.map(run_in_child, [work] * queued, jobs, [LIMITS] * queued, **some)
        while client.run_on_scheduler(_tasks) < len(sent):
            time.sleep(0.5)
        after, took = process.memory_info().rss, sum(process.cpu_times()[:2]) - cpu
    return before / 1e6, after / 1e6, took


def _tasks(dask_scheduler: Any) -> int:
    """Number of tasks that a scheduler holds."""
    return len(dask_scheduler.tasks)


STUDY = Study(
    "Scale of campaigns",
    __doc__,
    measure,
    [
        number("--plans", 48, 3, 10_000, "plans each way"),
        number("--queued", 100_000, 100, 10**7, "cases that a scheduler is given"),
    ],
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    return run_command("python -m benchmarks.campaign_scale", STUDY, words)


if __name__ == "__main__":
    sys.exit(main())
