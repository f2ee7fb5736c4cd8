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
from collections.abc import Iterator, Mapping, Sequence
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
INPUTS = TREE / "tests" / "golden_runs"
"""What each run finds in its folder: scenarios, a study, a script; and the commands of all runs.

Boundary states, burn times and epoch of a `pass_*.toml` are those that a design of the packaged
scenario found.
"""
TEXT = (INPUTS / "commands.txt").read_text("utf-8")
SHORT = dict(re.findall(r"^([A-Z]+) = (.+)$", TEXT, re.MULTILINE))
RUNS = dict(re.findall(r"^([a-z]\w*): (.+)$", TEXT, re.MULTILINE))
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


def differences(names: Sequence[str]) -> list[str]:
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


def needs_plan(run: str) -> bool:
    """Whether a run works on the default plan."""
    return "plan" in RUNS[run].split()


def measured(names: Sequence[str], kernel: Mapping[str, str]) -> dict[str, Figures]:
    """Figures of runs, two at a time."""
    environment = {**os.environ, "PYTHONPATH": str(TREE), "OMP_NUM_THREADS": "1", **kernel}
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(WORKERS) as pool:
        root = Path(name).resolve()
        if any(map(needs_plan, names)):
            started("solve --quiet --out plan", root, environment)
        return dict(zip(names, pool.map(partial(recorded, root, environment), names), strict=True))


def recorded(root: Path, environment: Mapping[str, str], run: str) -> Figures:
    """Exit status, documents and new files of a run, in a folder of its own, by their places."""
    folder = root / run
    shutil.copytree(INPUTS, folder)
    (folder / "garbled.toml").write_bytes(b"\xff\xfe[risk\n")
    if needs_plan(run):
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
            answer |= flat(content_of(path), place)
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


def content_of(path: Path) -> Any:
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
