"""Tables and ratios of the benchmarks from made-up times; no time is tested."""

import itertools
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import pytest

import benchmarks.__main__ as command
from benchmarks import growth, waits
from benchmarks.growth import STUDIES, Study
from benchmarks.methods import METHODS, Timed
from benchmarks.tables import growth_rows, method_rows, ratio_rows
from experiments.evidence import FILE, ROOT, Evidence
from scp_recon.mission.mission import Mission
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status

SPLIT = {"setup": 0.0, "linearise": 0.02, "canonicalise": 0.01, "conic_solver": 0.05, "other": 0.02}
DETAILS = {"p2_subproblem": 0.008, "import": 0.4}
PLANNED = Timed(0.2, 0.1, 0.1, SPLIT, 100.0, 0.14, "converged", True, DETAILS)


def figures() -> dict[str, Timed]:
    slow = {
        "ipopt printed": (20.0, 16.0, 1.0),
        "ipopt tuned": (2.0, 1.5, 0.3),
        "ipopt shooting": (2.4, 1.3, 0.2),
    }
    found = dict.fromkeys(METHODS, PLANNED)
    for name, (first, best, setup) in slow.items():
        found[name] = replace(PLANNED, first=first, best=best, split=SPLIT | {"setup": setup})
    found["replan"] = Timed(0.01, 0.02, 0.02, details={"cold": 0.1, "converged": 99.0})
    found["montecarlo"] = Timed(0.1, 0.05, 0.05, details={"flights_per_s": 20_000.0})
    return found


def test_a_run_leaves_the_figures_as_evidence(tmp_path, monkeypatch):
    """Of what ran before a stop it keeps the rows."""
    ran: list[str] = []

    def in_a_process(module: str, name: str, _: str) -> dict[str, object]:
        assert module == "benchmarks.methods"
        if len(ran) == 3:
            ran.append("")
            raise KeyboardInterrupt
        ran.append(name)
        return asdict(figures()[name])

    monkeypatch.setattr(command, "in_a_process", in_a_process)
    monkeypatch.setattr(command, "command_times", lambda _: {"solve": 1.5, "import cvxpy": 0.75})
    words = ["--quick", "--out", str(tmp_path), "--quiet"]
    assert command.main(words) == 130
    assert command.main(words) == 0
    assert sorted(filter(None, ran)) == sorted(METHODS)
    found = Evidence.read(tmp_path / FILE)
    assert found.command == "benchmarks --quick"
    assert found.resumed
    rows = {row["method"]: row for row in found.tables["methods"]}
    assert rows["ipopt printed"]["later_s"] == 16.0
    assert {"replan", "montecarlo"}.isdisjoint(rows)
    assert "growth" not in found.tables
    ratios = {row["figure"]: row["value"] for row in found.tables["ratios"]}
    assert ratios["command line, s"] == 1.5


def test_growth_is_measured_alone(tmp_path, monkeypatch):
    def in_a_process(module: str, name: str, method: str) -> dict[str, object]:
        assert module == "benchmarks.growth"
        converged = ("converged",) * 2
        fit = growth.Fit(name, method, (1, 2), (0.1, 0.4), (5, 5), converged, (0.14,) * 2, 2, 2, 2)
        return asdict(fit)

    monkeypatch.setattr(command, "in_a_process", in_a_process)
    assert command.main(["--growth", "--out", str(tmp_path), "--quiet"]) == 0
    found = Evidence.read(tmp_path / FILE)
    assert found.command == "benchmarks --growth"
    assert command.main(["--growth", "--quick", "--out", str(tmp_path), "--quiet"]) == 2
    assert len(found.tables["growth"]) == len(STUDIES) * len(growth.METHODS)


def test_ratios_are_of_the_methods_they_name():
    rows = ratio_rows(figures(), {"solve": 1.5, "import cvxpy": 0.75})
    found = {row["figure"]: row["value"] for row in rows}
    assert found["IPOPT as printed over SCP, first plan of a process"] == pytest.approx(100)
    assert found["IPOPT as printed over SCP"] == pytest.approx(150)
    # The quickest to the first answer is not the quickest without set-up.
    assert found["best tuned NLP over SCP, first plan of a process"] == pytest.approx(10)
    assert found["best tuned NLP over SCP"] == pytest.approx(11)
    assert found["all else over the conic solver"] == pytest.approx(1.0)
    assert found["canonicalisation over the conic solver"] == pytest.approx(0.2)
    assert found["replans converged"] == 99
    assert found["replan over cold plan"] == pytest.approx(0.2)
    assert found["flights a second"] == 20_000
    assert found["command line over importing CVXPY"] == pytest.approx(2.0)


def test_a_row_says_what_is_not_verified_and_how_far_it_is_off():
    found = figures()
    found["scp lifted"] = replace(PLANNED, verified=False, total_dv_m_s=0.14014)
    rows = {row["method"]: row for row in method_rows(found)}
    assert rows["scp condensed"]["status"] == "converged, verified"
    assert rows["scp lifted"]["status"] == "converged, not verified"
    assert rows["scp lifted"]["off"] == pytest.approx(1e-3)
    assert rows["scp lifted"]["setup_s"] == 0.0
    assert rows["scp lifted"]["import_s"] == 0.4


@pytest.mark.parametrize("study", STUDIES, ids=lambda study: study.name)
def test_every_size_is_a_mission(study):
    for size in study.sizes[:: len(study.sizes) - 1]:
        mission = Mission.from_scenario(load_scenario(None, study.overrides(size)))
        if study.name == "burns":
            assert len(mission.burn_nodes) == size


def planned_in(overrides: list[str], _: object) -> tuple[object, float]:
    """A plan of n iterations in n^2 seconds, but for two nodes none in a hundred."""
    n = int(overrides[0])
    status = Status.MAX_ITERATIONS if n == 2 else Status.CONVERGED
    stage = SimpleNamespace(result=SimpleNamespace(records=[None] * n))
    plan = SimpleNamespace(status=status, stages=[stage], total_dv_m_s=0.14)
    return plan, 100.0 if n == 2 else n**2.0


def test_only_sizes_that_converged_give_an_exponent(monkeypatch):
    monkeypatch.setattr(growth, "_fastest", planned_in)
    monkeypatch.setattr(growth, "LEFT_OUT", {("nodes", "scp lifted"): (8, 16)})
    study = Study("nodes", (2, 4, 8, 16), lambda n: [str(n)])
    whole, short = growth_rows(growth.fit(study, f"scp {form}") for form in ("condensed", "lifted"))
    assert whole["seconds"] == "100.00 (2, max iterations), 16.00 (4), 64.00 (8), 256.00 (16)"
    assert whole["exponent"] == pytest.approx(2.0)
    assert whole["last"] == pytest.approx(2.0)
    assert whole["an_iteration"] == pytest.approx(1.0)
    assert (short["method"], short["sizes"]) == ("scp lifted", "2, 4")
    assert short["exponent"] is short["last"] is short["an_iteration"] is None


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


@pytest.mark.parametrize("name", ["scp condensed", "ipopt tuned"])
def test_no_time_of_a_method_has_an_import_in_it(name):
    subprocess.run([sys.executable, "-c", IMPORTED, name, "0"], check=True, cwd=ROOT)


def test_of_each_command_the_run_of_least_processor_time_counts(tmp_path, monkeypatch):
    took = itertools.count(1)

    def waited(name: str, _: Path) -> dict[str, object]:
        number = next(took)
        return {"command": name, "wall_s": 100.0 - number, "processor_s": float(number)}

    monkeypatch.setattr(waits, "waited", waited)
    assert waits.main(["--out", str(tmp_path), "--quiet"]) == 0
    found = Evidence.read(tmp_path / FILE).tables["waits"]
    assert [row["command"] for row in found] == list(waits.WAITS)
    assert [row["processor_s"] for row in found] == list(range(1, len(waits.WAITS) + 1))
    assert next(took) == waits.ROUNDS * len(waits.WAITS) + 1
