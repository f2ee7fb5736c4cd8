"""The table made once, by the command, with few flights."""

import contextlib
import io
import shutil
from pathlib import Path

import pytest

from experiments import harness, observation_table
from experiments.__main__ import main
from scp_recon.mission.mission import Mission
from scp_recon.results.solution import Solution, ballistic_arc
from tests.scp_recon.support import fly_few

from .support import SAMPLES, quick_rows


@pytest.fixture(scope="session")
def mission() -> Mission:
    return harness.default_mission()


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> tuple[Path, str]:
    """A whole run of the command: its folder and what it printed."""
    out = tmp_path_factory.mktemp("paper")
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), pytest.MonkeyPatch.context() as patch:
        patch.setattr(observation_table, "SAMPLES", SAMPLES)
        patch.setattr(observation_table, "rows", quick_rows)
        patch.setattr(observation_table, "variants", lambda _: [])
        fly_few(patch)
        assert main(["observation_table", "--out", str(out)]) == 0
    return out, printed.getvalue()


@pytest.fixture
def copy(finished, tmp_path) -> Path:
    return Path(shutil.copytree(finished[0], tmp_path / "copy"))


@pytest.fixture(scope="session")
def solution(mission) -> Solution:
    """Burns that are given, not planned: the studies do not mind."""
    return ballistic_arc(mission)
