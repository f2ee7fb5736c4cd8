"""`python -m scp_recon replan`: plan and verdict, what others make of them, and its messages."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scp_recon.advice.trials import RETURN, Remedy
from scp_recon.cli.commands import compare, montecarlo, replan, simulate, verify
from scp_recon.cli.plan_run import what_would_do
from scp_recon.mission.mission import Mission
from scp_recon.replanning.flown import FlownPlan, predict
from scp_recon.results.read import read_solution
from scp_recon.verification.reintegration import limits_of

pytestmark = pytest.mark.slow

OFF = np.array([40.0, -40.0, 20.0, 2e-3, 2e-3, -1e-3])


@pytest.fixture
def plan_folder(verified, tmp_path) -> Path:
    folder = tmp_path / "plan"
    folder.mkdir()
    verified.write(folder)
    return folder


@pytest.fixture(scope="module")
def state_at(default_plan) -> Callable[[float], list[str]]:
    flown = FlownPlan.of(default_plan)

    def words(at_s: float) -> list[str]:
        return [repr(x) for x in (predict(flown, at_s, {}).state + OFF).tolist()]

    return words


def test_replan_is_kept_verified_flown_and_compared(plan_folder, state_at, tmp_path, capsys):
    out = tmp_path / "again"
    burn = "--measured-burn=2=-0.0066,0.0266,-0.0074"
    words = [str(plan_folder), "--at", "17000", "--state", *state_at(17_000.0), burn]
    assert replan.main([*words, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "from 17000 s on, 2 burns" in said
    assert "over, nothing is" in said
    assert "\nverified" in said
    found = read_solution(out)
    assert (found.parent.name, found.parent.at_s) == (str(plan_folder), 17_000.0)
    assert found.parent.plan_hash == read_solution(plan_folder).plan_hash
    assert found.flown_m_s[1].tolist() == [-0.0066, 0.0266, -0.0074]
    assert [burn.t_s for burn in found.burns] == [25_000.0, 34_842.0]
    assert verify.main([str(out)]) == 0
    assert montecarlo.main([str(out), "--samples", "200"]) == 0
    assert "window is over" in capsys.readouterr().out
    assert compare.main([str(plan_folder), str(out)]) == 0
    said = capsys.readouterr().out
    assert "those flown (mm/s)" in said
    assert str(plan_folder) in said
    assert simulate.main([str(out)]) == 2
    assert "a whole flight" in capsys.readouterr().err


def test_verdict_has_the_miss_of_one_burn(plan_folder, state_at, tmp_path, capsys):
    out = tmp_path / "again"
    (tmp_path / "state.txt").write_text("# x y z vx vy vz\n" + "\n".join(state_at(26_000.0)))
    words = [str(plan_folder), "--at", "2020-01-22T03:46:37.184", "--out", str(out)]
    assert replan.main([*words, "--state", str(tmp_path / "state.txt")]) == 0
    assert "missed by 58.8" in capsys.readouterr().out
    found = read_solution(out)
    assert found.scenario.start_s == 26_000.0
    assert found.verification.missed.position_m == pytest.approx(58.8, abs=0.1)
    assert found.violation.by_constraint == {}
    assert verify.main([str(out), "-v"]) == 0
    said = capsys.readouterr().out
    assert "missed by 58.8" in said
    # What is not judged stands beside no limit.
    rows = {line[:20].strip(): line[20:].split() for line in said.splitlines()}
    assert rows["final position"] == ["5.9e+01", "m"]
    # Tolerances in metres grow with the mission: with the distance of the state that is delivered.
    limit = limits_of(Mission.from_scenario(found.scenario))["max_defect"]
    assert rows["nodes"][-2:] == [f"{limit:.1e}", "m"]


def test_advised_way_home_is_replans_option():
    remedy = Remedy(RETURN, {"observation.required": False}, 0.049)
    assert what_would_do(remedy) == "feasible, for 49.0 mm/s, with: --goal return"
