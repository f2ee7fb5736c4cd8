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


BODIES = ("ryugu", "itokawa", "didymos", "apophis")
DRAWN = {
    **{name: (f"{name} --runs {{out}} --out docs/{name}.png",)
       for name in ("frontier", "feedback", "policies", "map_sample", "missed_burns",
                    "knowledge")},
    "gallery": tuple(f"flyby --runs {{out}}/{one} --out docs/gallery/{one}.png" for one in BODIES),
    "compare_solvers": ("solver_comparison --runs {out} --out docs",),
    "maps": ("maps --runs {out} --out docs",),
    "observation_table": ("flyby --runs {out}/scp_cold --out docs/flyby.png",
                          "ball_polytopes --runs {out} --out docs/ball_polytopes.png"),
}  # fmt: skip
COMMANDS = {
    **{name: name for name in (
        "plans", "sites", "peers", "cross_check", "sensitivity",
        "model_fidelity", "battery_cones", "flown_plan", "gallery", "frontier",
        "feedback", "policies", "observation_table", "optima", "maps",
        "missed_burns", "knowledge", "flown_policies",
        "compare_solvers", "uncertainty_sources",
    )},
    "designs": "plans --designs",
    "map_sample": "maps --sample",
}  # fmt: skip
DATED = {
    "benchmarks": "benchmarks",
    "waits": "benchmarks waits",
    **{name: f"experiments testing {name}" for name in ("reliability", "coverage", "mutation")},
}
SOURCES: Mapping[str, Source] = {
    name: Source(f"experiments {command}", figures=DRAWN.get(name, ()))
    for name, command in COMMANDS.items()
} | {name: Source(command, dated=True) for name, command in DATED.items()}
"""By name of the evidence."""


class Evidence(File):
    """A file of evidence.

    Attributes:
        command: the command that made it, after `python -m`.
        version: of the study.
        commit: commit of the sources; with a plus if some had changes.
        date: on which it was made (UTC).
        machine: processor and number of cores.
        versions: of packages.
        seconds: wall time of the study.
        resumed: whether it continued finished work, whose time the seconds leave out.
        tables: rows of each table by its name.
    """

    command: str
    version: int
    commit: str
    date: str
    machine: str
    versions: dict[str, str]
    seconds: float
    resumed: bool
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
            versions=found, seconds=0.0, resumed=False, tables={},
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
