"""Evidence: when it is out of date, what a sentinel feels, and renewal."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from experiments import evidence, harness, pages, renewal
from experiments.__main__ import main
from experiments.evidence import FOLDER, SOURCES, Evidence, path_of
from experiments.left_out import find_cones
from experiments.sentinels import WITHIN, near, sentinels_of
from scp_recon.mission.scene import forces_of
from scp_recon.physics.forces import ForceModel
from tests.helpers import nightly

CONES = "battery_cones"
TABLE = find_cones(0)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Where evidence goes, of one quick study, and one page."""
    page = tmp_path / "page.md"
    page.write_text("<!-- table battery_cones.battery_cones -->\n<!-- end -->\n", "utf-8")
    (tmp_path / "claims.toml").touch()
    monkeypatch.setattr(pages, "CLAIMS", tmp_path / "claims.toml")
    monkeypatch.setattr(pages, "PAGES", (page,))
    monkeypatch.setattr(evidence, "FOLDER", tmp_path)
    monkeypatch.setattr(renewal, "SOURCES", {CONES: SOURCES[CONES]})
    monkeypatch.setattr(renewal, "RUNS", tmp_path / "runs")
    pages._tables.cache_clear()
    return tmp_path


def keep(**changes: Any) -> None:
    """Evidence of the quick study as it is today, but for some changes."""
    found = Evidence.begun(SOURCES[CONES].command, 1)
    tables: Any = {CONES: TABLE}
    found.model_copy(update={"tables": tables, "seconds": 90.0, **changes}).write(path_of(CONES))


def test_every_evidence_has_command_and_sentinels():
    assert {path.stem for path in FOLDER.glob("*.json")} == set(SOURCES)
    for name, source in SOURCES.items():
        assert Evidence.read(path_of(name)).command == source.command
        if not source.dated:
            assert sum(len(one.cases) for one in sentinels_of(name)) in range(1, 6)
            for one in sentinels_of(name):
                row = Evidence.read(path_of(one.of)).tables[one.rows.rpartition(".")[2]][0]
                assert {*one.key.split(", ")} <= set(row)
                assert set(row) & set(WITHIN)


@pytest.mark.parametrize(
    ("old", "new", "within", "same"),
    [
        (1.0, 1.00009, 1e-4, True),
        (1.0, 1.0002, 1e-4, False),
        ("0.140135", 0.1401352, 1e-5, True),
        (None, float("nan"), 0.0, True),
        (None, 1.0, 1e-4, False),
        ("converged", "stalled", 0.0, False),
    ],
)
def test_figures_move_beyond_their_tolerance(old, new, within, same):
    assert near(old, new, within) == same


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"version": 0}, "version 0, now 1"),
        ({"command": "experiments other"}, "experiments other"),
        ({"versions": {"clarabel": "0.1"}, "commit": "old", "machine": "other"}, ""),
        ({"tables": {CONES: [TABLE[0] | {"half_angle_deg": 22.0}, *TABLE[1:]]}}, "22.0"),
    ],
)
@pytest.mark.usefixtures("folder")
def test_evidence_is_outdated_by_results_alone(changes, said):
    keep(**changes)
    (sentinel,) = sentinels_of(CONES)
    lines = renewal.changes(CONES) or sentinel.moved(TABLE)
    assert bool(lines) == bool(said)
    assert said in "".join(lines)


@nightly
@pytest.mark.slow
def test_only_outdated_evidence_is_renewed(folder, capsys):
    keep(tables={CONES: [row | {"half_angle_deg": 1.0} for row in TABLE]})
    assert main(["evidence", "--check"]) == renewal.OUT_OF_DATE
    said = capsys.readouterr().out.replace("\n", " ")
    assert "battery_cones.json: battery_cones[observation, False].half_angle_deg: was 1.0" in said
    assert "page.md: its tables are old" in said
    assert main(["evidence"]) == 0
    assert Evidence.read(path_of(CONES)).seconds < 90.0
    assert "| 22.51 |" in (folder / "page.md").read_text("utf-8")
    assert main(["evidence", "--check"]) == 0
    assert "battery_cones: current" in capsys.readouterr().out


def heavier(scene: Any, field: Any) -> ForceModel:
    """GM larger by 0.1 %."""
    found = forces_of(scene, field)
    return replace(found, gm=1.001 * found.gm, j2_strength=1.001 * found.j2_strength)


def forget() -> None:
    """Plans that studies remember."""
    harness.default_mission.cache_clear()
    harness.default_plan.cache_clear()


@nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", ["plans", "frontier", "feedback", "model_fidelity", "sensitivity"])
def test_a_planted_change_moves_studies(name, monkeypatch, request):
    request.addfinalizer(forget)
    forget()
    for module in list(sys.modules.values()):
        if vars(module).get("forces_of") is forces_of and module.__name__ != __name__:
            monkeypatch.setattr(module, "forces_of", heavier)
    assert any(one.moved(one.work(case)) for one in sentinels_of(name) for case in one.cases)
