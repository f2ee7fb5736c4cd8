"""The outside peer: what is told without it, and that both sides solve the same P3 with it."""

from __future__ import annotations

import importlib.util
from dataclasses import asdict
from pathlib import Path

import pytest

from experiments import openscvx_peer
from experiments.__main__ import main
from experiments.compare_solvers import study as compare_solvers
from experiments.compare_solvers.study import PEER_FILE
from scp_recon.jobs.store import Store
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess

MISSING = importlib.util.find_spec("openscvx") is None


def test_our_row_flies_the_burns_that_it_reports(mission: Mission) -> None:
    row = openscvx_peer.our_row(mission, initial_guess.ballistic(mission), "scvx", "CLARABEL")
    assert (row.group, row.problem, row.status) == ("peer", "P3", "converged")
    assert row.total_dv_m_s == pytest.approx(0.107723, abs=2e-6)
    assert row.merit_m_s == pytest.approx(row.total_dv_m_s, rel=1e-6)
    assert row.violation_m < 1e-3


def test_its_rows_are_taken_into_the_comparison(
    tmp_path: Path, mission: Mission, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = openscvx_peer.our_row(mission, initial_guess.ballistic(mission), "ptr", "QOCO")
    with Store(tmp_path / PEER_FILE, {}) as store:
        store.put(0, asdict(row))
    monkeypatch.setattr(compare_solvers, "quick_design", tuple)
    monkeypatch.setattr(compare_solvers, "exact_design", lambda *_: ())
    assert main(["compare_solvers", "--quick", "--out", str(tmp_path)]) == 0
    assert row.key in (tmp_path / "comparison.csv").read_text()
    assert "| condensed/ptr/QOCO | converged (P3) |" in (tmp_path / "comparison.md").read_text()


@pytest.mark.skipif(MISSING, reason="OpenSCvx is not installed")
def test_its_problem_has_the_planners_nodes_and_burns(mission: Mission) -> None:
    posed = openscvx_peer.pose(mission, initial_guess.ballistic(mission), 5)
    assert posed.arguments["N"] < len(mission.times_s)
    assert len(posed.burn_nodes) == mission.problem.n_burns
