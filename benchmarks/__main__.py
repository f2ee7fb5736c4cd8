"""Time the planner in one run on one machine: `python -m benchmarks [WHAT]`.

WHAT is one of:

- methods (default): each method in a process of its own, with one thread, all in turn several times,
  so that other work on the machine affects all alike; the smallest figures count, by the wall clock.
- waits: the commands that users wait for, all in turn; the least of the processor's seconds counts,
  which hardly depends on other work.

After Ctrl-C it continues with what is missing. `make bench` sets up the environment.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from experiments.harness import Record, Session, Study, Tables, run, run_python
from scp_recon.files import write_atomically
from scp_recon.jobs.job import Job

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

CERTIFIED = (
    "solve --init cold --set risk.allocation=exact --set risk.p_chance={p} --set risk.scope={of}"
)
FLIGHT, NODE = CERTIFIED.format(p=0.9, of="flight"), CERTIFIED.format(p=0.9, of="node")
PLAIN = " --set risk.sampling=plain"
GAINS = (
    ' --set policy.kind="feedback" --set navigation.lead_s=0'
    " --set navigation.sigma_position_m=10 --set navigation.sigma_velocity_m_s=0.0005"
)
DELIVERED = "-126.629 442.342 -596.582 0.0062679 0.0763651 0.0599579"
"""The state on the page of replanning, m and m/s."""
STUDY_OF_32 = """[campaign]
base = "recon_b"
[[axis]]
entry = "uncertainty.execution_error"
grid = { from = 0.02, to = 0.16, count = 8, scale = "log" }
[[axis]]
entry = "uncertainty.initial_sigma_fraction"
values = [0.0, 0.005, 0.01, 0.02]
"""
"""The study on the page of campaigns."""
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
    "replan": "replan {out}/solve --at 17000 --state " + DELIVERED,
    "windows recon_b": "windows recon_b",
    "campaign of 32 plans": "campaign {out}/study.toml --out {out}/campaign",
}
"""Commands that users wait for; `{out}` has the plan of `solve`."""


def methods(session: Session) -> Tables:
    """Time every method and the command line."""
    what: dict[str, tuple[str, ...]]
    what = {name: ("planned", name, str(repeats)) for name, repeats in METHODS.items()}
    what |= {REPLANS: ("replanned",), FLIGHTS: ("flown", str(REPEATS))}
    every = product(range(ROUNDS), what)
    jobs = [Job(f"{round_} {name}", what[name]) for round_, name in every]
    rows = session.rows("methods", in_a_process, jobs)
    found = {name: best([*rows[k :: len(what)]]) for k, name in enumerate(what)}
    repeats = [Job(f"command {number}", session.out) for number in range(2 * ROUNDS)]
    times = session.rows("commands", command_times, repeats)
    commands = {name: min(row[name] for row in times) for name in times[0]}
    planned = [found[name] for name in METHODS]
    least = planned[0]["total_dv_m_s"]
    table = [
        {"method": row["method"], "total_dv_m_s": row["total_dv_m_s"]}
        | {"off": abs(row["total_dv_m_s"] / least - 1.0)}
        | {key: row[key] for key in row if key != "subproblem_s"}
        for row in planned
    ]
    return {"methods": table, "ratios": ratios(found, commands)}


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


def waits(session: Session) -> Tables:
    """Time every command, and keep of each the run of least processor time."""
    runs = product(range(ROUNDS - 1), WAITS)
    rows = session.rows("waits", lambda one: waited(one[1], session.out), runs)
    ends = (rows[k :: len(WAITS)] for k in range(len(WAITS)))
    return {"waits": [min(own, key=lambda row: row["processor_s"]) for own in ends]}


def waited(name: str, out: Path) -> dict[str, Any]:
    """Seconds of a command."""
    words = [word.format(out=out) for word in WAITS[name].split()]
    if words[0] == "campaign":
        write_atomically(out / "study.toml", STUDY_OF_32)
        shutil.rmtree(out / "campaign", ignore_errors=True)  # a finished one is not run again
    elif words[0] in ("solve", "design", "replan") and "--help" not in words:
        words += ["--out", str(out / name)]
    return {"command": name, **run_python(["-m", "scp_recon", *words])[0]}


STUDIES = {"methods": Study(__doc__, methods), "waits": Study(__doc__, waits)}


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
