"""Every figure of the paper is drawn once, in silence, and written; and what they say is true."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from experiments.harness import records
from experiments.observation_rows import rows
from experiments.observation_table import measure
from paper_figs import __main__ as command_line
from paper_figs import flyby, inputs
from paper_figs.__main__ import PICTURES, main, make_all, plan_hash_of
from paper_figs.drawing import save
from paper_figs.inputs import COMMAND, PLAN, SURROGATE, TABLE, Runs, read_runs
from paper_figs.paper import (
    cone_polytopes,
    observation_geometry,
    observation_histories,
    trajectories,
)
from paper_figs.registry import EVERYTHING, FIGURES, TABLES, Item
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo import sampling
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.results.policy import Policy
from scp_recon.results.solution import Solution, make_solution
from tests.scp_recon.support import mission_of

SAMPLES = 400
DPI = 40.0
"""Of pictures that nobody looks at."""
QUICK = Item(lambda _: Figure(), read=lambda _: None)
"""In the place of a figure where only the command line matters."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """What experiments write, for the two rows that figures are drawn from."""
    out = tmp_path_factory.mktemp("runs")
    needed = [row for row in rows(ipopt=False) if row.key in (PLAN, SURROGATE)]
    table = records([measure(out, SAMPLES, False, row) for row in needed])
    (out / TABLE).write_text(table.csv(), encoding="utf-8")
    return out


@pytest.fixture(scope="module")
def runs(folder) -> Runs:
    return read_runs(folder)


@pytest.fixture
def copy(folder, tmp_path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def light(names: Any = FIGURES) -> dict[str, Item]:
    return {name: replace(FIGURES[name], dpi=DPI) for name in names}


def test_everything_is_drawn_and_written_into_one_folder(folder, runs, tmp_path, monkeypatch):
    monkeypatch.setattr(command_line, "FIGURES", light())
    monkeypatch.setattr(command_line, "PICTURES", PICTURES[:1])
    written = list(make_all(runs, folder, tmp_path / "figures"))
    expected = {f"{name}{PICTURES[0]}" for name in FIGURES}
    expected |= {f"{name}.md" for name in TABLES} | {TABLE, "captions.md"}
    assert {path.name for path in written} == expected
    assert {path.name for path in (tmp_path / "figures").iterdir()} == expected
    plan = runs.plan.solution.plan_hash.encode()
    assert all(plan in path.read_bytes() for path in written if path.suffix in PICTURES)
    captions = (tmp_path / "figures" / "captions.md").read_text("utf-8")
    assert all(f"## {name}\n" in captions for name in FIGURES)
    for words in ("68.3 %", "95.4 %", "23.3 deg", f"{SAMPLES} flights"):
        assert words in captions


def test_a_plan_of_one_s_own_is_drawn_without_the_paper_s_table(tmp_path, monkeypatch):
    """Of five burns, two of them close to each other, without flights beside it."""
    own = mission_of("burns.times_s=[0.0, 8000.0, 23200.0, 29800.0, 36400.0]")
    make_solution(plan(own, initial_guess.cold(own), problem="P3")).write(tmp_path)
    monkeypatch.setattr(inputs, "FLIGHTS", SAMPLES)
    own_runs = read_runs(tmp_path)
    monkeypatch.setattr(command_line, "FIGURES", light(["trajectories"]))
    monkeypatch.setattr(command_line, "PICTURES", PICTURES[:1])
    written = {path.name for path in make_all(own_runs, tmp_path, tmp_path / "out")}
    assert written == {"parameters.md", "captions.md", f"trajectories{PICTURES[0]}"}
    assert "ballistic arc" in (tmp_path / "out" / "captions.md").read_text("utf-8")
    assert own_runs.plan.summary.is_of(own_runs.plan.solution)


class Told(tuple[Any, ...]):
    """A policy without corrections that is known again."""


def test_whatever_flies_a_plan_corrects_its_burns(runs, monkeypatch):
    monkeypatch.setattr(Solution, "corrections", Told())
    fly, told = sampling.fly_draws, list[bool]()

    def seen(mission: Mission, *args: Any, policy: Policy = (), **how: Any) -> Any:
        if mission.initial_factor.any():  # else nothing errs
            told.append(isinstance(policy, Told))
        return fly(mission, *args, policy=policy, **how)

    monkeypatch.setattr(sampling, "fly_draws", seen)
    monkeypatch.setattr(inputs, "FLIGHTS", SAMPLES)
    for draw in (trajectories.paths, observation_histories.draw):
        draw(runs)
    flyby.draw(runs.plan.solution)
    inputs._fly(runs.plan.mission, runs.plan.solution)
    assert len(told) > 3
    assert all(told)


def test_drawn_pyramids_enclose_the_cone_or_are_enclosed(runs):
    cut = cone_polytopes.section(runs.plan)
    angle_deg = 45.0
    radius = cut.height_m * np.tan(np.deg2rad(angle_deg))
    for facets in (4, 12):
        inside, outside = (
            cone_polytopes.polygon(cone_polytopes.pyramid(cut, angle_deg, facets, keep), cut)
            for keep in ("in", "out")
        )
        np.testing.assert_allclose(np.linalg.norm(inside, axis=1), radius)
        middles = 0.5 * (outside + np.roll(outside, 1, axis=0))
        np.testing.assert_allclose(np.linalg.norm(middles, axis=1), radius)
        # An edge of the inner one and a facet of the outer one face the spacecraft.
        assert np.abs(inside - [radius, 0.0]).max(axis=1).min() < 1e-6 * radius
        assert np.abs(middles - [radius, 0.0]).max(axis=1).min() < 1e-6 * radius


def test_sight_at_mid_window_keeps_the_angles(runs):
    seen = observation_geometry.sight(runs.plan.mission, runs.plan.solution.burns_m_s, 14_838.8)
    assert 90.0 - seen.craft_at == pytest.approx(seen.emission)
    # Spherical law of cosines between the projected Sun and the exact angles.
    elevation = np.deg2rad(seen.sun_off_plane)
    for azimuth, exact in ((90.0, seen.incidence), (seen.craft_at, seen.phase)):
        drawn_angle = np.deg2rad(seen.sun_at - azimuth)
        cosine = np.cos(elevation) * np.cos(drawn_angle)
        assert np.rad2deg(np.arccos(cosine)) == pytest.approx(exact)


@pytest.mark.parametrize(
    "missing",
    [
        TABLE,
        *(f"{row}/{name}.json" for row in (PLAN, SURROGATE) for name in ("solution", "montecarlo")),
    ],
)
def test_missing_input_exits_with_two_and_names_the_command(copy, tmp_path, missing, capsys):
    (copy / missing).unlink()
    for names in ([], ["control_history"]):
        assert main([*names, "--runs", str(copy), "--out", str(tmp_path / "figures")]) == 2
        errors = capsys.readouterr().err
        assert errors.count("\n") == 1
        assert missing in errors
        assert f"{COMMAND} --out {copy}" in errors
    assert not list((tmp_path / "figures").glob("*"))


@pytest.mark.parametrize("damaged", [TABLE, "scp_cold/montecarlo.json"])
def test_damaged_input_says_how_to_write_it_anew(copy, damaged):
    (copy / damaged).write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=f"{COMMAND} --fresh"):
        read_runs(copy)


@pytest.mark.parametrize("age", ["of another plan", "older"])
def test_flights_of_another_plan_are_refused(copy, age):
    file = copy / PLAN / "montecarlo.json"
    if age == "older":
        data = json.loads(file.read_text("utf-8"))
        del data["plan_hash"]
        file.write_text(json.dumps(data), "utf-8")
    else:
        shutil.copy(copy / SURROGATE / "montecarlo.json", file)
    with pytest.raises(InputError) as caught:
        read_runs(copy)
    for words in (str(file), str(file.with_name("solution.json")), f"{COMMAND} --out {copy}`"):
        assert words in str(caught.value)
    assert ("an unknown plan" in str(caught.value)) == (age == "older")


def test_the_flyby_is_drawn_and_names_its_plan(folder, tmp_path, capsys):
    """Of a site whose name would be a formula, and a wrong one."""
    text = (folder / PLAN / "solution.json").read_text("utf-8")
    (tmp_path / "solution.json").write_text(text.replace("Nightingale", r"$\\frac{$"), "utf-8")
    picture = tmp_path / "flyby.png"
    assert main(["flyby", "--runs", str(tmp_path), "--out", str(picture)]) == 0
    assert capsys.readouterr().out == f"written: {picture}\n"
    assert EVERYTHING["flyby"].read(tmp_path).plan_hash.encode() in picture.read_bytes()


def test_figures_that_are_named_go_to_a_folder_or_a_single_one_to_a_file(
    folder, tmp_path, monkeypatch, capsys
):
    (tmp_path / "folder.png").mkdir()
    names = ["frames", "control_history"]
    for name in names:
        monkeypatch.setitem(EVERYTHING, name, QUICK)
    assert main([*names, "--out", str(tmp_path / "some"), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    expected = {f"{name}.png" for name in names}
    assert {path.name for path in (tmp_path / "some").iterdir()} == expected
    assert main(["frames", "--out", str(tmp_path / "folder.png")]) == 0
    assert [path.name for path in (tmp_path / "folder.png").iterdir()] == ["frames.png"]
    assert main(["observation_table", "--runs", str(folder), "--out", str(tmp_path / "x.md")]) == 0
    assert (tmp_path / "x.md").is_file()


def test_one_target_draws_the_concepts_of_the_pages():
    root = Path(__file__).parents[2]
    made = re.search(r"^drawings:.*\n\tfor name in (.*);", (root / "Makefile").read_text(), re.M)
    assert made is not None
    for name in made[1].split():
        assert EVERYTHING[name].make(EVERYTHING[name].read(root)).axes
        assert any(f"({name}.png)" in page.read_text() for page in (root / "docs").glob("*.md"))


@pytest.mark.parametrize("name", ["file", "picture.xyz", "file/x.png"])
def test_what_is_no_pictures_name_is_refused_and_nothing_is_written(
    tmp_path, name, monkeypatch, capsys
):
    monkeypatch.setitem(EVERYTHING, "frames", QUICK)
    (tmp_path / "file").touch()
    before = sorted(tmp_path.rglob("*"))
    assert main(["frames", "--out", str(tmp_path / name)]) == 2
    assert capsys.readouterr().err.count("error: ") == 1
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("ending", [".PDF", ".eps"])
def test_a_figure_is_the_same_file_every_time_and_names_its_plan_where_it_can(
    runs, tmp_path, ending
):
    def saved(name: str, plan: str | None) -> bytes:
        figure = Figure((1.0, 1.0))  # a figure that is drawn once more need not be the same
        figure.subplots().plot([0.0, 1.0])
        return save(figure, tmp_path / f"{name}{ending}", DPI, plan).read_bytes()

    plan = plan_hash_of(runs)
    one, other = saved("1", plan), saved("2", plan)
    assert (plan.encode() in one) == (ending.lower() in (".pdf", ".png", ".svg"))
    assert one == other or ending == ".eps"
    assert plan.encode() not in saved("3", None)
