"""Time the planner in one run on one machine: `python -m benchmarks [WHAT]`.

WHAT is one of:

- methods (default): each method in a process of its own, with one thread, all in turn several times,
  so that other work on the machine affects all alike; the smallest figures count, by the wall clock.
- growth: how plans grow with nodes, facets and burns, in seconds of the processor.
- waits: the commands that users wait for, all in turn; the least of the processor's seconds counts,
  which hardly depends on other work.
- campaign_scale: overhead of a campaign per case, and plans per second by its executors. Figures are
  differences between many and few cases, so that the start cancels. It needs an idle machine.

After Ctrl-C it continues with what is missing. `make bench` sets up the environment.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import json
import pickle
import resource
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks import empty
from benchmarks.methods import QUANTITIES
from experiments.harness import (
    Findings,
    Record,
    Session,
    Study,
    option,
    records,
    run,
    run_python,
)
from formulations.arrays import Array
from scp_recon.api.campaigns import work_of
from scp_recon.campaigns.run import CaseWork, run_study
from scp_recon.campaigns.study import Study as Campaign
from scp_recon.errors import imported
from scp_recon.jobs.cluster import Cluster
from scp_recon.jobs.job import Executor, Job, here
from scp_recon.jobs.processes import Limits, Processes

ROUNDS, REPEATS = 3, 3
METHODS = {
    "scp condensed": REPEATS,
    "scp frozen-stm": REPEATS,
    "scp frozen-covariance": REPEATS,
    "scp lifted": 1,
    "ipopt tuned": REPEATS,
    "ipopt shooting": REPEATS,
    "ipopt printed": 1,
}
"""Number of later plans in a process; two are slow."""
REPLANS, FLIGHTS = "replans", "flights"
SAME_ARITHMETIC = {"OPENBLAS_CORETYPE": "Haswell", "OPENBLAS_NUM_THREADS": "1"}
"""OpenBLAS's kernels, which every x86 processor since 2013 has, on one thread, as commands have it. How
long IPOPT takes for the program as printed depends on rounding: with a newer processor's kernels it had
no plan after seven minutes."""
GROWING = ("scp condensed", "scp lifted", "ipopt tuned")

CERTIFIED = (
    "solve --init cold --set risk.allocation=exact --set risk.p_chance={p} --set risk.scope={of}"
)
FLIGHT, NODE = CERTIFIED.format(p=0.9, of="flight"), CERTIFIED.format(p=0.9, of="node")
PLAIN = " --set risk.sampling=plain"
GAINS = (
    ' --set policy.kind="feedback" --set navigation.lead_s=0'
    " --set navigation.sigma_position_m=10 --set navigation.sigma_velocity_m_s=0.0005"
)
WAITS = {
    "solve --help": "solve --help",
    "solve": "solve --init cold",
    "verify": "verify {out}/solve",
    "montecarlo --until 0.2%": "montecarlo {out}/solve --until 0.2% --samples 1000000",
    "whole flights 0.90, uncertified": FLIGHT + " --certify no",
    "whole flights 0.90, certified by plain flights": FLIGHT + PLAIN,
    "whole flights 0.90, certified in strata": FLIGHT,
    "each node 0.90, certified by plain flights": NODE + PLAIN,
    "each node 0.90, certified in strata": NODE,
    "whole flights 0.99 with feedback, certified in strata": CERTIFIED.format(p=0.99, of="flight")
    + GAINS,
    "design nightingale": "design nightingale",
}
"""Commands that users wait for; `{out}` has the plan of `solve`."""

FEW, MANY, PLANS, QUEUED = 200, 2_200, 48, 100_000
"""Empty cases, of which the times are compared; plans by each executor; cases of a scheduler."""
WHERE = {
    "this process": 1,
    "1 process": 1,
    "2 processes": 2,
    "Dask, 1 worker": 1,
    "Dask, 2 workers": 2,
}
"""Executors of a campaign, with their cores."""


def methods(session: Session) -> Findings:
    """Time every method and the command line."""
    store, rounds = session.store(), 1 if session.options.quick else ROUNDS
    what: dict[str, tuple[str, ...]]
    what = {name: ("planned", name, str(repeats)) for name, repeats in METHODS.items()}
    what |= {REPLANS: ("replanned",), FLIGHTS: ("flown", str(REPEATS))}
    every = product(range(rounds), what)
    jobs = [Job(f"{round_} {name}", what[name]) for round_, name in every]
    rows = session.rows("methods", in_a_process, jobs, store)
    found = {name: best([*rows[k :: len(what)]]) for k, name in enumerate(what)}
    repeats = [Job(f"command {number}", session.out) for number in range(2 * rounds)]
    times = session.rows("commands", command_times, repeats, store)
    commands = {name: min(row[name] for row in times) for name in times[0]}
    planned = [found[name] for name in METHODS]
    least = planned[0]["total_dv_m_s"]
    table = [
        {"method": row["method"], "total_dv_m_s": row["total_dv_m_s"]}
        | {"off": abs(row["total_dv_m_s"] / least - 1.0)}
        | {key: row[key] for key in row if key != "subproblem_s"}
        for row in planned
    ]
    return _found({"methods": table, "ratios": ratios(found, commands)})


def best(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The row with the least later seconds, and the least first seconds of all."""
    found = dict(min(rows, key=lambda row: row["later_s"]))
    return found | {"first_s": min(row["first_s"] for row in rows)} if "first_s" in found else found


def in_a_process(words: Sequence[str]) -> dict[str, Any]:
    """The row of `benchmarks.methods` with these words."""
    said = run_python(["-m", "benchmarks.methods", *words], setting=SAME_ARITHMETIC)[1]
    found: dict[str, Any] = json.loads(said)
    return found


def command_times(out: Path) -> dict[str, float]:
    """Process start to end of the command line, and of importing CVXPY, s."""
    solve = ["-m", "scp_recon.solve", "--out", str(out / "solve")]
    commands = {"solve": solve, "import cvxpy": ["-c", "import cvxpy"]}
    return {name: run_python(words)[0]["wall_s"] for name, words in commands.items()}


def ratios(found: Mapping[str, Mapping[str, Any]], commands: Mapping[str, float]) -> list[Record]:
    """Ratios of the methods' times, and of the commands', with what they are made from."""
    ours, printed = found["scp condensed"], found["ipopt printed"]
    tuned = [found[name] for name in ("ipopt tuned", "ipopt shooting")]
    conic, again, solve = ours["conic_solver_s"], found[REPLANS], commands["solve"]
    first, built = min(row["first_s"] for row in tuned), min(map(_without_setup, tuned))
    rows = {
        "IPOPT as printed over SCP, first plan of a process": printed["first_s"] / ours["first_s"],
        "IPOPT as printed over SCP": _without_setup(printed) / _without_setup(ours),
        "best tuned NLP over SCP, first plan of a process": first / ours["first_s"],
        "best tuned NLP over SCP": built / _without_setup(ours),
        "conic solver, s": conic,
        "subproblem of P2, s": ours["subproblem_s"],
        "all else over the conic solver": (ours["later_s"] - conic) / conic,
        "canonicalisation over the conic solver": ours["canonicalise_s"] / conic,
        "first plan of a process less a later one, s": ours["first_s"] - ours["later_s"],
        "replans": again["replans"],
        "replans converged": again["converged"],
        "replan, s": again["later_s"],
        "cold plan of the same state, s": again["cold_s"],
        "replan over cold plan": again["later_s"] / again["cold_s"],
        "flights a second": found[FLIGHTS]["flights"] / found[FLIGHTS]["later_s"],
        "command line, s": solve,
        "command line over importing CVXPY": solve / commands["import cvxpy"],
    }
    return [{"figure": name, "value": value} for name, value in rows.items()]


def _without_setup(row: Mapping[str, Any]) -> float:
    """Seconds of the fastest later plan without building."""
    return float(row["later_s"] - row["setup_s"])


def growth(session: Session) -> Findings:
    """Measure how plans grow."""
    growing = GROWING[:1] if session.options.quick else GROWING
    cases = product(["growth"], QUANTITIES, growing)
    return _found({"growth": session.rows("growth", in_a_process, cases, session.store())})


def waits(session: Session) -> Findings:
    """Time every command, and keep of each the run of least processor time."""
    rounds = 1 if session.options.quick else ROUNDS - 1
    runs = product(range(rounds), WAITS)
    rows = session.rows("waits", lambda one: waited(one[1], session.out), runs, session.store())
    ends = (rows[k :: len(WAITS)] for k in range(len(WAITS)))
    return _found({"waits": [min(own, key=lambda row: row["processor_s"]) for own in ends]})


def waited(name: str, out: Path) -> dict[str, Any]:
    """Seconds of a command."""
    words = [word.format(out=out) for word in WAITS[name].split()]
    if words[0] in ("solve", "design") and "--help" not in words:
        words += ["--out", str(out / name)]
    return {"command": name, **run_python(["-m", "scp_recon", *words])[0]}


def campaign_scale(session: Session) -> Findings:
    """Time empty cases and plans by every executor, and a scheduler's queue."""
    imported("cluster", "cluster", "distributed", "psutil")
    limits, found = Limits(600.0, memory_mb=4096), list[Record]()
    axis = {"entry": "risk.p_chance", "grid": {"from": 0.7, "to": 0.8, "count": PLANS}}
    study = Campaign.validated({"axis": [axis]})
    plans, two = work_of(study), replace(study, axes=tuple(rows[:2] for rows in study.axes))
    few, many = (replace(study, axes=([{}] * cases,)) for cases in (FEW, MANY))
    for where, cores in WHERE.items():
        with ExitStack() as stack:
            executor: Executor = here
            if "Dask" in where:
                executor = Cluster(stack.enter_context(local_cluster(cores)), limits)
            elif "this" not in where:
                executor = Processes(cores, limits)
            _, empty_s = (spent(empty, many, executor) - spent(empty, few, executor)) / (MANY - FEW)
            more = spent(plans, study, executor) - spent(plans, two, executor)
            wall_s, plan_s = more / (PLANS - len(two.cases))
        row = {"where": where, "empty_s": empty_s, "plan_s": plan_s, "plans_a_second": 1.0 / wall_s}
        alone = found[0]["plans_a_second"] if found else row["plans_a_second"]
        found.append({**row, "efficiency": row["plans_a_second"] / cores / alone})
        session.say(", ".join(f"{key} {value}" for key, value in found[-1].items()))
    return _found({"campaign_scale": found, "scheduler": [scheduler()]})


def spent(work: CaseWork, study: Campaign, executor: Executor) -> Array:
    """Seconds of running a study into a new folder, of the wall clock and of all processes."""
    with tempfile.TemporaryDirectory() as folder:
        before = _clocks()
        run_study(study, Path(folder), work, executor)
        return _clocks() - before


def _clocks() -> Array:
    """Wall clock; processor time of this process, of ended children and of those still running."""
    import psutil

    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    running = psutil.Process().children(recursive=True)
    # Times are a child's own, and those of its children that have ended.
    children = sum(sum(process.cpu_times()[:4]) for process in running)
    own = time.process_time() + ended.ru_utime + ended.ru_stime
    return np.array([perf_counter(), own + children])


@contextmanager
def local_cluster(workers: int) -> Iterator[str]:
    """A scheduler and workers of one thread each, as processes of their own."""
    from distributed.deploy.subprocess import SubprocessCluster

    size = {"n_workers": workers, "threads_per_worker": 1, "dashboard_address": None}
    with SubprocessCluster(**size) as cluster:
        yield cluster.scheduler_address


def scheduler() -> Record:
    """Megabytes of a scheduler without and with queued cases, and its processor time for them, s."""
    import distributed
    import psutil

    with (
        local_cluster(0) as address,
        distributed.Client(address, timeout=120, set_as_default=False) as client,
    ):
        (process,) = psutil.Process().children()
        before, cpu = process.memory_info().rss, sum(process.cpu_times()[:2])
        jobs = [pickle.dumps(Job(case, {})) for case in range(QUEUED)]
        sent = client.map(empty, jobs, pure=False, batch_size=10_000)
        while client.run_on_scheduler(_tasks) < len(sent):
            time.sleep(0.5)
        after, took = process.memory_info().rss, sum(process.cpu_times()[:2]) - cpu
    sizes = {"before_mb": before / 1e6, "after_mb": after / 1e6}
    return {"queued": QUEUED, **sizes, "scheduler_s": took}


def _tasks(dask_scheduler: Any) -> int:
    """Number of tasks that a scheduler holds."""
    return len(dask_scheduler.tasks)


def _found(tables: Mapping[str, Sequence[Record]]) -> Findings:
    return Findings({f"{name}.csv": records(rows) for name, rows in tables.items()})


QUICK = option("--quick", action="store_true", help="one round, or one method")
STUDIES = {
    "methods": Study(__doc__, methods, [QUICK]),
    "growth": Study(__doc__, growth, [QUICK]),
    "waits": Study(__doc__, waits, [QUICK]),
    "campaign_scale": Study(__doc__, campaign_scale),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    words = [*(sys.argv[1:] if arguments is None else arguments)]
    prog, name = "python -m benchmarks", "methods"
    if words and words[0] in STUDIES:
        name = words.pop(0)
        prog += f" {name}"
    return run(prog, STUDIES[name], words)


if __name__ == "__main__":
    sys.exit(main())
