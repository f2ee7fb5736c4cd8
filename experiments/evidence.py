"""Read and write files of evidence, and name the commands that make them.

`docs/evidence/NAME.json` has tables of rows, the command that makes them, and the version of the
study; and, for information, versions of packages, machine, commit, date and wall time. Evidence is out
of date if a sentinel (`experiments.sentinels`) has moved, if the study's version was raised, or if it
is not there. Timings and counts carry a date, and are renewed before a release.
"""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any, NamedTuple, Self

from scp_recon.files import write_atomically
from scp_recon.results.read import File, read_file

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "evidence"
FILE = "evidence.json"
"""Its name in the folder of a study that has ended."""
SCHEMA = "scp_recon.evidence/2"
PACKAGES = (
    "numpy", "scipy", "cvxpy", "clarabel", "casadi", "ecos", "qoco", "scs", "bsk",
    "scocp", "spiceypy", "orekit-jpype", "polyhedral-gravity",
)  # fmt: skip
"""Packages whose versions are noted, as far as they are installed."""

Records = Sequence[Mapping[str, Any]]


class Source(NamedTuple):
    """The command that makes a file of evidence.

    Attributes:
        command: after `python -m`, without `--out`.
        dated: whether the rows are timings or counts, which are never out of date.
        figures: commands after `python -m paper_figs` that then draw pictures of the pages; `{out}` is
            the study's folder.
    """

    command: str
    dated: bool = False
    figures: tuple[str, ...] = ()


DRAWN = "frontier feedback policies missed_burns knowledge"
BODIES = "ryugu itokawa didymos apophis"
COUNTED = "reliability coverage mutation"
SOURCES: Mapping[str, Source] = {
    **{name: Source(f"experiments {name}") for name in (
        "plans", "peers", "cross_check", "sensitivity", "optima", "model_fidelity", "battery_cones",
        "flown_plan", "flown_policies", "uncertainty_sources",
    )},
    **{name: Source(f"experiments {name}", figures=(f"{name} --runs {{out}} --out docs/{name}.png",))
       for name in DRAWN.split()},
    "map_sample": Source("experiments maps --sample",
        figures=("map_sample --runs {out} --out docs/map_sample.png",)),
    "designs": Source("experiments plans --designs"),
    "gallery": Source("experiments gallery", figures=tuple(
        f"flyby --runs {{out}}/{one} --out docs/gallery/{one}.png" for one in BODIES.split())),
    "compare_solvers": Source("experiments compare_solvers",
        figures=("solver_comparison --runs {out} --out docs",)),
    "maps": Source("experiments maps", figures=("maps --runs {out} --out docs",)),
    "observation_table": Source("experiments observation_table", figures=(
        "flyby --runs {out}/scp_cold --out docs/flyby.png",
        "ball_polytopes --runs {out} --out docs/ball_polytopes.png",
    )),
    **{name: Source(f"experiments testing {name}", dated=True) for name in COUNTED.split()},
    "benchmarks": Source("benchmarks", dated=True),
    "waits": Source("benchmarks waits", dated=True),
}  # fmt: skip
"""By name of the evidence."""


MODULES = {
    "plans": "plans gallery",
    "costs": "frontier feedback policies",
    "flown": "flown_plan flown_policies",
    "left_out": "model_fidelity battery_cones uncertainty_sources",
    "other_tools": "cross_check peers",
    "solvers.optima": "optima sensitivity",
    "solvers.compare_solvers": "compare_solvers",
} | {name: name for name in ("knowledge", "maps", "missed_burns", "observation_table", "testing")}
STUDIES = {study: name for name, studies in MODULES.items() for study in studies.split()}
"""The module of each study, by the study's name."""


class Evidence(File):
    """A file of evidence.

    Attributes:
        command: the command that made it, after `python -m`.
        version: of the study.
        commit: commit of the sources; with a plus if some had changes.
        date: on which it was made (UTC).
        machine: processor and number of cores.
        versions: of packages.
        seconds: wall time of the study, without what a stopped run of it had finished.
        tables: rows of each table by its name.
    """

    command: str
    version: int
    commit: str
    date: str
    machine: str
    versions: dict[str, str]
    seconds: float
    tables: dict[str, list[dict[str, Any]]]

    @classmethod
    def begun(cls, command: str, version: int) -> Self:
        """Evidence without tables, with commit, versions and machine when the study begins."""
        today, found = datetime.now(UTC).date().isoformat(), dict[str, str]()
        for name in PACKAGES:
            with suppress(PackageNotFoundError):
                found[name] = version_of(name)
        return cls(
            command=command, version=version, commit=_commit(), date=today, machine=machine(),
            versions=found, seconds=0.0, tables={},
        )  # fmt: skip

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file of evidence.

        Raises:
            InputError: if there is none, or it is none.
        """
        return read_file(path, cls, SCHEMA, "evidence")

    def write(self, path: Path) -> Path:
        """Write a line for each row."""
        head = json.dumps({"schema": SCHEMA, **self.model_dump(exclude={"tables"})}, indent=1)
        rows = (
            f"  {json.dumps(name)}: [\n   "
            + ",\n   ".join(json.dumps(row, ensure_ascii=False) for row in found)
            + "\n  ]"
            for name, found in self.tables.items()
        )
        text = head.removesuffix("\n}") + ',\n "tables": {\n' + ",\n".join(rows) + "\n }\n}\n"
        return write_atomically(path, text)


def path_of(name: str) -> Path:
    """The file of a name."""
    return FOLDER / f"{name}.json"


def machine() -> str:
    """Processor and number of cores."""
    cpu, info = platform.processor() or platform.machine(), Path("/proc/cpuinfo")
    if info.exists() and (named := re.search(r"model name\s*:\s*(.+)", info.read_text("utf-8"))):
        cpu = named[1]
    return f"{cpu}, {os.cpu_count()} cores; Python {platform.python_version()}"


@cache
def _commit() -> str:
    def git(*words: str) -> str:
        command = ("git", "-C", str(ROOT), *words)
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "--short", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
