"""Figures are drawn in silence from their inputs; missing, damaged and foreign input is refused."""

import json
import shutil
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from matplotlib.figure import Figure

from experiments import observation_table
from paper_figs import __main__ as command_line
from paper_figs import flight, inputs, studies
from paper_figs.__main__ import EVERYTHING, FIGURES, STUDIES, Item, main
from paper_figs.drawing import save
from paper_figs.inputs import PAPER, PLAN, SURROGATE, Runs, read_runs
from scp_recon.campaigns.axes import EPOCH, LATITUDE, LONGITUDE
from scp_recon.campaigns.outcome import CHANCE, COST, CampaignResults
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.results.read import read_solution
from scp_recon.results.solution import Solution, make_solution
from tests.scp_recon.support import mission_of

pytestmark = pytest.mark.slow

SAMPLES, DPI = 400, 40.0
EVIDENCE = Path(__file__).parents[2] / "docs" / "evidence"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """What experiments write, for the two rows that figures are drawn from."""
    out = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(observation_table, "SAMPLES", SAMPLES)
        for key in (PLAN, SURROGATE):
            observation_table.run_row(out, key)
    return out


@pytest.fixture(scope="module")
def runs(folder) -> Runs:
    return read_runs(folder)


def test_figures_of_the_paper_carry_their_plan(folder, runs, tmp_path, monkeypatch):
    for name, item in FIGURES.items():
        monkeypatch.setitem(FIGURES, name, item._replace(dpi=DPI))
    monkeypatch.setattr(command_line, "PICTURES", (".png",))
    assert main(["--runs", str(folder), "--out", str(tmp_path)]) == 0
    plan_hash = runs.plan.solution.plan_hash.encode()
    assert {path.stem for path in tmp_path.iterdir()} == set(FIGURES)
    assert all(plan_hash in path.read_bytes() for path in tmp_path.iterdir())


def test_a_plan_of_ones_own_is_drawn(tmp_path, monkeypatch):
    """Of five burns, two of them close to each other; the site's name would be a formula."""
    own = mission_of("burns.times_s=[0.0, 8000.0, 23200.0, 29800.0, 36400.0]")
    own = Mission.from_scenario(own.scenario.replace({"site.name": r"$\frac{$"}))
    make_solution(plan(own, initial_guess.cold(own), problem="P3")).write(tmp_path)
    monkeypatch.setattr(inputs, "FLIGHTS", SAMPLES)
    monkeypatch.setattr(flight, "PATHS", 5)
    file = tmp_path / "drawn.svg"
    assert main(["trajectories", "--runs", str(tmp_path), "--out", str(file)]) == 0
    assert read_solution(tmp_path).plan_hash in file.read_text("utf-8")


class Marked(tuple[Any, ...]):
    """A policy without corrections that is known again."""


def test_every_flight_of_a_plan_is_corrected(runs, monkeypatch):
    monkeypatch.setattr(Solution, "corrections", Marked())
    fly, corrected = Flyer.fly, list[bool]()

    def seen(flyer: Flyer, *given: Any) -> Any:
        if flyer.mission.initial_factor.any():  # else nothing errs
            corrected.append(isinstance(flyer.policy, Marked))
        return fly(flyer, *given)

    monkeypatch.setattr(Flyer, "fly", seen)
    monkeypatch.setattr(flight, "SAMPLES", 50)
    monkeypatch.setattr(inputs, "FLIGHTS", SAMPLES)
    for draw in (flight.trajectories, flight.observation_histories):
        draw(runs)
    flight.flyby(runs.plan.solution)
    inputs._fly(runs.plan.solution)
    assert len(corrected) > 3
    assert all(corrected)


@pytest.mark.parametrize("bad", [f"{PLAN}/solution.json", f"{SURROGATE}/montecarlo.json"])
def test_unusable_input_names_the_command(folder, tmp_path, bad, capsys):
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    (copy / bad).unlink()
    assert main(["control_history", "--runs", str(copy), "--out", str(tmp_path / "x")]) == 2
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert bad in errors
    assert f"{PAPER} --out {copy}" in errors
    (copy / bad).write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=bad):
        read_runs(copy)
    shutil.copy(folder / bad, copy / bad)
    shutil.copy(folder / SURROGATE / "montecarlo.json", copy / PLAN)
    with pytest.raises(InputError, match=r"flights of plan"):
        read_runs(copy)


@pytest.mark.parametrize("name", STUDIES)
def test_study_is_drawn_or_names_its_command(tmp_path, name, capsys, monkeypatch):
    study = STUDIES[name]
    monkeypatch.setitem(EVERYTHING, name, study._replace(dpi=DPI))
    words = [name, "--runs", str(tmp_path), "--out", str(tmp_path / "drawn")]
    assert main(words) == 2
    assert f"--out {tmp_path}" in capsys.readouterr().err
    evidence = name.replace("solver_comparison", "compare_solvers")
    tables = json.loads((EVIDENCE / f"{evidence}.json").read_text("utf-8"))["tables"]
    for table, own in tables.items():
        pd.DataFrame(own).to_csv(tmp_path / f"{table}.csv")
    assert main(words) == 0
    for table in tables:
        (tmp_path / f"{table}.csv").write_text("x\n1\n", encoding="utf-8")
    with pytest.raises(InputError, match="unusable"):
        study.read(tmp_path)


@pytest.mark.parametrize("name", ["file", "picture.xyz", "file/x.png"])
def test_unusable_picture_name_is_refused(tmp_path, name, monkeypatch, capsys):
    monkeypatch.setitem(EVERYTHING, "modes", Item(lambda _: Figure(), lambda _: None))
    (tmp_path / "file").touch()
    assert main(["modes", "--out", str(tmp_path / name)]) == 2
    assert capsys.readouterr().err.count("error: ") == 1
    assert [path.name for path in tmp_path.rglob("*")] == ["file"]


def test_figure_is_the_same_file_every_time(tmp_path):
    def saved(name: str, plan_hash: str | None) -> bytes:
        figure = Figure((1.0, 1.0))
        figure.subplots().plot([0.0, 1.0])
        return save(figure, tmp_path / f"{name}.PDF", DPI, plan_hash).read_bytes()

    plan_hash = "1f" * 32
    assert saved("1", plan_hash) == saved("2", plan_hash)
    assert plan_hash.encode() in saved("3", plan_hash)
    assert plan_hash.encode() not in saved("4", None)


def test_campaigns_are_drawn_with_cases_without_plan():
    sizes = [(20.0 * i, 40.0 * j) for i in range(3) for j in range(4)]
    table = pd.DataFrame(sizes, columns=[LATITUDE, LONGITUDE]).assign(
        case=range(12), status="converged", verdict="verified", **{COST: 0.1, CHANCE: 0.9}
    )
    table[studies.BURN] = table[studies.LARGEST] = table[LATITUDE] + 0.1
    table[studies.INITIAL] = table[studies.LEAST] = table[LONGITUDE] + 0.1
    table[EPOCH] = pd.date_range("2020-01-01", periods=12).astype(str)
    table.loc[8:, "status"] = "infeasible"
    results = CampaignResults(Path(), table, None, None, (LATITUDE, LONGITUDE), 12)
    drawn = studies.campaigns(dict.fromkeys(studies.CAMPAIGNS, results))
    for figure in drawn.values():
        figure.draw_without_rendering()
    assert {*drawn} == {*studies.CAMPAIGNS}
