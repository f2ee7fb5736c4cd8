"""The golden record: what the commands answer, committed, so that a change that moves a result shows.

    python -m tests.golden [NAME ...]    compare; 1 where a figure has moved
    python -m tests.golden --renew       measure anew, and show what moved by how much

Every run starts `python -m scp_recon`, or a script that uses the library, in a folder of its own, and
keeps exit status, statuses, names and figures of its JSON document and files, by their places.
Sentences are not kept, so that an edit of a message moves nothing; nor are iterations, which rounding
decides. Of lists with more than `SAMPLES` entries the number and evenly spaced entries are kept.

A figure may differ by three times what it differs by between OpenBLAS's kernels (`KERNELS`), measured
by `--renew` for each run and kind of place, and by `ROUNDING` of itself; one that may differ by half
of itself is not kept. Texts and truths are exact.
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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from pyarrow import parquet

TREE = Path(__file__).resolve().parents[1]
FILE = TREE / "tests" / "golden.json"
SAMPLES = 10
ROUNDING = 1e-6
KERNELS: tuple[Mapping[str, str], ...] = (
    {},
    {"OPENBLAS_CORETYPE": "Haswell"},
    {"OPENBLAS_CORETYPE": "SkylakeX"},
)
"""Environments that `--renew` measures: the processor's own kernel first, whose figures are kept."""
WORKERS = 2
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
ptr: solve --algorithm ptr
scvx_star: solve --algorithm scvx-star
qoco: solve --solver QOCO
ecos: solve --solver ECOS
ipopt: solve --method ipopt
exact_node: solve EXACT --certify no --set risk.p_chance=0.9
exact_flight: solve EXACT --certify no --set risk.p_chance=0.9 --set 'risk.scope="flight"'
exact_certified: solve EXACT --set 'risk.scope="flight"'
probability: solve EXACT --certify no --objective probability --dv-budget 0.115
feedback: solve EXACT --certify no --set risk.p_chance=0.99 --set 'risk.scope="flight"' GAINS
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
eros: new eros --body Eros --site=20,80 --epoch 2030-01-01T00:00:00
nightingale: solve --scenario pass_nightingale.toml --certify no
apophis: solve --scenario pass_apophis.toml --certify no
didymos: solve --scenario pass_didymos.toml --certify no
itokawa: solve --scenario pass_itokawa.toml --certify no
ryugu: solve --scenario pass_ryugu.toml --certify no
impulsive: python impulsive.py
"""
SHORT = {
    "EXACT": "--set 'risk.allocation=\"exact\"'",
    "EPOCH": "--epoch 2020-01-21T20:33:17.184",
    "GAINS": "--set 'policy.kind=\"feedback\"' --set navigation.lead_s=0 "
    "--set navigation.sigma_position_m=10 --set navigation.sigma_velocity_m_s=0.0005",
}
RUNS = dict(line.split(": ", 1) for line in COMMANDS.strip().splitlines())
PASSES = {
    "nightingale": """epoch.tdb = "2020-01-21T23:21:07.246761"
burns.times_s = [0.0, 8723.6, 32515.4, 41929.9]
observation.window_s = [18528.052, 21925.279]
[boundary]
initial_position_m = [2.0392325, -999.85972, -16.625008]
initial_velocity_m_s = [1.9091192e-06, -0.0011626144, 0.069922085]
final_position_m = [-2.0289368, 995.18269, -98.016825]
final_velocity_m_s = [1.4438839e-05, -0.0068544729, -0.069595012]
""",
    "apophis": """epoch.tdb = "2028-10-04T01:00:00"
burns.times_s = [0.0, 7769.9, 39417.4, 46018.4]
[boundary]
initial_position_m = [18.418346, -698.27215, -45.571605]
initial_velocity_m_s = [-0.0001045059, 0.004077012, -0.062512364]
final_position_m = [-6.5342694, 246.55507, 655.10908]
final_velocity_m_s = [0.0015446398, -0.058607475, 0.022072756]
""",
    "didymos": """epoch.tdb = "2027-03-01T01:05:16.284751"
burns.times_s = [0.0, 17467.0, 37173.9, 56083.7]
observation.window_s = [22268.0, 22945.845]
[boundary]
initial_position_m = [-1.3448724, 1815.4483, -839.1338]
initial_velocity_m_s = [-2.399042e-05, 0.055183871, 0.11938918]
final_position_m = [-1.369644, 1876.4849, -691.95564]
final_velocity_m_s = [-1.6873978e-05, 0.04550501, 0.12340312]
""",
    "itokawa": """epoch.tdb = "2005-10-15T15:51:48.755620"
burns.times_s = [0.0, 6601.0, 56891.2]
[boundary]
initial_position_m = [6.7896396, -984.73983, -173.90048]
initial_velocity_m_s = [5.1347702e-05, -0.0084168448, 0.047663761]
final_position_m = [-6.8705478, 999.15655, 40.484267]
final_velocity_m_s = [-6.8853455e-06, 0.0019594877, -0.048361559]
""",
    "ryugu": """epoch.tdb = "2018-10-03T09:14:47.417473"
burns.times_s = [0.0, 6601.0, 39912.6]
[boundary]
initial_position_m = [4.726764, -1762.8281, -363.8882]
initial_velocity_m_s = [0.00011084285, -0.026011412, 0.1260117]
final_position_m = [-4.9122924, 1798.1691, 81.016171]
final_velocity_m_s = [-5.6109669e-05, 0.0057911017, -0.12853799]
""",
}
"""Boundary states, burn times and epoch of passes that designs of packaged scenarios found."""
INPUTS = {
    **{f"pass_{name}.toml": f'base = "{name}"\n{found}' for name, found in PASSES.items()},
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
    "impulsive.py": """import json
import numpy as np
import scp_recon as sr

def acceleration(r, v, t, p):
    return [3.0 * p[0] ** 2 * r[0] + 2.0 * p[0] * v[1], -2.0 * p[0] * v[0], -(p[0] ** 2) * r[2]]

times = np.linspace(0.0, 5556.0, 37)
flow = sr.ExpressionFlow(acceleration, times, parameters=[2.0 * np.pi / 5556.0], substeps=4)
ball, axis = sr.Ball([0.0, 0.0, 0.0], 150.0), [0.0, 1.0, 0.0]
cone = sr.Cone(apex=[0.0, 0.0, 0.0], axis=axis, half_angle=np.pi / 6.0)
plan = sr.ImpulsiveProblem(
    flow,
    [0, 12, 24, 36],
    [-300.0, -1000.0, 200.0, 0.0, 0.4, 0.0],
    [0.0, 200.0, 0.0, 0.0, 0.0, 0.0],
    dv_max=2.0,
    initial_covariance=np.diag([2.0, 2.0, 2.0, 0.001, 0.001, 0.001]) ** 2,
    errors=sr.GatesErrors(0.0, 0.005, 0.0, 0.005),
    regions=[
        sr.Keep("out", ball, range(1, 25), "ball"), sr.Keep("in", cone, range(30, 37), "cone")
    ],
    probability=0.95,
    scope="flight",
).solve()
whole = plan.fly(500).whole.value
answer = {"ok": plan.ok, "cost": plan.cost, "burns": plan.burns.tolist(), "whole": whole}
print(json.dumps(answer))
""",
}
FORGOTTEN = {
    *("timing_s", "solver_s", "seconds", "cpu_s", "tries", "versions", "plan_hash", "hash"),
    *("files", "inputs_sha256", "folder", "file", "init", "parent"),
    *("iterations", "trust_radius", "merit", "residual", "violation", "max_defect"),
    *("covariance_error", "knowledge_error", "sample_error_m"),
    *("terminal_position_error_m", "terminal_velocity_error_m_s"),
}
"""Keys of seconds, paths and hashes, and of what rounding alone decides."""
TODAY = re.compile(r"\d{8}T\d{6}Z|20(2[5-9]|[3-9]\d)-\d\d-\d\d[T ][\d:.]+|[0-9a-f]{64}")
WORD = re.compile(r"[\w./+:-]{1,40}")
"""What is kept of texts: names and statuses, not sentences."""

Figures = dict[str, Any]
"""A run's figures by their places."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare runs with the record, or renew it; 1 where a figure has moved."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="of a run (default: all)")
    parser.add_argument("--renew", action="store_true", help="measure, write and show what moved")
    given = parser.parse_args(arguments)
    if unknown := set(given.names) - set(RUNS):
        parser.error(f"{', '.join(sorted(unknown))}: must be of {', '.join(RUNS)}")
    names = given.names or list(RUNS)
    if given.renew:
        renew(names)
        return 0
    found = differences(names)
    print("\n".join([*found, f"{len(names)} runs: {len(found)} figures have moved"]))
    return int(bool(found))


def differences(names: Iterable[str]) -> list[str]:
    """Run commands anew: a line for each figure that is not the record's within its tolerance."""
    record = json.loads(FILE.read_text("utf-8"))
    fresh = measured(names, KERNELS[0])
    return [line for name in names for line in moved(record.get(name, EMPTY), fresh[name], name)]


EMPTY: dict[str, Figures] = {"figures": {"run": "recorded"}, "within": {}}
"""Of a run that the record lacks: it counts as moved."""


def moved(kept: Mapping[str, Figures], fresh: Figures, name: str) -> Iterator[str]:
    """Lines for the kept figures of a run that fresh ones lack, or that differ by too much."""
    for place, was in kept["figures"].items():
        now, within = fresh.get(place), kept["within"].get(kind_of(place), 0.0)
        if not same(was, now, within):
            yield f"{name}: {place}: was {was!r}, is {now!r}, within {within:.2g}"


def same(was: Any, now: Any, within: float) -> bool:
    """Whether two values agree: numbers within a tolerance, everything else exactly."""
    if isinstance(was, list) and isinstance(now, list) and len(was) == len(now):
        return all(same(a, b, within) for a, b in zip(was, now, strict=True))
    if is_number(was) and is_number(now):
        both_undefined = math.isnan(was) and math.isnan(now)
        return both_undefined or math.isclose(was, now, rel_tol=ROUNDING, abs_tol=max(within, 1e-9))
    return type(was) is type(now) and bool(was == now)


def spread(one: Any, other: Any) -> float:
    """The largest difference of numbers that stand at the same place of two values."""
    if isinstance(one, list) and isinstance(other, list):
        return max(map(spread, one, other), default=0.0)
    return abs(one - other) if is_number(one) and is_number(other) else 0.0


def is_number(value: Any) -> bool:
    """Whether a value is a number, and no truth."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def kind_of(place: str) -> str:
    """A place without the numbers in it, by which tolerances go: `burns.0.dv_m_s` is `burns.dv_m_s`.

    A number at the end is a column's, which may have another unit than its neighbour.
    """
    *parts, last = place.split(".")
    return ".".join([*(part for part in parts if not part.isdigit()), last])


def largest(value: Any) -> float:
    """The largest magnitude of the numbers of a value."""
    if isinstance(value, list):
        return max(map(largest, value), default=0.0)
    return abs(value) if is_number(value) else 0.0


def renew(names: Sequence[str]) -> None:
    """Measure runs with every kernel, write figures and tolerances, and print what has moved."""
    record = json.loads(FILE.read_text("utf-8")) if FILE.exists() else {}
    first, *others = (measured(names, kernel) for kernel in KERNELS)
    for name in names:
        for line in moved(record.get(name, EMPTY), first[name], name):
            print(line)
        within: dict[str, float] = {}
        for place, value in first[name].items():
            off = max((spread(value, other[name].get(place)) for other in others), default=0.0)
            kind = kind_of(place)
            within[kind] = max(within.get(kind, 0.0), float(f"{3.0 * off:.2g}"))
        record[name] = {
            "figures": {
                place: value
                for place, value in first[name].items()
                if not 0.0 < 0.5 * largest(value) < within[kind_of(place)]
            },
            "within": {kind: value for kind, value in within.items() if value > 0.0},
        }
    FILE.write_text(text_of({name: record[name] for name in RUNS if name in record}), "utf-8")


def text_of(record: Mapping[str, Mapping[str, Figures]]) -> str:
    """The record with a line for each figure."""
    runs = []
    for name, kept in record.items():
        lines = (f"  {json.dumps(key)}: {json.dumps(v)}" for key, v in kept["figures"].items())
        within = json.dumps(kept["within"], sort_keys=True)
        figures = ",\n".join(lines)
        runs.append(f' {json.dumps(name)}: {{"within": {within}, "figures": {{\n{figures}\n }}}}')
    return "{\n" + ",\n".join(runs) + "\n}\n"


def run_of(day: date) -> str:
    """The run that a day's tests compare: one of those that take seconds, by a seed."""
    return Random(day.toordinal()).choice([name for name in RUNS if name not in LONG])


LONG = ("simulate", "infeasible_frame", "infeasible_risk", "campaign", "eros", "probability")


def measured(names: Iterable[str], kernel: Mapping[str, str]) -> dict[str, Figures]:
    """Figures of runs, two at a time."""
    environment = {**os.environ, "PYTHONPATH": str(TREE), "OMP_NUM_THREADS": "1", **kernel}
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(WORKERS) as pool:
        root = Path(name).resolve()
        started("solve --quiet --out plan", root, environment)
        return dict(zip(names, pool.map(partial(recorded, root, environment), names), strict=True))


def recorded(root: Path, environment: Mapping[str, str], run: str) -> Figures:
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
    answer: Figures = {}
    for number, command in enumerate(RUNS[run].split("; ")):
        ended = started(command, folder, environment)
        answer |= flat({"exit": ended.returncode, "said": read(ended.stdout)}, str(number))
    for path in sorted(set(folder.rglob("*")) - before):
        place = TODAY.sub("", str(path.relative_to(folder)).replace(".", "_"))
        if path.is_file():
            answer |= flat(held(path), place)
    return answer


def started(
    command: str, folder: Path, environment: Mapping[str, str]
) -> subprocess.CompletedProcess[str]:
    """A command of this tree, run to its end."""
    for short, long in SHORT.items():
        command = command.replace(short, long)
    words = [
        str(next(folder.rglob(word)).relative_to(folder)) if word.startswith("*.") else word
        for word in shlex.split(command)
    ]
    if words[0] == "python":
        words = words[1:]
    else:
        out = ["--out", "out"] if words[0] == "solve" and "--out" not in words else []
        words = ["-m", "scp_recon", *words, *out, "--json"]
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env=environment,
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
    """What a file holds: of tables the columns, of a plan what its command does not say."""
    if path.name == "solution.json":
        parts = ("scenario", "units", "facets", "nodes")
        return {key: part for key, part in json.loads(path.read_text()).items() if key in parts}
    if path.suffix == ".json":
        return json.loads(path.read_text())
    if path.suffix == ".parquet":
        return parquet.read_table(path).to_pydict()
    if path.suffix == ".csv":
        rows = csv.reader(line for line in path.read_text().splitlines() if line[:1] != "#")
        return {
            str(i): list(map(cell_of, column)) for i, column in enumerate(zip(*rows, strict=False))
        }
    return None


def cell_of(cell: str) -> float | str:
    """A cell's number, or its text."""
    try:
        return float(cell)
    except ValueError:
        return cell


def flat(value: Any, place: str) -> Figures:
    """What nested tables and lists hold by its place; of long lists `SAMPLES` entries."""
    if isinstance(value, dict):
        parts = {key: part for key, part in value.items() if key not in FORGOTTEN}
    elif is_numeric(value):
        number = {f"{place}.number": len(value)} if len(value) > SAMPLES else {}
        return {place: rounded(value), **number}
    elif isinstance(value, list):
        parts = {**dict(enumerate(some(value))), "number": len(value)}
    elif isinstance(value, str):
        text = TODAY.sub("", value)
        return {place: text} if WORD.fullmatch(text) else {}
    else:
        return {} if value is None else {place: rounded(value)}
    return {k: v for key, part in parts.items() for k, v in flat(part, f"{place}.{key}").items()}


def is_numeric(value: Any) -> bool:
    """Whether a value is a list of numbers, or of such lists."""
    return (
        isinstance(value, list)
        and bool(value)
        and all(is_number(x) or is_numeric(x) for x in value)
    )


def rounded(value: Any) -> Any:
    """Numbers with eight digits; of long lists `SAMPLES` entries."""
    if isinstance(value, list):
        return [rounded(x) for x in some(value)]
    return float(f"{value:.8g}") if isinstance(value, float) and math.isfinite(value) else value


def some(values: Sequence[Any]) -> list[Any]:
    """Evenly spaced entries of a long list, or all."""
    number = len(values)
    chosen = range(number) if number <= SAMPLES else range(0, number, -(-number // SAMPLES))
    return [values[i] for i in chosen]


if __name__ == "__main__":
    sys.exit(main())
