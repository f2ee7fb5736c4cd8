"""Run jobs into a store, and compare rows."""

import os
from collections.abc import Callable, Generator, Iterable, Mapping
from pathlib import Path
from typing import Any

from scp_recon.jobs.job import Done, Executor, Job, Key, Work, attempt
from scp_recon.jobs.processes import Limits
from scp_recon.jobs.store import Row, Store, run

LIMITS = Limits(6.0, cpu_s=0.5, memory_mb=256)
DEPENDS_ON = {"of": "a test"}
TOOK = ("tries", "seconds", "cpu_s")

Rows = dict[Key, dict[str, Any]]


def children(of: int | None = None) -> list[int]:
    """Processes that a process has begun and not waited for, by the system's list."""
    pid, found = of or os.getpid(), []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.append(int(stat.parent.name))
    return found


def some_jobs(count: int) -> list[Job]:
    return [Job(number, number) for number in range(count)]


def backwards(work: Work, jobs: Iterable[Job]) -> Generator[Done, None, None]:
    """An executor that ends the last job first."""
    yield from (attempt(work, job) for job in reversed(list(jobs)))


def row_of(done: Done) -> Row:
    """Everything that is known, what was measured too."""
    took = {name: getattr(done, name) for name in TOOK}
    if done.failure:
        return Row({"status": done.failure.status, "message": done.failure.message} | took)
    return Row({"status": "done", **done.value} | took, {f"files/{done.key}.txt": b"a file"})


def run_all(
    work: Work,
    jobs: Iterable[Job],
    folder: Path,
    executor: Executor | None = None,
    on_done: Callable[[Key, Mapping[str, Any]], None] | None = None,
) -> Rows:
    """Rows by key, each with what it took."""
    with Store(folder / "rows.jsonl", DEPENDS_ON) as store:
        run(work, jobs, store, executor, row_of=row_of, on_done=on_done)
        return dict(store.rows())


def computed(rows: Rows) -> Rows:
    """Without what was measured, in the order of the keys."""
    return {
        key: {name: value for name, value in rows[key].items() if name not in TOOK}
        for key in sorted(rows, key=repr)
    }
