"""A record of what the commands answer, to show that a refactoring has changed nothing.

    python -m tests.record OUT.json [--only NAME ...]
    python -m tests.record --compare A.json B.json [--text-may-differ]

Each run starts `python -m scp_recon` in a folder of its own and keeps exit status, JSON document, text
and what the files hold. It knows the command line alone, no module by its name. Hashes, paths, dates of
today and seconds taken are masked; long lists are kept as number, least, largest and root mean square.
"""

from __future__ import annotations

import argparse
import difflib
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pyarrow import parquet

TREE = Path(__file__).resolve().parents[1]
TOLERANCE, DIGITS, LONG = 1e-6, 9, 12
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
# Seconds, and what is rounding alone.
FORGOTTEN = {
    *("timing_s", "solver_s", "seconds", "cpu_s", "tries", "versions", "plan_hash", "hash"),
    *("inputs_sha256", "predicted", "actual", "max_defect"),
}
MASKS = (
    (r"(?m)^.*━.*\n", ""),
    (r"(?m)^((\d+ )?P\d[\w.]* +\d+ .*) +[\d.]+ *$", r"\1"),
    (r"; [\d.]+ s, of which [\d.]+ s in", "; SECONDS in"),
    (r"\b\d{8}T\d{6}Z\b", "UTC"),
    (r"\b20(2[5-9]|[3-9]\d)-\d\d-\d\d[T ][\d:.]+", "TODAY"),
    (r"(?<![\w.:])-?\d+\.\d{10,}(e[-+]\d+)?\b", "FIGURE"),
    (r"\b[0-9a-f]{64}\b|(?<=recon_b_)[0-9a-f]{8}(?=_)", "HASH"),
    (r"[-+]?\b\d(\.\d+)?e-(0[6-9]|[1-9]\d+)\b|\b0\.0e\+00|[-+]0\.0+(?= |$)", "TINY"),
)


def main() -> int:
    """Record the runs, or compare two records; 1 where they differ."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", nargs="?", type=Path, metavar="OUT.json")
    parser.add_argument("--only", nargs="+", choices=RUNS, default=list(RUNS), metavar="NAME")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("A.json", "B.json"))
    parser.add_argument("--text-may-differ", action="store_true")
    given = parser.parse_args()
    if given.compare:
        a, b = (json.loads(path.read_text()) for path in given.compare)
        return compared(a, b, given.text_may_differ)
    if not given.out:
        parser.error("OUT.json is missing")
    answers = {}
    with tempfile.TemporaryDirectory() as name:
        root = Path(name).resolve()
        if any("plan" in RUNS[run] for run in given.only):
            started("solve --quiet --out plan", root, ())
        for run in given.only:
            answers[run] = recorded(run, root)
            print(run, answers[run]["exit"], flush=True)
            given.out.write_text(json.dumps(answers, sort_keys=True) + "\n")
    return 0


def recorded(run: str, root: Path) -> dict[str, Any]:
    """Exit status, documents, text and new files of a run, in a folder of its own."""
    folder = root / run
    folder.mkdir()
    for name, text in INPUTS.items():
        (folder / name).write_text(text)
    (folder / "garbled.toml").write_bytes(b"\xff\xfe[risk\n")
    if "plan" in RUNS[run]:
        shutil.copytree(root / "plan", folder / "plan")
        nodes = json.loads((folder / "plan" / "solution.json").read_text())["nodes"]
        for at in (17000, 26000):
            (folder / f"state_{at}.txt").write_text(state_at(nodes, at))
    before = set(folder.rglob("*"))
    form = () if run == "default" else ("--json",)
    ended = [started(command, folder, form) for command in RUNS[run].split("; ")]
    text = "".join(one.stderr if form else one.stdout for one in ended)
    answer = {
        "exit": [one.returncode for one in ended],
        "documents": [read(one.stdout) for one in ended if form],
        "text": masked(text, folder).splitlines(),
        "files": {
            str(path.relative_to(folder)): held(path)
            for path in sorted(set(folder.rglob("*")) - before)
            if path.is_file()
        },
    }
    return dict(masked(shortened(answer), folder))


def started(command: str, folder: Path, form: tuple[str, ...]) -> subprocess.CompletedProcess[str]:
    """A command of this tree, run to its end."""
    for short, long in SHORT.items():
        command = command.replace(short, long)
    words = [
        str(next(folder.rglob(word)).relative_to(folder)) if word.startswith("*.") else word
        for word in shlex.split(command)
    ]
    out = ["--out", "out"] if words[0] == "solve" and "--out" not in words else []
    return subprocess.run(
        [sys.executable, "-m", "scp_recon", *words, *out, *form],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(TREE), "OMP_NUM_THREADS": "1", "COLUMNS": "200"},
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
    """The planned state at a time, a cubic between two nodes, pushed by metres and 0.3 mm/s."""
    times, states = np.array(nodes["t_s"]), np.array(nodes["state"])
    k = int(np.searchsorted(times, at)) - 1
    (r, v), (q, w), h = np.split(states[k], 2), np.split(states[k + 1], 2), times[k + 1] - times[k]
    s = (at - times[k]) / h
    position = (1 - s) ** 2 * ((1 + 2 * s) * r + s * h * v) + s**2 * (
        (3 - 2 * s) * q - (1 - s) * h * w
    )
    speed = 6 * s * (1 - s) * (q - r) / h + (1 - s) * (1 - 3 * s) * v + s * (3 * s - 2) * w
    pushed = [*np.round(position + 4.0, 4), *np.round(speed - 3e-4, 8)]
    return " ".join(f"{value:.10g}" for value in pushed)


def held(path: Path) -> Any:
    """What a file holds: its data; of text the figures, and the lines where they are few."""
    if path.suffix == ".json":
        return json.loads(path.read_text())
    if path.suffix == ".parquet":
        return parquet.read_table(path).to_pydict()
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name].tolist() for name in arrays.files if name != "summary"}
    if path.suffix not in {".csv", ".oem", ".opm", ".toml"}:
        return path.suffix
    text = path.read_text()
    figures = [
        float(word) for word in re.findall(r"(?<![\w.])-?\d+\.?\d*(?:e[-+]?\d+)?(?![\w.])", text)
    ]
    few = text.count("\n") < 100
    return {"lines": text.count("\n"), "figures": figures, "text": text if few else text[:300]}


def shortened(value: Any) -> Any:
    """Rounded numbers, without what differs from run to run; long lists summed up."""
    if isinstance(value, dict):
        kept = {key: part for key, part in value.items() if key not in FORGOTTEN}
        return {key: part if key == "text" else shortened(part) for key, part in kept.items()}
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else str(value)
    if not isinstance(value, list):
        return value
    parts = list(leaves(value))
    if len(parts) > LONG and all(isinstance(part, (int, float)) for part in parts):
        root = math.sqrt(math.fsum(part**2 for part in parts) / len(parts))
        return [shortened(float(figure)) for figure in (len(parts), min(parts), max(parts), root)]
    if len(parts) > LONG and all(isinstance(part, str) for part in parts):
        return dict(Counter(parts)) if len({*parts}) < LONG else [len(parts), parts[0], parts[-1]]
    return [shortened(part) for part in value]


def leaves(value: list[Any]) -> Iterator[Any]:
    """What nested lists hold, null left out."""
    for part in value:
        yield from leaves(part) if isinstance(part, list) else [part] * (part is not None)


def masked(value: Any, folder: Path) -> Any:
    """Text, and what holds it, without paths, hashes, seconds and dates."""
    if isinstance(value, dict):
        return {masked(key, folder): masked(part, folder) for key, part in value.items()}
    if isinstance(value, list):
        return [masked(part, folder) for part in value]
    if isinstance(value, str):
        value = value.replace(f"{folder}/", "").replace(str(TREE), "TREE")
        for pattern, by in MASKS:
            value = re.sub(pattern, by, value)
    return value


def compared(a: dict[str, Any], b: dict[str, Any], text_may_differ: bool) -> int:
    """Print what differs between two records; 1 where it matters."""
    figures, texts, largest, where = 0, 0, 0.0, "nowhere"
    for path, x, y, relative in differences(a, b, ""):
        if relative > largest:
            largest, where = relative, path
        if relative < 0 and path.endswith((".text", ".message")) and isinstance(x, (list, str)):
            texts += 1
            sides = [side if isinstance(side, list) else str(side).splitlines() for side in (x, y)]
            lines = list(difflib.unified_diff(sides[0], sides[1], n=0, lineterm=""))[2:]
            print(f"{path}:", *lines, sep="\n    ")
        elif relative < 0 or relative > TOLERANCE:
            figures += 1
            print(f"{path}: {x!r} | {y!r}" + (f" ({relative:.1e})" if relative > 0 else ""))
    print(f"{figures} figures, statuses or exit codes differ; {texts} texts differ")
    print(f"largest relative difference of numbers: {largest:.1e}, {where}")
    return int(bool(figures or (texts and not text_may_differ)))


def differences(x: Any, y: Any, path: str) -> Iterator[tuple[str, Any, Any, float]]:
    """Where records differ, by how much relative to the larger or to what matters; else -1."""
    if x == y:
        return
    name = path.rpartition(".")[2]
    if isinstance(x, dict) and isinstance(y, dict):
        for key in sorted({*x, *y}):
            yield from differences(x.get(key, "absent"), y.get(key, "absent"), f"{path}.{key}")
    elif isinstance(x, list) and isinstance(y, list) and len(x) == len(y) and name != "text":
        for place, (one, other) in enumerate(zip(x, y, strict=True)):
            yield from differences(one, other, f"{path}[{place}]")
    elif {type(x), type(y)} <= {int, float}:
        matters = 1e-2 if "m_s" in name or name in {"merit", "trust_radius"} else 1.0
        yield path, x, y, abs(x - y) / max(abs(x), abs(y), matters)
    else:
        yield path, x, y, -1.0


if __name__ == "__main__":
    sys.exit(main())
