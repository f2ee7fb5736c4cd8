"""Write and check files of evidence: a study's tables, their origin, and whether they are current.

`docs/evidence/NAME.json` has tables of rows, and beside them the command, the commit, the versions,
the machine, the date, the wall time, and the hash of what the rows depend on: the scenarios, the
study, and all modules that it imports below `scp_recon.api`. Evidence is out of date if the hash,
the versions or the command have changed.
"""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any, NamedTuple, Self

from scp_recon.files import write_atomically
from scp_recon.jobs.store import sources, versions

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "evidence"
FILE = "evidence.json"
"""Its name in the folder of a study that has ended."""
SCHEMA = "scp_recon.evidence/1"
UNKNOWN = "unknown"
"""Hash of evidence that was measured before there were hashes."""
DATA = ("scp_recon.data", "scp_recon.simulation.data")
ABOVE = (
    "scp_recon.api",
    "scp_recon.cli",
    "scp_recon.jobs",
    "experiments.harness",
    "experiments.evidence",
)
"""Modules that a study's figures do not depend on: the shell around it."""
AROUND = ("experiments.harness", "experiments.evidence")
"""Those of a study that quotes or times whole commands."""

Records = Sequence[Mapping[str, Any]]


class Source(NamedTuple):
    """The command and the sources that make a file of evidence.

    Attributes:
        command: after `python -m`, without `--out`.
        modules: whose sources, with those that they import, the rows depend on.
        without: modules and packages of them that the rows do not depend on.
        figures: commands after `python -m` that then draw pictures of the pages; `{out}` is the
            study's folder.
        tools: distributions that the rows depend on too, beside those of every plan; where one is
            not installed its version is not compared.
    """

    command: str
    modules: tuple[str, ...]
    without: tuple[str, ...] = ABOVE
    figures: tuple[str, ...] = ()
    tools: tuple[str, ...] = ()


_SOLVERS = "experiments.solvers.compare_solvers.cell"
_ALL = ("tests", "formulations", "scp_recon")
_MUTMUT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["mutmut"]
_OF_MUTANTS = tuple(
    path.removesuffix(".py").replace("/", ".")
    for path in _MUTMUT["pytest_add_cli_args_test_selection"]
)
"""Modules of the tests that mutants face."""
_NLP, _SPACECRAFT = ("casadi",), ("bsk",)

SOURCES: Mapping[str, Source] = {
    "plans": Source("experiments plans", ("experiments.plans", "scp_recon.cli"), AROUND),
    "designs": Source("experiments plans --designs", ("experiments.plans",)),
    "gallery": Source(
        "experiments gallery",
        ("experiments.gallery",),
        figures=tuple(
            f"paper_figs flyby --runs {{out}}/{body} --out docs/gallery/{body}.png"
            for body in ("ryugu", "itokawa", "didymos", "apophis")
        ),
    ),
    "frontier": Source(
        "experiments frontier",
        ("experiments.frontier",),
        figures=("paper_figs frontier --runs {out} --out docs/frontier.png",),
    ),
    "feedback": Source(
        "experiments feedback",
        ("experiments.in_flight.feedback",),
        figures=("paper_figs feedback --runs {out} --out docs/feedback.png",),
    ),
    "policies": Source(
        "experiments policies",
        ("experiments.in_flight.policies",),
        figures=("paper_figs policies --runs {out} --out docs/policies.png",),
    ),
    "sites": Source("experiments sites", ("experiments.in_flight.sites",)),
    "compare_solvers": Source(
        "experiments compare_solvers --full",
        (_SOLVERS,),
        figures=("paper_figs solver_comparison --runs {out} --out docs",),
        tools=(*_NLP, "ecos", "qoco", "scs"),
    ),
    "exact_methods": Source(
        "experiments exact_methods",
        ("experiments.solvers.exact_methods",),
        tools=("ecos", "qoco"),
    ),
    "nlp_tricks": Source("experiments nlp_tricks", ("experiments.solvers.nlp_tricks",), tools=_NLP),
    "peers": Source(
        "experiments peers",
        ("experiments.solvers.peers.study", "examples.halo_transfer"),
        tools=("openscvx", "scocp"),
    ),
    "spice": Source("experiments spice", ("experiments.spice",), tools=("spiceypy",)),
    "cross_check": Source(
        "experiments cross_check",
        ("experiments.cross_check",),
        tools=("brahe", "orekit-jpype", "polyhedral-gravity"),
    ),
    "accuracy": Source(
        "experiments accuracy",
        ("experiments.solvers.accuracy",),
        figures=("paper_figs accuracy --runs {out} --out docs/comparison_accuracy.png",),
        tools=_NLP,
    ),
    "lifted": Source("experiments lifted", ("experiments.solvers.lifted",)),
    "sensitivity": Source("experiments sensitivity", ("experiments.solvers.sensitivity",)),
    "observation_table": Source(
        "experiments observation_table",
        ("experiments.observation_table.study",),
        figures=(
            "paper_figs flyby --runs {out}/scp_cold --out docs/flyby.png",
            "paper_figs ball_polytopes --runs {out} --out docs/ball_polytopes.png",
        ),
        tools=_NLP,
    ),
    "model_fidelity": Source("experiments model_fidelity", ("experiments.model_fidelity.study",)),
    "battery_cones": Source("experiments battery_cones", ("experiments.spacecraft.battery_cones",)),
    "uncertainty_sources": Source(
        "experiments uncertainty_sources --flights 4",
        ("experiments.spacecraft.uncertainty_sources.study",),
        tools=_SPACECRAFT,
    ),
    "timing_rules": Source(
        "experiments timing_rules", ("experiments.spacecraft.timing_rules",), tools=_SPACECRAFT
    ),
    "flown_plan": Source(
        "experiments flown_plan", ("experiments.spacecraft.flown_plan",), tools=_SPACECRAFT
    ),
    **{
        f"flown_{name}": Source(
            f"experiments flown_policies {name}",
            ("experiments.in_flight.flown_policies",),
            tools=_SPACECRAFT,
        )
        for name in ("default", "kingfisher")
    },
    "benchmarks": Source("benchmarks", ("benchmarks.methods", "scp_recon.cli"), AROUND, tools=_NLP),
    "growth": Source("benchmarks --growth", ("benchmarks.growth",), tools=_NLP),
    "waits": Source(
        "benchmarks.waits", ("benchmarks.waits", "formulations", "scp_recon"), without=()
    ),
    "campaign_scale": Source("benchmarks.campaign_scale", ("benchmarks.campaign_scale",)),
    "maps": Source("experiments maps --pictures docs", ("experiments.maps", "examples.studies")),
    "map_sample": Source(
        "experiments maps --sample",
        ("experiments.maps", "examples.studies"),
        figures=("paper_figs map_sample --runs {out} --out docs/map_sample.png",),
    ),
    "reliability": Source("experiments testing reliability", _ALL, without=()),
    "coverage": Source("experiments testing coverage", _ALL, without=()),
    "mutation": Source("experiments testing mutation", ("formulations", *_OF_MUTANTS), without=()),
}
"""By name of the evidence."""


@dataclass(frozen=True)
class Evidence:
    """A file of evidence.

    Attributes:
        command: the command that made it, after `python -m`.
        commit: commit of the sources; with a plus if some had changes.
        date: on which it was made (UTC).
        machine: processor and number of cores.
        versions: of packages.
        sources: hash of what the rows depend on, or `UNKNOWN`.
        seconds: wall time of the study.
        resumed: whether it continued finished work, whose time the seconds leave out.
        tables: rows of each table by its name.
    """

    command: str
    commit: str
    date: str
    machine: str
    versions: Mapping[str, str]
    sources: str
    seconds: float
    resumed: bool
    tables: Mapping[str, Records]

    @classmethod
    def begun(cls, source: Source) -> Self:
        """Evidence without tables, of the sources as they are when the study begins."""
        today = datetime.now(UTC).date().isoformat()
        of = (source.command, _commit(), today, machine(), *_code(source))
        return cls(*of, seconds=0.0, resumed=False, tables={})

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file of evidence.

        Raises:
            FileNotFoundError: if there is none.
            ValueError: if it is none.
        """
        values = json.loads(path.read_text("utf-8"))
        if values.pop("schema", None) != SCHEMA:
            raise ValueError(f"{path} is not of {SCHEMA}")
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

    def changes(self, source: Source) -> list[str]:
        """Sources that have changed since it was made; empty where it is up to date."""
        newer, found = _code(source)
        if self.sources == UNKNOWN:
            return ["measured before sources were hashed"]
        changed = [] if found == self.sources else ["sources"]
        changed += [
            f"{name} {self.versions.get(name)}, now {version}"
            for name, version in newer.items()
            if self.versions.get(name) != version
        ]
        return changed + ([f"by {self.command}"] if self.command != source.command else [])


def path_of(name: str) -> Path:
    """The file of a name."""
    return FOLDER / f"{name}.json"


def source_of(command: str, module: str) -> Source:
    """The source of the evidence that a command makes; for another command its module."""
    found = (source for source in SOURCES.values() if source.command == command)
    return next(found, Source(command, (module,)))


def out_of_date(names: Sequence[str] | None = None) -> dict[str, str]:
    """Names of evidence that is missing or out of date, with the reason; by default of all evidence."""
    found = {}
    for name in SOURCES if names is None else names:
        try:
            changes = Evidence.read(path_of(name)).changes(SOURCES[name])
        except FileNotFoundError:
            changes = ["never measured"]
        if changes:
            found[name] = ", ".join(changes)
    return found


def machine() -> str:
    """Processor and number of cores."""
    cpu, info = platform.processor() or platform.machine(), Path("/proc/cpuinfo")
    if info.exists() and (named := re.search(r"model name\s*:\s*(.+)", info.read_text("utf-8"))):
        cpu = named[1]
    return f"{cpu}, {os.cpu_count()} cores; Python {platform.python_version()}"


def _code(source: Source) -> tuple[dict[str, str], str]:
    """Versions, but not this package's own, and hash of the sources."""
    found = {name: version for name, version in versions().items() if name != "scp_recon"}
    for name in source.tools:
        with suppress(PackageNotFoundError):
            found[name] = version_of(name)
    return found, sources(*source.modules, *DATA, without=source.without)


@cache
def _commit() -> str:
    def git(*words: str) -> str:
        command = ("git", "-C", str(ROOT), *words)
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "--short", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return UNKNOWN
