"""A plan is not lost to a failed run, and what is made of a plan stays with it."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

import scp_recon as sr
from scp_recon.advice.infeasibility import Diagnosis
from scp_recon.api.files import UNVERIFIED, keep, results_beside
from scp_recon.cli import plan_run
from scp_recon.cli.commands import compare, montecarlo, solve, verify
from scp_recon.errors import InputError
from scp_recon.files import only_run_in
from scp_recon.monte_carlo.summary import FILE_NAME, read_summary
from scp_recon.results.read import read_solution
from scp_recon.results.solution import Solution
from scp_recon.scp.status import Status
from tests.scenarios import COARSE
from tests.scp_recon.support import run_solve

HOPELESS = (
    *("--problem", "P3", "--starts", "1"),
    *("--set", "burns.dv_max_m_s=0.02", "--set", "grid.step_max_s=3000.0"),
)


@pytest.fixture
def undiagnosed(monkeypatch) -> None:
    """Why there is no plan is told elsewhere, and takes long to find."""
    monkeypatch.setattr(plan_run, "diagnose", lambda *_: Diagnosis(Status.MAX_ITERATIONS, (), ()))


def another(solution: Solution) -> Solution:
    burns = [replace(burn, dv_m_s=(0.0, 0.0, 0.1)) for burn in solution.burns]
    return replace(solution, burns=burns)


@pytest.mark.slow
@pytest.mark.usefixtures("undiagnosed")
def test_infeasible_run_leaves_verified_plan_alone(verified, tmp_path):
    before = verified.write(tmp_path).read_bytes()
    run = run_solve(tmp_path, *HOPELESS)
    assert run.exit_code == 3
    assert (tmp_path / "solution.json").read_bytes() == before
    assert read_solution(tmp_path / UNVERIFIED).status == "infeasible"
    assert f"written: {tmp_path / UNVERIFIED}" in run.output
    assert f"kept, as it is verified: {tmp_path / 'solution.json'}" in run.output
    # The next verified plan takes the place of both.
    keep(another(verified), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["solution.json"]


def test_unverified_plan_gives_way_to_any(solution, tmp_path):
    solution.write(tmp_path)
    path, _ = keep(another(solution), tmp_path)
    assert path.name == "solution.json"
    assert read_solution(tmp_path).plan_hash == another(solution).plan_hash


def test_results_of_another_plan_are_set_aside(verified, tmp_path, capsys):
    verified.write(tmp_path)
    assert montecarlo.main([str(tmp_path), "--samples", "40"]) in (0, 4)
    keep(verified, tmp_path)
    assert read_summary(tmp_path).is_of(verified)
    (tmp_path / "simulation.npz").write_bytes(b"of nobody knows which")
    _, aside = keep(another(verified), tmp_path)
    assert {path.name for path in aside} == {f"old_{FILE_NAME}", "old_simulation.npz"}
    assert read_summary(tmp_path / f"old_{FILE_NAME}").is_of(verified)
    assert not (tmp_path / FILE_NAME).exists()
    assert capsys.readouterr().err.count("error") == 0


@pytest.mark.slow
def test_exports_of_another_plan_are_set_aside(verified, tmp_path):
    """A pattern of their names then finds one plan; those of the same plan, and other files, stay."""
    scenarios = [verified.scenario.replace({"name": name}) for name in ("first", "next", "last")]
    plans = [replace(verified, scenario=scenario) for scenario in scenarios]
    mine, old = tmp_path / "export", tmp_path / "old_export"
    exported: list[str] = []
    for number, plan in enumerate(plans):
        _, aside = keep(plan, tmp_path)
        assert list(aside) == [old] * bool(number)
        assert not mine.exists()
        (file,) = sr.export(tmp_path, "csv", mine).files
        assert keep(plan, tmp_path)[1] == ()
        assert [*mine.iterdir()] == [file]
        assert sorted(path.name for path in old.glob("*")) == sorted(exported)
        exported.append(file.name)
    (mine / "notes.txt").write_text("of the user's own")
    keep(verified, tmp_path)
    assert [path.name for path in mine.iterdir()] == ["notes.txt"]


def test_results_beside_another_plan_are_refused(verified, tmp_path):
    another(verified).write(tmp_path)
    beside = results_beside(tmp_path, verified, FILE_NAME, "--out", b"")
    with pytest.raises(InputError, match="holds another plan"), beside:
        pytest.fail("work was begun")


def test_second_run_into_a_folder_is_refused(tmp_path):
    with only_run_in(tmp_path, "--out"):
        run = run_solve(tmp_path, "--problem", "P3")
    assert run.exit_code == 2
    assert "is at work" in run.errors
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.usefixtures("undiagnosed")
def test_run_without_out_makes_its_own_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert solve.main(["--problem", "P3", "--set", "name=my plan", "--set", COARSE]) == 0
    (mine,) = (tmp_path / "runs" / "my_plan").iterdir()
    assert (tmp_path / "runs" / "latest").resolve() == mine
    assert solve.main(list(HOPELESS)) == 3
    assert read_solution(Path("runs/latest")).status == "infeasible"
    assert read_solution(mine).status == "converged"
    assert verify.main(["runs/latest"]) == 4
    assert compare.main(["runs/latest", str(mine)]) == 0
    assert capsys.readouterr().err == ""
    assert solve.main(["--out", "runs/latest"]) == 2
    assert "last finished run" in capsys.readouterr().err


STRANGE = "observation.emission_min_deg=0.349"


@pytest.mark.slow
def test_warnings_go_with_plan_to_every_verdict(tmp_path, capsys):
    run = run_solve(tmp_path, "--set", STRANGE, "--set", COARSE)
    assert run.exit_code == 0  # a warning is no failure
    said = "observation.emission_min_deg: got 0.349 deg"
    lines = run.output.rstrip().splitlines()
    assert "verified; 2 warnings above" in lines  # and what the linear law misses
    assert sum(line.startswith(f"warning: {said}") for line in lines) == 1
    data = json.loads((tmp_path / "solution.json").read_text("utf-8"))
    assert [warning["entry"] for warning in data["warnings"]] == ["observation.emission_min_deg"]
    capsys.readouterr()
    assert verify.main([str(tmp_path)]) == 0
    assert capsys.readouterr().out.count(f"warning: {said}") == 1
    assert montecarlo.main([str(tmp_path), "--samples", "200"]) == 0
    assert capsys.readouterr().out.count(f"warning: {said}") == 1
    assert compare.main([str(tmp_path)]) == 0
    assert f"warning of {tmp_path}: {said}" in capsys.readouterr().out
    # A file of before there were warnings has none, and verify finds them again.
    del data["warnings"]
    (tmp_path / "solution.json").write_text(json.dumps(data), "utf-8")
    assert read_solution(tmp_path).warnings == ()
    assert verify.main([str(tmp_path)]) == 0
    assert capsys.readouterr().out.count(f"warning: {said}") == 1
