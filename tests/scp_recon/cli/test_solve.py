"""The command line: what it shows, what it leaves on disk, and how it ends."""

import re

import pytest

import scp_recon as sr
from scp_recon.advice import infeasibility
from scp_recon.api import planning
from scp_recon.planning import planner, solver
from scp_recon.results.read import read_solution
from scp_recon.scp.status import Status
from tests.scenarios import COARSE
from tests.scp_recon.support import raising, run_python, run_solve

pytestmark = pytest.mark.slow


def test_default_plan_is_verified_shown_and_kept_alone(default_run):
    assert (default_run.exit_code, default_run.errors) == (0, "")
    assert [path.name for path in default_run.folder.iterdir()] == ["solution.json"]
    shown, solution = " ".join(default_run.output.split()), read_solution(default_run.folder)
    made = (solution.status, solution.problem, solution.init, solution.formulation)
    assert made == ("converged", "P2", "cold", "condensed")
    assert solution.total_dv_m_s <= 0.1420
    assert solution.verification.ok
    for piece in ("recon_b", "Nightingale", "13140.2 to 16537.5 s", "Converged"):
        assert piece in shown
    for component in (component for burn in solution.burns for component in burn.dv_m_s):
        assert f"{1e3 * component:+.3f}" in shown
    for p in solution.verification.probabilities:
        assert p.estimate >= 0.70
        assert f"{p.estimate:.4f} {p.low:.4f} to {p.high:.4f}" in shown
    assert str(default_run.folder / "solution.json") in default_run.output.replace("\n", "")


def test_saving_by_exact_risk_was_planned(default_run):
    assert len(default_run.output.strip().splitlines()) <= 30
    (line,) = read_solution(default_run.folder).advice
    assert line in " ".join(default_run.output.split())
    saved, cost = map(float, re.findall(r"([\d.]+) mm/s", line))
    exact = sr.plan("recon_b", certify=False, overrides=['risk.allocation="exact"'])
    assert exact.status is Status.CONVERGED
    assert abs(cost - 1e3 * exact.total_dv_m_s) <= 0.1
    assert abs(cost + saved - 1e3 * read_solution(default_run.folder).total_dv_m_s) <= 0.11
    assert line.endswith("""with: --set 'risk.allocation="exact"'""")


def test_it_runs_as_a_module(tmp_path):
    words = ("--init", "cold", "--problem", "P3", "--set", COARSE, "--out", str(tmp_path))
    run = run_python("-m", "scp_recon.solve", *words)
    assert (run.returncode, run.stderr) == (0, "")
    assert read_solution(tmp_path).problem == "P3"


def test_scenario_of_a_start_may_be_overridden(tmp_path):
    words = ("--problem", "P3", "--set")
    assert run_solve(tmp_path / "a", *words, "name=mine", "--set", COARSE).exit_code == 0
    again = run_solve(tmp_path / "b", *words, "risk.p_chance=0.9", "--init", str(tmp_path / "a"))
    assert again.exit_code == 0
    scenario = read_solution(tmp_path / "b").scenario
    assert (scenario.name, scenario.risk.p_chance) == ("mine", 0.9)
    assert "mine" in again.output


def test_infeasible_plan_names_violated_constraints(tmp_path, monkeypatch):
    monkeypatch.setattr(infeasibility, "LEAST_S", 0.5)
    words = ("--set", "burns.dv_max_m_s=0.02", "--set", COARSE, "--starts", "1")
    run = run_solve(tmp_path, *words, "-v")
    assert (run.exit_code, run.errors) == (3, "")
    solution = read_solution(tmp_path)
    assert solution.status == "infeasible"
    assert not solution.verification.ok
    lines = run.output.splitlines()
    assert "verified" not in [line.strip() for line in lines]
    assert "dv_max" in solution.violation.by_constraint
    for name, amount in solution.violation.by_constraint.items():
        assert any({name, f"{amount.max:.6g}", amount.unit} <= {*line.split()} for line in lines), (
            name
        )


@pytest.mark.parametrize(
    ("module", "name", "left"),
    [
        (solver, "choose_facets", "interrupted"),
        (planning, "verify", "converged"),
        (planner, "plan", None),
    ],
)
def test_ctrl_c_between_steps_keeps_finished_ones(module, name, left, tmp_path, monkeypatch):
    """Between P3 and P2, in the verification, and before anything."""

    monkeypatch.setattr(module, name, raising(KeyboardInterrupt()))
    run = run_solve(tmp_path, "--set", COARSE)
    assert run.exit_code == 130
    assert "Traceback" not in run.errors
    if left is None:
        assert list(tmp_path.iterdir()) == []
        return
    solution = read_solution(tmp_path)
    assert (solution.status, solution.verification) == (left, None)
