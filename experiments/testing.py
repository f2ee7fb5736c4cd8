"""Measure the tests: `python -m experiments testing WHAT`, in the project's folder.

*reliability* runs the property tests with 500 examples, by a fixed seed, and counts them.
*coverage* counts the lines and branches that all tests reach. *mutation* makes three small changes in
each module of `formulations`, drawn with a fixed seed, and counts those that a test detects.
OUT/WHAT.csv has the counts. A run that was stopped continues with the first seed or module that is
missing.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from experiments.evidence import ROOT
from experiments.harness import Findings, Record, Session, Study, option, records
from scp_recon.errors import InputError
from scp_recon.jobs.job import Job
from scp_recon.monte_carlo.estimates import proportion

SEEDS = (1,)
"""Of the property tests; each takes half an hour."""
DRAWN, DRAWN_BY = 3, 0
BY_FILE = ("-n", "2", "--dist", "loadfile")
PACKAGES = ("formulations", "scp_recon")
FOUND_OUT = frozenset({"killed", "timeout", "segfault", "suspicious"})
"""Ends of mutants that tests do not let pass, in mutmut's words."""
NO_TESTS, NOT_TRIED = "no tests", "not checked"


def properties(out: Path, seed: int) -> Record:
    """Counts of the property tests by a seed."""
    counts = out.resolve() / f"counts_{seed}.json"
    words = ("-m", "hypothesis", f"--hypothesis-seed={seed}", "--timeout", "3600")
    _pytest(*words, f"--reliability={counts}", profile="nightly")
    found: Record = json.loads(counts.read_text("utf-8"))
    return found


def reliability(session: Session) -> list[Record]:
    """A row a figure, with a column for each seed and their sum."""
    jobs = [Job(seed, seed) for seed in SEEDS]
    found = session.rows("seeds", lambda seed: properties(session.out, seed), jobs, session.store())
    return [
        {"figure": name}
        | {f"seed_{seed}": row[name] for seed, row in zip(SEEDS, found, strict=True)}
        | {"all": sum(row[name] for row in found)}
        for name in found[0]
    ]


def coverage(session: Session) -> list[Record]:
    """A row a package; and the counts of the whole run, with the default examples."""
    measured, counts = (session.out.resolve() / f"{name}.json" for name in ("coverage", "counts"))
    report = (f"--cov-report=json:{measured}", f"--reliability={counts}")
    _pytest(*BY_FILE, "--cov", *report, profile="default")
    files = json.loads(measured.read_text("utf-8"))["files"]
    rows = [_covered(name, files) for name in PACKAGES]
    said: Record = json.loads(counts.read_text("utf-8"))
    return rows + [{"of": figure, "count": count} for figure, count in said.items()]


def _covered(package: str, files: Mapping[str, Mapping[str, Mapping[str, int]]]) -> Record:
    found = [file["summary"] for path, file in files.items() if path.startswith(f"{package}/")]
    row: Record = {"of": package}
    for what, reached, among in (
        ("lines", "covered_lines", "num_statements"),
        ("branches", "covered_branches", "num_branches"),
    ):
        reach, most = (sum(one[key] for one in found) for key in (reached, among))
        row |= {f"{what}_reached": reach, what: most, f"{what}_share": reach / most}
    return row


def mutation(session: Session) -> list[Record]:
    """A row a module with its drawn mutants, and one of all with the 95 % interval."""
    _mutmut("run", "--max-children", "2", f"{PACKAGES[0]}.registry.*")  # which makes all of them
    modules: dict[str, list[str]] = {}
    for mutant in _results():
        modules.setdefault(mutant.rpartition(".")[0], []).append(mutant)
    draw = random.Random(DRAWN_BY)
    drawn = {
        module: sorted(draw.sample(mutants, min(DRAWN, len(mutants))))
        for module, mutants in sorted(modules.items())
    }

    def work(module: str) -> Record:
        return tried(module, drawn[module])

    jobs, store = [Job(module, module) for module in drawn], session.store()
    rows = session.rows("modules", work, jobs, store)
    total = {
        key: sum(row[key] for row in rows) for key in rows[0] if key not in ("of", "survivors")
    }
    share = proportion(total["found_out"], total["tried"])
    ends = {"share": share.value, "share_low": share.low, "share_high": share.high}
    all_of = {"of": "all", "mutants": sum(map(len, modules.values()))}
    return [*rows, all_of | total | ends]


def tried(module: str, mutants: Sequence[str]) -> Record:
    """Outcomes of the tests for some mutants of a module."""
    before = _results()
    if any(before[mutant] == NOT_TRIED for mutant in mutants):
        _mutmut("run", "--max-children", "2", *mutants)
    said = {mutant: end for mutant, end in _results().items() if mutant in mutants}
    ends = list(said.values())
    return {
        "of": module,
        "tried": len(ends),
        "found_out": sum(end in FOUND_OUT for end in ends),
        "without_test": ends.count(NO_TESTS),
        "survivors": "; ".join(mutant for mutant, end in said.items() if end == "survived"),
    }


def _results() -> dict[str, str]:
    """Ends of all mutants by their names."""
    lines = _mutmut("results", "--all", "true").splitlines()
    pairs = (line.strip().partition(": ") for line in lines if ": " in line)
    return {name: end for name, _, end in pairs}


def _mutmut(*words: str) -> str:
    return _run(str(Path(sys.executable).with_name("mutmut")), *words, profile="mutation")


def _pytest(*words: str, profile: str) -> str:
    return _run(sys.executable, "-m", "pytest", "-q", *words, profile=profile, failing=True)


def _run(*words: str, profile: str, failing: bool = False) -> str:
    """Run a program in the project's folder; tests that fail are counted, and no error."""
    setting = {**os.environ, "HYPOTHESIS_PROFILE": profile, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        words, check=False, cwd=ROOT, env=setting, stdout=subprocess.PIPE, text=True
    )
    if done.returncode not in ((0, 1) if failing else (0,)):
        raise InputError(words[0], f"exit status {done.returncode}", "must end with its results")
    return done.stdout


KINDS: Mapping[str, Callable[[Session], list[Record]]] = {
    "reliability": reliability,
    "coverage": coverage,
    "mutation": mutation,
}


def run(session: Session) -> Findings:
    """Measure one of them."""
    what = session.options.what
    return Findings({f"{what}.csv": records(KINDS[what](session))})


STUDY = Study(
    __doc__,
    run,
    [option("what", choices=tuple(KINDS), metavar="WHAT", help=f"one of {', '.join(KINDS)}")],
)
