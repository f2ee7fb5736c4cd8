"""Read and write files of evidence, and say which are out of date.

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
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any, NamedTuple, Self

from scp_recon.errors import InputError, shortened
from scp_recon.files import write_atomically

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "evidence"
FILE = "evidence.json"
"""Its name in the folder of a study that has ended."""
SCHEMA = "scp_recon.evidence/2"
PACKAGES = (
    "numpy", "scipy", "cvxpy", "clarabel", "casadi", "ecos", "qoco", "scs", "bsk", "openscvx",
    "scocp", "spiceypy", "brahe", "orekit-jpype", "polyhedral-gravity",
)  # fmt: skip
"""Packages whose versions are noted, as far as they are installed."""

Records = Sequence[Mapping[str, Any]]


class Source(NamedTuple):
    """The command that makes a file of evidence.

    Attributes:
        command: after `python -m`, without `--out`.
        dated: whether the rows are timings or counts, which are never out of date.
        figures: commands after `python -m` that then draw pictures of the pages; `{out}` is the
            study's folder.
    """

    command: str
    dated: bool = False
    figures: tuple[str, ...] = ()


def _drawn(*commands: str) -> tuple[str, ...]:
    return tuple(f"paper_figs {command}" for command in commands)


SOURCES: Mapping[str, Source] = {
    **{
        name: Source(f"experiments {name}")
        for name in (
            "plans", "sites", "nlp_tricks", "peers", "spice", "cross_check",
            "lifted", "sensitivity", "model_fidelity", "battery_cones", "timing_rules", "flown_plan",
        )
    },
    "designs": Source("experiments plans --designs"),
    "gallery": Source(
        "experiments gallery",
        figures=_drawn(
            *(
                f"flyby --runs {{out}}/{body} --out docs/gallery/{body}.png"
                for body in ("ryugu", "itokawa", "didymos", "apophis")
            )
        ),
    ),
    **{
        name: Source(
            f"experiments {name}", figures=_drawn(f"{name} --runs {{out}} --out docs/{name}.png")
        )
        for name in ("frontier", "feedback", "policies")
    },
    "compare_solvers": Source(
        "experiments compare_solvers --full",
        figures=_drawn("solver_comparison --runs {out} --out docs"),
    ),
    "accuracy": Source(
        "experiments accuracy",
        figures=_drawn("accuracy --runs {out} --out docs/comparison_accuracy.png"),
    ),
    "observation_table": Source(
        "experiments observation_table",
        figures=_drawn(
            "flyby --runs {out}/scp_cold --out docs/flyby.png",
            "ball_polytopes --runs {out} --out docs/ball_polytopes.png",
        ),
    ),
    "uncertainty_sources": Source("experiments uncertainty_sources --flights 4"),
    **{
        f"flown_{name}": Source(f"experiments flown_policies {name}")
        for name in ("default", "kingfisher")
    },
    "maps": Source("experiments maps --pictures docs"),
    "map_sample": Source(
        "experiments maps --sample",
        figures=_drawn("map_sample --runs {out} --out docs/map_sample.png"),
    ),
    "benchmarks": Source("benchmarks", dated=True),
    "growth": Source("benchmarks growth", dated=True),
    "waits": Source("benchmarks waits", dated=True),
    "campaign_scale": Source("benchmarks campaign_scale", dated=True),
    **{
        name: Source(f"experiments testing {name}", dated=True)
        for name in ("reliability", "coverage", "mutation")
    },
}  # fmt: skip
"""By name of the evidence."""


@dataclass(frozen=True)
class Evidence:
    """A file of evidence.

    Attributes:
        command: the command that made it, after `python -m`.
        version: of the study.
        tables: rows of each table by its name.
        commit: commit of the sources; with a plus if some had changes.
        date: on which it was made (UTC).
        machine: processor and number of cores.
        versions: of packages.
        seconds: wall time of the study.
        resumed: whether it continued finished work, whose time the seconds leave out.
    """

    command: str
    version: int
    tables: Mapping[str, Records] = field(default_factory=dict)
    commit: str = ""
    date: str = ""
    machine: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    resumed: bool = False

    @classmethod
    def begun(cls, command: str, version: int) -> Self:
        """Evidence without tables, with commit, versions and machine when the study begins."""
        today, found = datetime.now(UTC).date().isoformat(), dict[str, str]()
        for name in PACKAGES:
            with suppress(PackageNotFoundError):
                found[name] = version_of(name)
        return cls(command, version, {}, _commit(), today, machine(), found)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file of evidence.

        Raises:
            FileNotFoundError: if there is none.
            InputError: if it is none.
        """
        name = path.name
        try:
            values = json.loads(path.read_text("utf-8"))
        except FileNotFoundError:
            raise
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(name, f"no JSON ({error})", "must be a file of evidence") from None
        if not isinstance(values, dict) or values.pop("schema", None) != SCHEMA:
            raise InputError(f"{name}: schema", "another", f"must be {SCHEMA}")
        kinds = {one.name: one.type for one in fields(cls)}
        for entry in {**kinds, **values}:
            if entry not in kinds or entry not in values:
                given = "an unknown entry" if entry in values else "nothing"
                raise InputError(f"{name}: {entry}", given, f"must have {', '.join(kinds)}")
        texts = ("command", "commit", "date", "machine")
        of_kind = {
            **{entry: isinstance(values[entry], str) for entry in texts},
            "version": type(values["version"]) is int,
            "seconds": type(values["seconds"]) in (int, float),
            "resumed": isinstance(values["resumed"], bool),
        }
        for entry in (entry for entry, right in of_kind.items() if not right):
            raise InputError(f"{name}: {entry}", shortened(values[entry]), "must be of its kind")
        tables = values["tables"]
        if not isinstance(tables, dict):
            raise InputError(f"{name}: tables", shortened(tables), "must be tables by name")
        for table, rows in tables.items():
            if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
                raise InputError(
                    f"{name}: tables.{table}", shortened(rows), "must be a list of rows"
                )
        return cls(**values)

    def write(self, path: Path) -> Path:
        """Write a line for each row."""
        values = asdict(self)
        tables = values.pop("tables")
        head = json.dumps({"schema": SCHEMA, **values}, indent=1)
        rows = (
            f"  {json.dumps(name)}: [\n   "
            + ",\n   ".join(json.dumps(row, ensure_ascii=False) for row in found)
            + "\n  ]"
            for name, found in tables.items()
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
