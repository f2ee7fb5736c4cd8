"""Tables and ratios of the benchmarks from made-up times; no time is tested."""

import itertools
from dataclasses import asdict, replace
from pathlib import Path

import pytest

import benchmarks.__main__ as command
from benchmarks import waits
from benchmarks.growth import STUDIES
from benchmarks.methods import METHODS, Timed
from benchmarks.tables import method_rows, ratio_rows
from experiments.evidence import FILE, Evidence
from scp_recon.mission.mission import Mission
from scp_recon.scenario.load import load_scenario

SPLIT = {"setup": 0.0, "linearise": 0.02, "canonicalise": 0.01, "conic_solver": 0.05, "other": 0.02}
PLANNED = Timed(0.2, 0.1, 0.1, SPLIT, 100.0, 0.14, "converged", True, {"p2_subproblem": 0.008})


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

    def in_a_process(name: str) -> dict[str, object]:
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
    ratios = {row["figure"]: row["value"] for row in found.tables["ratios"]}
    assert ratios["command line, s"] == 1.5


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


@pytest.mark.parametrize("study", STUDIES, ids=lambda study: study.name)
def test_every_size_is_a_mission(study):
    for size in study.sizes[:: len(study.sizes) - 1]:
        mission = Mission.from_scenario(load_scenario(None, study.overrides(size)))
        if study.name == "burns":
            assert len(mission.burn_nodes) == size


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
