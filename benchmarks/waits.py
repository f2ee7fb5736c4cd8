"""Time the commands that users wait for: `python -m benchmarks.waits`.

Each command runs in a process of its own, all in turn several times. The processor's seconds hardly
depend on other work on the machine, so the smallest count.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()

import resource
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from experiments.harness import Findings, Session, Study, option, records, run
from scp_recon.jobs.job import Job

ROUNDS = 2

SOLVE = ["solve", "--init", "cold", "--set", "risk.allocation=exact"]
PLAIN = ["--set", "risk.sampling=plain"]
UNCERTIFIED = ["--certify", "no"]
MEASURED = {"lead_s": "0", "sigma_position_m": "10", "sigma_velocity_m_s": "0.0005"}
GAINS = ["--set", 'policy.kind="feedback"']
GAINS += [
    word for key, value in MEASURED.items() for word in ("--set", f"navigation.{key}={value}")
]


def exact(probability: float, scope: str) -> list[str]:
    """Words that solve with exact risk."""
    return [*SOLVE, "--set", f"risk.p_chance={probability}", "--set", f"risk.scope={scope}"]


WAITS = {
    "solve --help": ["solve", "--help"],
    "solve": ["solve", "--init", "cold"],
    "verify": ["verify", "{out}/solve"],
    "montecarlo --until 0.2%": [
        "montecarlo",
        "{out}/solve",
        "--until",
        "0.2%",
        "--samples",
        "1000000",
    ],
    "whole flights 0.90, uncertified": [*exact(0.9, "flight"), *UNCERTIFIED],
    "whole flights 0.90, certified by plain flights": [*exact(0.9, "flight"), *PLAIN],
    "whole flights 0.90, certified in strata": exact(0.9, "flight"),
    "each node 0.90, certified by plain flights": [*exact(0.9, "node"), *PLAIN],
    "each node 0.90, certified in strata": exact(0.9, "node"),
    "whole flights 0.99 with feedback, certified in strata": [*exact(0.99, "flight"), *GAINS],
    "design nightingale": ["design", "nightingale"],
}
"""Commands that users wait for; `{out}` has the plan of `solve`."""
WRITING = ("solve", "design")


def measure(session: Session) -> Findings:
    """Time every command."""
    rounds = 1 if session.options.quick else ROUNDS
    store = session.store()
    repeats = [Job(f"{round_} {name}", name) for round_ in range(rounds) for name in WAITS]
    rows = session.rows("waits", lambda name: waited(name, session.out), repeats, store)
    table = records(shortest(rows))
    return Findings([table], {"waits.csv": table})


def waited(name: str, out: Path) -> dict[str, Any]:
    """Seconds from a command's start to its end, of the wall clock and of the processor."""
    words = [word.format(out=out) for word in WAITS[name]]
    if words[0] in WRITING and "--help" not in words:
        words += ["--out", str(out / name)]
    begin, before = perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, "-m", "scp_recon", *words], check=True, stdout=subprocess.DEVNULL
    )
    used, seconds = resource.getrusage(resource.RUSAGE_CHILDREN), perf_counter() - begin
    processor = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
    return {"command": name, "wall_s": seconds, "processor_s": processor}


def shortest(waits: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of each command the run of least processor time."""
    best = sorted(waits, key=lambda row: float(row["processor_s"]), reverse=True)
    least = {row["command"]: row for row in best}
    return [least[name] for name in WAITS]


STUDY = Study(
    "Commands that users wait for",
    __doc__,
    measure,
    [option("--quick", action="store_true", help="one round")],
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    return run("python -m benchmarks.waits", STUDY, words)


if __name__ == "__main__":
    sys.exit(main())
