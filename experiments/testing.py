"""Measure the tests: `python -m experiments testing WHAT`.

*reliability* runs the property tests with 500 examples, by a fixed seed, and counts them.
*coverage* counts the lines and branches that all tests reach. *mutation* makes three small changes in
each module of `formulations`, drawn with a fixed seed, and counts those that a test detects.
OUT/WHAT.csv has the counts. A run of *mutation* that was stopped continues with the first missing
module.
"""

from __future__ import annotations

import json
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.evidence import ROOT
from experiments.harness import Record, Session, Study, Tables, run_python
from scp_recon.monte_carlo.estimates import proportion

BY_FILE = ("-n", "2", "--dist", "loadfile")
PACKAGES = ("formulations", "scp_recon")
DRAWN, DRAWN_BY = 3, 0
FOUND_OUT = frozenset({"killed", "timeout", "segfault", "suspicious"})
"""Ends of mutants that tests do not let pass, in mutmut's words."""
NO_TESTS, NOT_TRIED = "no tests", "not checked"


def reliability(session: Session) -> list[Record]:
    """A row a figure of the property tests."""
    seed = ("-m", "hypothesis", "--hypothesis-seed=1", "--timeout", "3600")
    counts = _counted(session.out, "nightly", *seed)
    return [{"figure": name, "all": count} for name, count in counts.items()]


def coverage(session: Session) -> list[Record]:
    """A row a package; and the counts of the whole run, with the default examples."""
    measured, rows = session.out.resolve() / "coverage.json", list[Record]()
    counts = _counted(session.out, "default", *BY_FILE, "--cov", f"--cov-report=json:{measured}")
    files = json.loads(measured.read_text("utf-8"))["files"]
    for package in PACKAGES:
        row: Record = {"of": package}
        own = [file["summary"] for path, file in files.items() if path.startswith(f"{package}/")]
        for what, of in (("lines", "statements"), ("branches", "branches")):
            reach, most = (sum(f[key] for f in own) for key in (f"covered_{what}", f"num_{of}"))
            row |= {f"{what}_reached": reach, what: most, f"{what}_share": reach / most}
        rows.append(row)
    return rows + [{"of": figure, "count": count} for figure, count in counts.items()]


def _counted(out: Path, profile: str, *words: str) -> dict[str, Any]:
    """The counts of a run of pytest; tests that fail are counted, and no error."""
    counts = out.resolve() / "counts.json"
    _run(profile, "pytest", "-q", *words, f"--reliability={counts}", statuses=(0, 1))
    found: dict[str, Any] = json.loads(counts.read_text("utf-8"))
    return found


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

    def tried(module: str) -> Record:
        """Outcomes of the tests for the drawn mutants of a module."""
        return {"of": module, **_tried(drawn[module])}

    rows = session.rows("modules", tried, drawn)
    total = {key: sum(row[key] for row in rows) for key in ("tried", "found_out", "without_test")}
    share = proportion(total["found_out"], total["tried"])
    ends = {"share": share.value, "share_low": share.low, "share_high": share.high}
    return [*rows, {"of": "all", "mutants": sum(map(len, modules.values())), **total, **ends}]


def _tried(mutants: Sequence[str]) -> Record:
    """Ends of some mutants, counted; those that no run has tried are tried."""
    before = _results()
    if any(before[mutant] == NOT_TRIED for mutant in mutants):
        _mutmut("run", "--max-children", "2", *mutants)
    said = {mutant: end for mutant, end in _results().items() if mutant in mutants}
    ends = list(said.values())
    return {
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
    return _run("mutation", "mutmut", *words)


def _run(profile: str, *words: str, statuses: Sequence[int] = (0,)) -> str:
    """What a module prints that runs in the project's folder, on one thread."""
    setting = {"HYPOTHESIS_PROFILE": profile, "OMP_NUM_THREADS": "1"}
    return run_python(["-m", *words], statuses, ROOT, setting)[1]


KINDS = {"reliability": reliability, "coverage": coverage, "mutation": mutation}


def run(session: Session) -> Tables:
    """Measure one of them."""
    what = session.options.what
    return {what: KINDS[what](session)}


WHAT = {"choices": tuple(KINDS), "metavar": "WHAT", "help": f"one of {', '.join(KINDS)}"}
STUDIES = {"testing": Study(__doc__, run, {"what": WHAT})}
