"""Tables and ratios of the benchmarks from made-up times; no time is tested."""

import itertools
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import benchmarks.__main__ as command
from experiments.evidence import FILE, ROOT, Evidence
from tests.helpers import nightly

pytestmark = pytest.mark.slow

PLANNED = {"total_dv_m_s": 0.14, "status": "converged, verified", "import_s": 0.4, "first_s": 0.2}
PLANNED |= {"later_s": 0.1, "processor_s": 0.1, "setup_s": 0.0, "canonicalise_s": 0.01}
PLANNED |= {"conic_solver_s": 0.05, "subproblem_s": 0.008}
SLOW = {
    "ipopt printed": {"first_s": 20.0, "later_s": 16.0, "setup_s": 1.0, "total_dv_m_s": 0.14014},
    "ipopt tuned": {"first_s": 2.0, "later_s": 1.5, "setup_s": 0.3},
    "ipopt shooting": {"first_s": 2.4, "later_s": 1.3, "setup_s": 0.2},
}
OTHERS = {
    "replanned": {"replans": 100, "converged": 99, "later_s": 0.02, "cold_s": 0.1},
    "flown": {"flights": 1000, "first_s": 0.1, "later_s": 0.05},
}
RATIOS = {
    "IPOPT as printed over SCP, first plan of a process": 100.0,
    "IPOPT as printed over SCP": 150.0,
    # The quickest to the first answer is not the quickest without set-up.
    "best tuned NLP over SCP, first plan of a process": 10.0,
    "best tuned NLP over SCP": 11.0,
    "all else over the conic solver": 1.0,
    "replan over cold plan": 0.2,
    "flights a second": 20_000.0,
    "command line over importing CVXPY": 2.0,
}


def evidence_of(out: Path, *words: str) -> Evidence:
    assert command.main([*words, "--out", str(out), "--quiet"]) == 0
    found = Evidence.read(out / FILE)
    assert found.command == " ".join(("benchmarks", *words))
    return found


def test_ratios_follow_from_the_methods_times(tmp_path, monkeypatch):
    def made_up(words: Sequence[str]) -> dict[str, Any]:
        what, *rest = words
        return OTHERS.get(what) or {"method": rest[0], **PLANNED, **SLOW.get(rest[0], {})}

    monkeypatch.setattr(command, "in_a_process", made_up)
    monkeypatch.setattr(command, "command_times", lambda _: {"solve": 1.5, "import cvxpy": 0.75})
    tables = evidence_of(tmp_path).tables
    rows = {row["method"]: row for row in tables["methods"]}
    assert list(rows) == list(command.METHODS)
    assert rows["ipopt printed"]["off"] == pytest.approx(1e-3)
    ratios = {row["figure"]: row["value"] for row in tables["ratios"]}
    assert {name: ratios[name] for name in RATIOS} == pytest.approx(RATIOS)


def test_least_processor_time_of_a_command_counts(tmp_path, monkeypatch):
    took = itertools.count(1)

    def waited(name: str, _: Path) -> dict[str, Any]:
        number = next(took)
        return {"command": name, "wall_s": 100.0 - number, "processor_s": float(number)}

    monkeypatch.setattr(command, "waited", waited)
    rows = evidence_of(tmp_path, "waits").tables["waits"]
    expected = list(zip(command.WAITS, range(1, len(command.WAITS) + 1), strict=True))
    assert [(row["command"], row["processor_s"]) for row in rows] == expected
    assert next(took) == 2 * len(command.WAITS) + 1


IMPORTED = """
import sys
from benchmarks import methods

def timed(run, _):
    before = set(sys.modules)
    run()
    sys.exit(set(sys.modules) != before)

methods.timed = timed
methods.main()
"""


@nightly
@pytest.mark.parametrize("name", ["scp condensed", "ipopt tuned"])
def test_timed_run_imports_nothing(name):
    subprocess.run([sys.executable, "-c", IMPORTED, "planned", name, "0"], check=True, cwd=ROOT)
