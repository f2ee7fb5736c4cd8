"""Time a campaign's overhead per case: `python -m benchmarks.campaign_scale`.

Plans are those of `recon_b` with their verification; empty cases do nothing, so that their time is the
overhead. Figures are differences between many and few cases, per case, so that the start cancels.
Processor time is that of all processes involved, and hardly depends on other work; throughput and
efficiency are by wall time, and need an idle machine.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint, parse, run_command

if __name__ == "__main__":
    exit_on_sigint()

import argparse
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

from rich.console import Console

from benchmarks import empty
from scp_recon.api.campaigns import work_of
from scp_recon.campaigns.cases import Cases
from scp_recon.campaigns.run import CaseWork, run_study
from scp_recon.campaigns.study import Study
from scp_recon.cli.options import int_between
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    p = argparse.ArgumentParser(prog="python -m benchmarks.campaign_scale", description=__doc__)
    p.add_argument("--plans", type=int_between(3, 10_000), default=32, metavar="N")
    p.add_argument("--queued", type=int_between(100, 10**7), default=100_000, metavar="N")
    options = parse(p, arguments)
    return run_command(lambda console: _measure(options, console), options)


def _measure(options: argparse.Namespace, console: Console) -> int:
    imported("cluster", "cluster", "distributed", "psutil")
    study = Study.validated(
        {
            "axis": [
                {
                    "entry": "risk.p_chance",
                    "grid": {"from": 0.7, "to": 0.8, "count": options.plans},
                }
            ]
        }
    )
    plans = work_of(study)
    first = replace(study, axes=tuple(rows[:2] for rows in study.axes))
    one, few, many = (replace(study, axes=([{}] * count,)) for count in (1, FEW, MANY))
    serial = 0.0
    for name, cores, executor in _executors():
        begun = spent(empty, one, executor)
        less, more = spent(empty, few, executor), spent(empty, many, executor)
        console.print(
            f"{name:16} {_empty_line(more.a_case(less, MANY - FEW), begun)}", highlight=False
        )
        started = spent(plans, first, executor)
        a_plan = spent(plans, study, executor).a_case(started, options.plans - len(first.cases))
        serial = serial or a_plan.wall
        console.print(
            f"{name:16} plan {a_plan.cpu:.3f} s of processor; {1.0 / a_plan.wall:.2f} plans a second, "
            f"efficiency {serial / (cores * a_plan.wall):.1%}",
            highlight=False,
        )
    before, after, seconds = scheduler_memory(options.queued)
    console.print(
        f"scheduler with {options.queued} queued: {before:.0f} MB, then {after:.0f} MB, "
        f"{1e3 * (after - before) / options.queued:.2f} kB a case; {seconds:.1f} s of its processor",
        highlight=False,
    )
    return 0


def _empty_line(a_case: Spent, begun: Spent) -> str:
    scheduler = f", the scheduler's {1e3 * a_case.scheduler:.2f}" if a_case.scheduler else ""
    return (
        f"empty case {1e3 * a_case.cpu:.2f} ms of processor: the campaign's "
        f"{1e3 * a_case.campaign:.2f}{scheduler}; the first one {begun.cpu:.2f} s"
    )


def _executors() -> Iterator[tuple[str, int, Executor]]:
    yield "this process", 1, here
    for workers in (1, 2):
        yield f"{workers} process{'es' * (workers > 1)}", workers, Processes(workers, LIMITS)
    for workers in (1, 2):
        with local_cluster(workers) as address:
            name = f"Dask, {workers} worker{'s' * (workers > 1)}"
            yield name, workers, Cluster(address, LIMITS)


def spent(work: CaseWork, study: Study, executor: Executor) -> Spent:
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


if __name__ == "__main__":
    sys.exit(main())
