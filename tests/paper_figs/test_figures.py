"""Every figure is drawn once and in silence; missing, damaged and foreign input is refused."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from experiments.harness import records
from experiments.observation_rows import rows
from experiments.observation_table import measure
from paper_figs import __main__ as command_line
from paper_figs import campaigns, flight, inputs, observation
from paper_figs.__main__ import EVERYTHING, FIGURES, STUDIES, Item, main
from paper_figs.drawing import save
from paper_figs.inputs import PAPER, PLAN, SURROGATE, Runs, read_runs, run_missing
from paper_figs.spacecraft import SHOWN
from scp_recon.campaigns.axes import EPOCH, LATITUDE, LONGITUDE
from scp_recon.campaigns.outcome import CHANCE, COST, CampaignResults
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo import sampling
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.results.policy import Policy
from scp_recon.results.read import read_solution
from scp_recon.results.solution import Solution, make_solution
from scp_recon.simulation.record import Record, write_record
from tests.scp_recon.simulation import made_up
from tests.scp_recon.support import mission_of

pytestmark = pytest.mark.slow

SAMPLES, DPI = 400, 40.0
NO_PLAN = "1f" * 32
"""Hash of no plan."""
FLIGHTS = ("attitude_and_actuators", "power_history", "flown_plan")
QUICK = Item(lambda _: Figure(), read=lambda _: None)
"""In the place of a figure where only the command line matters."""
EVIDENCE = Path(__file__).parents[2] / "docs" / "evidence"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """What experiments write, for the two rows that figures are drawn from."""
    out = tmp_path_factory.mktemp("runs")
    needed = [row for row in rows(ipopt=False) if row.key in (PLAN, SURROGATE)]
    for row in needed:
        measure(out, SAMPLES, False, row)
    return out


@pytest.fixture(scope="module")
def runs(folder) -> Runs:
    return read_runs(folder)


@pytest.fixture
def copy(folder, tmp_path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def write_flight(folder: Path, seed: int = 4, plan_hash: str | None = NO_PLAN) -> None:
    """A made-up flight of two hours."""
    t = np.arange(0.0, 7200.0, 10.0)
    arrays = made_up.arrays(samples=len(t), seconds=7200, nodes=50) | {
        "t_s": t,
        "attitude": np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1)),
        "mode": (t // 1800 % 3).astype(np.int8),
        "actuators": (1 + t // 1800 % 3).astype(np.int8),
        "panel_peak_w": np.array([11.4, 27.0, 27.0, 143.8, 143.8]),
        "node_sigma_distance": np.linspace(0.0, seed, 50),
        "pointing_error_rad": np.full(7200, 1e-3),
    }
    (burn,) = made_up.entries()["burns"]
    burns = [burn, burn | {"t_s": 3600.0}]
    summary = made_up.summary(seed=seed, plan_hash=plan_hash, burns=burns)
    folder.mkdir(parents=True)
    write_record(Record(arrays, summary), folder)


MADE_UP = {
    "battery_cones_samples": pd.DataFrame(
        np.random.default_rng(0).uniform(-0.5, 0.5, (50, 4)), columns=["x", "y", "z", "power_w"]
    ).abs(),
    "model_fidelity_history": pd.DataFrame(
        {"flight": "plan", "model": "J2", "t_s": [0.0, 9e3], "distance_m": [0.1, 1.0]}
    ),
    "uncertainty_quantiles": pd.DataFrame(
        [(source, axis, x, 1.1 * x) for source in SHOWN for axis in "xyz" for x in (-2.0, 2.0)],
        columns=["source", "axis", "expected", "observed"],
    ),
}
"""Tables that are too long for evidence."""


@pytest.fixture(scope="module")
def studies(tmp_path_factory) -> Path:
    """The studies' tables as they were measured, and made-up flights."""
    out = tmp_path_factory.mktemp("studies")
    for source in {item.source.folder: item.source for item in STUDIES.values()}.values():
        if source.folder in ("simulation", "flown_plan"):
            continue
        place = out / source.folder
        place.mkdir()
        tables = json.loads((EVIDENCE / f"{source.folder}.json").read_text("utf-8"))["tables"]
        for name in (*source.tables, "uncertainty_quantiles.csv"):
            stem = Path(name).stem
            if stem in MADE_UP:
                MADE_UP[stem].to_csv(place / name)
            else:
                text = records(tables[stem]).csv()
                (place / name).write_text(text, encoding="utf-8")
    write_flight(out / "simulation")
    for seed in (1, 2):
        write_flight(out / "flown_plan" / f"seed_{seed}", seed)
    (out / "flown_plan" / "flown_plan.csv").write_text("seed\n1\n2\n", encoding="utf-8")
    return out


def test_everything_is_written_into_one_folder(folder, runs, studies, tmp_path, monkeypatch):
    for name, item in FIGURES.items():
        monkeypatch.setitem(FIGURES, name, replace(item, dpi=DPI))
    monkeypatch.setattr(command_line, "PICTURES", (".png",))
    shutil.copytree(studies / "frontier", tmp_path / "frontier")
    out, expected = tmp_path / "figures", {f"{name}.png" for name in (*FIGURES, "frontier")}
    assert main(["--runs", str(folder), "--studies", str(tmp_path), "--out", str(out)]) == 0
    assert {path.name for path in out.iterdir()} == expected
    plan_hash = runs.plan.solution.plan_hash.encode()
    assert all(plan_hash in (out / f"{name}.png").read_bytes() for name in FIGURES)


def test_a_plan_of_ones_own_is_drawn(tmp_path, monkeypatch):
    """Of five burns, two of them close to each other; the site's name would be a formula."""
    own = mission_of("burns.times_s=[0.0, 8000.0, 23200.0, 29800.0, 36400.0]")
    own = Mission.from_scenario(own.scenario.replace({"site.name": r"$\frac{$"}))
    make_solution(plan(own, initial_guess.cold(own), problem="P3")).write(tmp_path)
    monkeypatch.setattr(inputs, "FLIGHTS", SAMPLES)
    for name in ("trajectories", "flyby"):
        monkeypatch.setitem(EVERYTHING, name, replace(EVERYTHING[name], dpi=DPI))
        file = tmp_path / f"{name}.svg"
        assert main([name, "--runs", str(tmp_path), "--out", str(file)]) == 0
        assert read_solution(tmp_path).plan_hash in file.read_text("utf-8")


class Marked(tuple[Any, ...]):
    """A policy without corrections that is known again."""


def test_every_flight_of_a_plan_is_corrected(runs, monkeypatch):
    monkeypatch.setattr(Solution, "corrections", Marked())
    fly, corrected = sampling.fly_draws, list[bool]()

    def seen(mission: Mission, *args: Any, policy: Policy = (), **how: Any) -> Any:
        if mission.initial_factor.any():  # else nothing errs
            corrected.append(isinstance(policy, Marked))
        return fly(mission, *args, policy=policy, **how)

    monkeypatch.setattr(sampling, "fly_draws", seen)
    monkeypatch.setattr(inputs, "FLIGHTS", SAMPLES)
    for draw in (flight.trajectories, observation.observation_histories):
        draw(runs)
    flight.flyby(runs.plan.solution)
    inputs._fly(runs.plan.solution)
    assert len(corrected) > 3
    assert all(corrected)


@pytest.mark.parametrize("missing", [f"{PLAN}/solution.json", f"{SURROGATE}/montecarlo.json"])
def test_missing_input_names_the_command(copy, tmp_path, missing, capsys):
    (copy / missing).unlink()
    for names in ([], ["control_history"]):
        assert main([*names, "--runs", str(copy), "--out", str(tmp_path / "figures")]) == 2
        errors = capsys.readouterr().err
        assert errors.count("\n") == 1
        assert missing in errors
        assert f"{PAPER.command} --out {copy}" in errors
    assert not list((tmp_path / "figures").glob("*"))
    (copy / missing).write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=missing):
        read_runs(copy)


def test_flights_of_another_plan_are_refused(copy):
    file = copy / PLAN / "montecarlo.json"
    data = json.loads((copy / SURROGATE / "montecarlo.json").read_text("utf-8"))
    file.write_text(json.dumps(data), "utf-8")
    simulated, many = copy / "simulation", copy / "flown_plan"
    write_flight(simulated, plan_hash=NO_PLAN)
    write_flight(many / "seed_4", plan_hash=NO_PLAN)
    write_flight(many / "seed_5", plan_hash="2e" * 32)
    (many / "flown_plan.csv").write_text("seed\n4\n5\n", encoding="utf-8")
    with pytest.raises(InputError, match="different plans"):
        inputs.read_flights(many)
    for place in (simulated, many):
        shutil.copy(copy / PLAN / "solution.json", place)
    for read, place in (
        (read_runs, copy),
        (inputs.read_flight, simulated),
        (inputs.read_flights, many),
    ):
        with pytest.raises(InputError, match=f"solution.json.*--out {place}"):
            read(place)


@pytest.mark.parametrize("name", STUDIES)
def test_study_is_drawn_or_names_its_command(studies, tmp_path, name, capsys, monkeypatch):
    study, file = STUDIES[name], tmp_path / "figure.png"
    monkeypatch.setitem(EVERYTHING, name, replace(study, dpi=DPI))
    assert main([name, "--studies", str(studies), "--out", str(file)]) == 0
    assert (NO_PLAN.encode() in file.read_bytes()) == (name in FLIGHTS)
    assert main([name, "--runs", str(tmp_path), "--out", str(file)]) == 2
    assert f"{study.source.command} --out {tmp_path}" in capsys.readouterr().err
    damaged = Path(shutil.copytree(studies / study.source.folder, tmp_path / "copy"))
    for path in filter(Path.is_file, damaged.rglob("*")):
        path.write_text("x\n1\n", encoding="utf-8")
    with pytest.raises(InputError, match="unusable"):
        study.found(damaged)


def test_named_figures_go_to_one_folder(tmp_path, monkeypatch):
    monkeypatch.setitem(EVERYTHING, "control_history", QUICK)
    assert main(["modes", "control_history", "--out", str(tmp_path / "some")]) == 0
    names = {path.name for path in (tmp_path / "some").iterdir()}
    assert names == {"modes.png", "control_history.png"}


@pytest.mark.parametrize("name", ["file", "picture.xyz", "file/x.png"])
def test_unusable_picture_name_is_refused(tmp_path, name, monkeypatch, capsys):
    monkeypatch.setitem(EVERYTHING, "modes", QUICK)
    (tmp_path / "file").touch()
    assert main(["modes", "--out", str(tmp_path / name)]) == 2
    assert capsys.readouterr().err.count("error: ") == 1
    assert [path.name for path in tmp_path.rglob("*")] == ["file"]


def test_missing_studies_run_once(tmp_path):
    (tmp_path / "frontier").mkdir()
    ran, said = list[list[str]](), list[str]()

    def run(words: list[str]) -> int:
        ran.append(words)
        return 2 if "simulate" in words else 0

    paper, wanted = tmp_path / "paper", [item.source for item in STUDIES.values()]
    run_missing(paper, tmp_path, wanted, said.append, run)
    assert ran[0] == [sys.executable, *PAPER.command.split()[1:], "--out", str(paper)]
    folders = {source.folder for source in wanted} - {"frontier"}
    assert sorted(words[-1] for words in ran[1:]) == sorted(str(tmp_path / f) for f in folders)
    assert all("SOLUTION" not in words for words in ran)
    assert next(words for words in ran if "simulate" in words)[4] == str(paper / PLAN)
    assert said.count("exit status 2: left out") == 1


def test_figure_is_the_same_file_every_time(tmp_path):
    def saved(name: str, plan_hash: str | None) -> bytes:
        figure = Figure((1.0, 1.0))
        figure.subplots().plot([0.0, 1.0])
        return save(figure, tmp_path / f"{name}.PDF", DPI, plan_hash).read_bytes()

    one, other = saved("1", NO_PLAN), saved("2", NO_PLAN)
    assert one == other
    assert NO_PLAN.encode() in one
    assert NO_PLAN.encode() not in saved("3", None)


def test_campaigns_are_drawn_with_cases_without_plan():
    sizes = [(20.0 * i, 40.0 * j) for i in range(3) for j in range(4)]
    table = pd.DataFrame(sizes, columns=[LATITUDE, LONGITUDE]).assign(
        case=range(12), status="converged", verdict="verified", **{COST: 0.1, CHANCE: 0.9}
    )
    table[campaigns.BURN] = table[campaigns.LARGEST] = table[LATITUDE] + 0.1
    table[campaigns.INITIAL] = table[campaigns.LEAST] = table[LONGITUDE] + 0.1
    table[EPOCH] = pd.date_range("2020-01-01", periods=12).astype(str)
    table.loc[8:, "status"] = "infeasible"
    results = CampaignResults(Path(), table, None, None, (LATITUDE, LONGITUDE), 12)
    drawn = campaigns.campaigns(dict.fromkeys(campaigns.CAMPAIGNS, results))
    for figure in drawn.values():
        figure.draw_without_rendering()
    assert {*drawn} == {*campaigns.CAMPAIGNS}
