"""The outside peer: what is told without it, and that both sides solve the same P3 with it."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from experiments import openscvx_peer
from scp_recon import guess
from scp_recon.mission import Mission

MISSING = importlib.util.find_spec("openscvx") is None


@pytest.mark.skipif(not MISSING, reason="OpenSCvx is installed")
def test_without_it_the_command_names_the_extra(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert openscvx_peer.main(["--out", str(tmp_path)]) == 2
    assert "scp_recon[peer]" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_our_row_flies_the_burns_that_it_reports(mission: Mission) -> None:
    row = openscvx_peer.our_row(mission, guess.ballistic(mission), "scvx", "CLARABEL")
    figures = dict(zip(openscvx_peer.HEAD, row, strict=True))
    assert figures["status"] == "converged"
    assert float(figures["delta-v m/s"]) == pytest.approx(0.107723, abs=2e-6)
    assert float(figures["miss m"]) < 1e-3
    assert float(figures["worst margin m"]) == pytest.approx(0.0, abs=0.01)


@pytest.mark.skipif(MISSING, reason="OpenSCvx is not installed")
def test_its_problem_has_the_planners_nodes_and_burns(mission: Mission) -> None:
    problem = openscvx_peer.pose(mission, guess.ballistic(mission))
    assert problem.arguments["N"] < len(mission.times_s)
    assert len(problem.burn_nodes) == mission.problem.n_burns
