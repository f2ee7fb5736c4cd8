"""What the benchmarks say of their figures; the figures themselves are no test's business."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

import benchmarks.__main__ as command
from benchmarks.growth import STUDIES, Study
from benchmarks.methods import METHODS, Timed
from benchmarks.tables import pair_table, ratio_lines
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


def test_the_document_has_the_figures(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "in_a_process", lambda name, _: figures()[name])
    monkeypatch.setattr(command, "command_times", lambda _: {"solve": 1.5, "import cvxpy": 0.75})
    assert command.main(["--quick", "--json"]) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert document["command"] == "benchmarks"
    assert document["methods"]["ipopt printed"]["best"] == 16.0
    assert document["commands_s"]["solve"] == 1.5
    assert "printed over SCP: 100 with set-up" in said.err


def test_ratios_are_of_the_methods_they_name() -> None:
    lines = "\n".join(ratio_lines(figures(), {"solve": 1.5, "import cvxpy": 0.75}))
    assert "printed over SCP: 100 with set-up, 150 without" in lines
    # The quickest to the first answer is not the quickest without set-up.
    assert "tuned NLP over SCP: 10.0 with set-up, 11.0 without" in lines
    assert "99 converged: 20 ms against 100 ms cold, 0.20 of it" in lines
    assert "1.50 s, 2.00 times that of importing CVXPY" in lines


def test_the_table_says_what_is_not_verified_and_how_far_it_is_off() -> None:
    found = figures()
    found["scp lifted"] = replace(PLANNED, verified=False, total_dv_m_s=0.14014)
    rows = {line.split(" | ")[0].lstrip("| "): line for line in pair_table(found).splitlines()}
    assert "converged, verified" in rows["scp condensed"]
    assert "0.140140, 1e-03 | converged, not verified" in rows["scp lifted"]
    assert not {"replan", "montecarlo"} & set(rows)


@pytest.mark.parametrize("study", STUDIES, ids=lambda study: study.name)
def test_every_size_is_a_mission(study: Study) -> None:
    for size in study.sizes[:: len(study.sizes) - 1]:
        mission = Mission.from_scenario(load_scenario(None, study.overrides(size)))
        if study.name == "burns":
            assert len(mission.burn_nodes) == size


def test_the_pages_tables_are_replaced_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "performance.md"
    page.write_text(f"before\n{command.BEGIN}\nold\n{command.END}\nafter\n", encoding="utf-8")
    monkeypatch.setattr(command, "PAGE", page)
    command.write_page("new")
    assert page.read_text("utf-8") == f"before\n{command.BEGIN}\nnew\n{command.END}\nafter\n"
