"""What a case of a campaign costs beside its plan: `python -m experiments.campaign_scale`.

Processor time of all processes that take part, so that what else the machine does counts little. Plans
are those of `recon_b` with their verification; empty cases do nothing, and what they take is the way
there and back. A figure is the difference between many and few cases, a case: starts cancel.
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.campaign_scale.empty import Empty
from scp_recon.campaign.engine.run import run_cases
from scp_recon.campaign.engine.work import work_of
from scp_recon.campaign.rows.case import Case, Runner, Work
from scp_recon.campaign.runners.child import Limits
from scp_recon.campaign.runners.cluster import Cluster, run_in_child
from scp_recon.campaign.runners.here import here
from scp_recon.campaign.runners.processes import Processes
from scp_recon.campaign.study.cases import Cases
from scp_recon.campaign.study.study import Study
from scp_recon.cli.options import int_between
from scp_recon.errors import needing

LIMITS = Limits(600.0, 4096)
FEW, MANY = 200, 2_200


@dataclass(frozen=True)
class Spent:
    """Wall time and processor time of all processes, s."""

    wall: float
    cpu: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    p = argparse.ArgumentParser(prog="python -m experiments.campaign_scale", description=__doc__)
    p.add_argument("--plans", type=int_between(3, 10_000), default=8, metavar="N")
    p.add_argument("--queued", type=int_between(100, 10**7), default=100_000, metavar="N")
    options = parse(p, arguments)
    return run_command(lambda console: _measure(options, console), options)


def _measure(options: argparse.Namespace, console: Console) -> int:
    with needing("cluster", "cluster"):
        import distributed  # noqa: F401
        import psutil  # noqa: F401
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
    plans, empty = work_of(study), Empty()
    first = Cases(tuple(rows[:2] for rows in study.axes), 0)
    few, many = Cases(([{}] * FEW,), 0), Cases(([{}] * MANY,), 0)
    for name, runner in _runners():
        begun = spent(empty, Cases(([{}],), 0), runner)
        less, more = spent(empty, few, runner), spent(empty, many, runner)
        case_ms = 1e3 * (more.cpu - less.cpu) / (MANY - FEW)
        console.print(
            f"{name:22} empty case {case_ms:.2f} ms of processor; the first one {begun.cpu:.2f} s",
            highlight=False,
        )
        started = spent(plans, first, runner)
        took, rest = spent(plans, study.cases, runner), options.plans - len(first)
        console.print(
            f"{name:22} plan {(took.cpu - started.cpu) / rest:.3f} s of processor and "
            f"{(took.wall - started.wall) / rest:.2f} s of wall time",
            highlight=False,
        )
    before, after, seconds = scheduler_memory(options.queued)
    console.print(
        f"scheduler with {options.queued} queued: {before:.0f} MB, then {after:.0f} MB, "
        f"{1e3 * (after - before) / options.queued:.2f} kB a case; {seconds:.1f} s of its processor",
        highlight=False,
    )
    return 0


def _runners() -> Iterator[tuple[str, Runner]]:
    yield "this process", here
    for workers in (1, 2):
        yield f"{workers} process{'es' * (workers > 1)}", Processes(workers, LIMITS)
    for workers in (1, 2):
        with local_cluster(workers) as address:
            yield f"Dask, {workers} worker{'s' * (workers > 1)}", Cluster(address, LIMITS)


def spent(work: Work, cases: Sequence[Case], runner: Runner) -> Spent:
    """What running cases into a new folder takes."""
    with tempfile.TemporaryDirectory() as folder:
        wall, cpu = time.perf_counter(), _processor_s()
        run_cases(work, cases, Path(folder), runner, {"hash": ""}, {})
        return Spent(time.perf_counter() - wall, _processor_s() - cpu)


def _processor_s() -> float:
    """Of this process, those that it began and that have ended, and those that are there."""
    import psutil

    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    total = time.process_time() + ended.ru_utime + ended.ru_stime
    for process in psutil.Process().children(recursive=True):
        total += sum(process.cpu_times()[:4])  # its own, and its children's that have ended
    return total


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
    root = str(Path(__file__).parents[2])
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

    cases = [tuple(case) for case in Cases(([{}] * queued,), 0)]
    with (
        local_cluster(0) as address,
        distributed.Client(address, timeout=120, set_as_default=False) as client,
    ):
        work = client.submit(bytes, pickle.dumps(Empty()), pure=False)
        process = psutil.Process().children()[0]
        before, cpu = process.memory_info().rss, sum(process.cpu_times()[:2])
        some = {"pure": False, "batch_size": 10_000}
        sent = client.map(run_in_child, [work] * queued, cases, [LIMITS] * queued, **some)
        while client.run_on_scheduler(_tasks) < len(sent):
            time.sleep(0.5)
        after, took = process.memory_info().rss, sum(process.cpu_times()[:2]) - cpu
    return before / 1e6, after / 1e6, took


def _tasks(dask_scheduler: Any) -> int:
    """How many a scheduler holds."""
    return len(dask_scheduler.tasks)


if __name__ == "__main__":
    sys.exit(main())
