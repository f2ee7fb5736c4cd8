"""A record of what the commands answer, to show that a refactoring has changed nothing.

    python -m tests.record OUT.json [--only NAME ...]
    python -m tests.record --compare A.json B.json

Each run starts `python -m scp_recon` in a folder of its own and keeps exit status, JSON document and
what JSON, CSV and Parquet files hold, by their places. It knows the command line alone, no module by
its name. Long lists are kept as number, least, largest and root mean square.
"""

import argparse
import csv
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pyarrow import parquet

TREE = Path(__file__).resolve().parents[1]
LONG = 12
# Commands between semicolons; `plan` is the default plan, and `solve` writes to `out`.
COMMANDS = """
default: solve
warm: solve --init warm
p3: solve --problem P3
facet_rounds: solve --facet-rounds 1
tangent: solve --set 'polytopes.ball="tangent"'
likelier: solve --set risk.p_chance=0.8
lifted: solve --formulation lifted
frozen_stm: solve --formulation frozen-stm
frozen_covariance: solve --formulation frozen-covariance
ptr: solve --algorithm ptr
scvx_star: solve --algorithm scvx-star
qoco: solve --solver QOCO
ecos: solve --solver ECOS
ipopt: solve --method ipopt
exact_node: solve EXACT --certify no --set risk.p_chance=0.9
exact_flight: solve EXACT --certify no --set risk.p_chance=0.9 --set 'risk.scope="flight"'
exact_certified: solve EXACT --set 'risk.scope="flight"'
probability: solve EXACT --certify no --objective probability --dv-budget 0.115
starts: solve --starts 3 --seed 0
infeasible_frame: solve --set 'boundary.frame="j2000"' --set grid.step_max_s=450
infeasible_risk: solve --set risk.p_chance=0.999
gates: solve --scenario gates.toml
warned: solve --problem P3 --set uncertainty.initial_sigma_fraction=0.00001
unknown_key: solve --set risk.p_chanse=0.8
out_of_range: solve --set risk.p_chance=1.2
misspelt_option: solve --formulaton lifted
unreadable_file: solve --scenario garbled.toml
wrong_unit: solve --set 'boundary.initial_position_m=[0.0702, -1.0963, 0.4064]'
replan: replan plan --at 17000 --state state_17000.txt --out out
replan_last: replan plan --at 26000 --state state_26000.txt --out out
verify: verify plan
compare: solve --quiet --init plan/solution.json --problem P3; compare plan out
flights: montecarlo plan --samples 2000 --seed 3
flights_until: montecarlo plan --until 2% --samples 20000
flights_harmonics: montecarlo plan --samples 500 --truth harmonics
windows: windows recon_b --span-days 3 --csv windows.csv
export: export plan --format csv; export plan --format oem; export plan --format parquet
simulate: simulate plan
design: design pass.toml --out out
campaign: campaign study.toml --out out --workers 0
new: new draft --body Bennu --site 20,150 EPOCH
new_from_csv: export plan --format csv; new track --body Bennu --site 55.9,41.8 --from-csv *.csv EPOCH
new_from_oem: export plan --format oem; new track --body Bennu --site 55.9,41.8 --from-oem *.oem
"""
SHORT = {"EXACT": "--set 'risk.allocation=\"exact\"'", "EPOCH": "--epoch 2020-01-21T20:33:17.184"}
RUNS = dict(line.split(": ", 1) for line in COMMANDS.strip().splitlines())
INPUTS = {
    "gates.toml": """base = "recon_b"
uncertainty.initial_sigma_fraction = 0.01
uncertainty.gates.magnitude_fixed_m_s = 0.001
uncertainty.gates.magnitude_proportional = 0.01
uncertainty.gates.pointing_fixed_m_s = 0.001
uncertainty.gates.pointing_proportional_rad = 0.0087
uncertainty.gates.magnitude_bias = 0.01
""",
    "pass.toml": """base = "recon_b"
name = "terminator"
boundary.home.radius_m = 1000.0
boundary.home.normal = [1, 0, 0]
boundary.home.sense = "left_handed"
boundary.home.departure_deg = [155, 165]
boundary.home.arrival_deg = [-5, 5]
design.burn_times = "given"
polytopes = { ball = "tangent", cone = 12 }
grid.step_max_s = 450.0
""",
    "study.toml": """campaign = { base = "recon_b", do = "fly", samples = 1000 }
axis = [
    { entry = "uncertainty.execution_error", values = [0.04, 0.08] },
    { entry = "risk.p_chance", values = [0.7, 0.999] },
]
""",
}
FORGOTTEN = {
    *("timing_s", "solver_s", "seconds", "cpu_s", "tries", "versions", "plan_hash", "hash"),
    *("files", "inputs_sha256", "predicted", "actual", "max_defect"),
    *("folder", "file", "init", "parent"),
}
"""Seconds, paths, hashes, and what is rounding alone."""
TODAY = re.compile(r"\d{8}T\d{6}Z|20(2[5-9]|[3-9]\d)-\d\d-\d\d[T ][\d:.]+|[0-9a-f]{64}")


def main() -> int:
    """Record the runs, or compare two records; 1 where they differ."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", nargs="?", type=Path, metavar="OUT.json")
    parser.add_argument("--only", nargs="+", choices=RUNS, default=list(RUNS), metavar="NAME")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("A.json", "B.json"))
    given = parser.parse_args()
    if given.compare:
        return compared(*(json.loads(path.read_text()) for path in given.compare))
    if not given.out:
        parser.error("OUT.json is missing")
    answers: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        root = Path(name).resolve()
        started("solve --quiet --out plan", root)
        for run in given.only:
            answers |= recorded(run, root)
            print(run, answers[f"{run}.0.exit"], flush=True)
            given.out.write_text(json.dumps(answers, sort_keys=True, indent=0) + "\n")
    return 0


def recorded(run: str, root: Path) -> dict[str, Any]:
    """Exit status, documents and new files of a run, in a folder of its own, by their places."""
    folder = root / run
    folder.mkdir()
    for name, text in INPUTS.items():
        (folder / name).write_text(text)
    (folder / "garbled.toml").write_bytes(b"\xff\xfe[risk\n")
    shutil.copytree(root / "plan", folder / "plan")
    nodes = json.loads((folder / "plan" / "solution.json").read_text())["nodes"]
    for at in (17000, 26000):
        (folder / f"state_{at}.txt").write_text(state_at(nodes, at))
    before = set(folder.rglob("*"))
    answer: dict[str, Any] = {}
    for number, command in enumerate(RUNS[run].split("; ")):
        ended = started(f"{command} --json", folder)
        answer |= flat({"exit": ended.returncode, "said": read(ended.stdout)}, f"{run}.{number}")
    for number, path in enumerate(sorted(set(folder.rglob("*")) - before)):
        if path.is_file():
            answer |= flat({path.suffix: held(path)}, f"{run}.file {number}")
    return {place: masked(value, folder) for place, value in answer.items()}


def started(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """A command of this tree, run to its end."""
    for short, long in SHORT.items():
        command = command.replace(short, long)
    words = [
        str(next(folder.rglob(word)).relative_to(folder)) if word.startswith("*.") else word
        for word in shlex.split(command)
    ]
    out = ["--out", "out"] if words[0] == "solve" and "--out" not in words else []
    return subprocess.run(
        [sys.executable, "-m", "scp_recon", *words, *out],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(TREE), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def read(said: str) -> Any:
    """The document on standard output, or what stands there instead."""
    try:
        return json.loads(said)
    except ValueError:
        return said


def state_at(nodes: dict[str, Any], at: float) -> str:
    """The planned state at a time, between two nodes on a line, pushed by metres and 0.3 mm/s."""
    states = np.array(nodes["state"])
    planned = [np.interp(at, nodes["t_s"], states[:, i]) for i in range(6)]
    return " ".join(f"{value:.10g}" for value in np.add(planned, [4.0] * 3 + [-3e-4] * 3))


def held(path: Path) -> Any:
    """What a file holds, of tables the columns."""
    if path.suffix == ".json":
        return json.loads(path.read_text())
    if path.suffix == ".parquet":
        return parquet.read_table(path).to_pydict()
    if path.suffix == ".csv":
        rows = csv.reader(line for line in path.read_text().splitlines() if line[:1] != "#")
        return [[number(cell) for cell in column] for column in zip(*rows, strict=False)]
    return None


def number(cell: str) -> float | str:
    """A cell's number, or its text."""
    try:
        return float(cell)
    except ValueError:
        return cell


def flat(value: Any, place: str) -> dict[str, Any]:
    """What nested tables and lists hold by its place, of long lists of numbers what sums them up."""
    if isinstance(value, dict):
        parts = {key: part for key, part in value.items() if key not in FORGOTTEN}
    elif isinstance(value, list):
        leaves = np.array([x for x in flattened(value) if isinstance(x, (int, float))], dtype=float)
        if len(leaves) > LONG:
            root = float(np.sqrt(np.mean(leaves**2)))
            value = [len(leaves), float(leaves.min()), float(leaves.max()), root]
        parts = dict(enumerate(value))
    else:
        return {place: value}
    return {k: v for key, part in parts.items() for k, v in flat(part, f"{place}.{key}").items()}


def flattened(value: list[Any]) -> Iterator[Any]:
    """What nested lists hold."""
    for part in value:
        yield from flattened(part) if isinstance(part, list) else [part]


def masked(value: Any, folder: Path) -> Any:
    """Text without paths, hashes and dates of today."""
    return TODAY.sub("", value.replace(str(folder), "")) if isinstance(value, str) else value


def compared(a: dict[str, Any], b: dict[str, Any]) -> int:
    """Print what differs between two records; 1 where anything does."""
    found = 0
    for place in sorted({*a, *b}):
        x, y = a.get(place, "absent"), b.get(place, "absent")
        numbers = isinstance(x, (int, float)) and isinstance(y, (int, float))
        small = 1e-8 if "m_s" in place or "merit" in place or "radius" in place else 1e-6
        if x != y and not (numbers and math.isclose(x, y, rel_tol=1e-6, abs_tol=small)):
            found += 1
            print(f"{place}: {x!r} | {y!r}")
    print(f"{found} differ")
    return int(found > 0)


if __name__ == "__main__":
    sys.exit(main())
