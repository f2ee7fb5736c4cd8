"""Every figure draws in silence, is labelled with units, keeps its words apart, and is written."""

from __future__ import annotations

import errno
import itertools
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation

from experiments.harness import records
from experiments.observation_table.rows import rows
from experiments.observation_table.study import measure, record
from paper_figs import __main__ as command_line
from paper_figs import flyby, inputs
from paper_figs.__main__ import PICTURES, main, make_all
from paper_figs.drawing import save
from paper_figs.inputs import COMMAND, TABLE, Runs, read_runs
from paper_figs.paper import cone_polytopes, control_history, observation_geometry, tables
from paper_figs.paper.observation_times import rebinned
from paper_figs.registry import FIGURES, TABLES, Item
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.results.solution import make_solution
from scp_recon.scenario.load import load_scenario
from tests.scp_recon.support import mission_of

SAMPLES = 400
NEEDED = ("scp_cold", "ballistic")
PACKAGE = Path(__file__).parents[2] / "paper_figs"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What experiments write, for the two rows that figures are drawn from."""
    out = tmp_path_factory.mktemp("runs")
    needed = [row for row in rows(ipopt=False) if row.key in NEEDED]
    entries = measure(
        Mission.from_scenario(load_scenario()),
        needed,
        out,
        samples=SAMPLES,
        check=False,
        fresh=False,
        tell=lambda _: None,
    )
    table = records([record(entry) for entry in entries])
    (out / TABLE).write_text(table.csv(), encoding="utf-8")
    return out


@pytest.fixture(scope="module")
def runs(folder: Path) -> Runs:
    return read_runs(folder)


@pytest.fixture(scope="module")
def drawn(runs: Runs) -> dict[str, Figure]:
    """All figures, rendered once, so that their artists have a size."""
    figures = {name: item.make(runs) for name, item in FIGURES.items()}
    for figure in figures.values():
        FigureCanvasAgg(figure).draw()
    return figures


def caption(name: str, runs: Runs) -> str:
    make = FIGURES[name].caption
    assert make is not None
    return make(runs)


# --- as a person would look at them -------------------------------------------------------------


def visible_axes(figure: Figure) -> list[Any]:
    return [axes for axes in figure.axes if axes.axison]


@pytest.mark.parametrize("name", FIGURES)
def test_axes_have_units_in_their_labels(drawn: dict[str, Figure], name: str) -> None:
    panels = visible_axes(drawn[name])
    assert panels
    for axes in panels:
        for axis in (axes.xaxis, axes.yaxis):
            # A panel that shares its axis with the one below leaves the numbers to it.
            if axis.get_tick_params().get("labelbottom", axis.get_tick_params().get("labelleft")):
                assert axis.label.get_text().endswith(")"), (name, axis.label.get_text())
                assert "(" in axis.label.get_text()


@pytest.mark.parametrize("name", FIGURES)
def test_no_legend_leaves_the_page(drawn: dict[str, Figure], name: str) -> None:
    figure = drawn[name]
    page = figure.bbox.padded(1.0)
    on_axes = [axes.get_legend() for axes in figure.axes]
    legends = [legend for legend in (*figure.legends, *on_axes) if legend]
    assert legends or name == "control_history"
    for legend in legends:
        box = legend.get_window_extent()
        assert all(page.contains(*corner) for corner in ((box.x0, box.y0), (box.x1, box.y1)))


@pytest.mark.parametrize("name", FIGURES)
def test_no_words_leave_the_page(drawn: dict[str, Figure], name: str) -> None:
    figure = drawn[name]
    page = figure.bbox.padded(1.0)
    for axes in figure.axes:
        for text in [*axes.texts, axes.title, axes.xaxis.label, axes.yaxis.label]:
            if text.get_text() and text.get_visible() and (axes.axison or text in axes.texts):
                box = text.get_window_extent()
                corners = ((box.x0, box.y0), (box.x1, box.y1))
                assert all(page.contains(*corner) for corner in corners), text.get_text()


@pytest.mark.parametrize("name", FIGURES)
def test_no_words_lie_on_others(drawn: dict[str, Figure], name: str) -> None:
    for axes in drawn[name].axes:
        texts = [text for text in axes.texts if text.get_text()]
        for one, other in itertools.combinations(texts, 2):
            boxes = [
                # Of an annotation the words alone, not its arrow.
                super(Annotation, text).get_window_extent()
                if isinstance(text, Annotation)
                else text.get_window_extent()
                for text in (one, other)
            ]
            assert not boxes[0].overlaps(boxes[1]), (one.get_text(), other.get_text())


def test_letters_are_large_enough_to_read(drawn: dict[str, Figure]) -> None:
    for figure in drawn.values():
        assert figure.get_figwidth() <= 7.0
        for axes in figure.axes:
            assert all(text.get_fontsize() >= 8.0 for text in axes.texts)


def test_no_figure_touches_a_backend() -> None:
    for path in PACKAGE.glob("*.py"):
        assert "pyplot" not in path.read_text("utf-8"), path


# --- what they say ------------------------------------------------------------------------------


def test_captions_explain_the_bands_and_carry_the_numbers(runs: Runs) -> None:
    for name in ("trajectories", "observation_histories"):
        words = caption(name, runs)
        assert "68.3 %" in words
        assert "95.4 %" in words
    assert "23.3 deg" in control_history.caption(runs)
    assert f"{SAMPLES} flights" in caption("observation_times", runs)


def test_parameters_are_those_of_the_scenario(runs: Runs) -> None:
    text = TABLES["parameters"].make(runs)
    # The paper's table, and what the project computes for it.
    for value in (
        "500 m, 740 m",
        "20 deg, 45 deg",
        "[0.0702, -1.0963, 0.4064] km",
        "23.3 deg, 18.2 deg",
        "3397.3 s",
        "[-0.9992, 0.0323, 0.0225]",
        "70 %",
    ):
        assert value in text


def test_coarser_bins_keep_every_flight(runs: Runs) -> None:
    first, last = runs.plan.mission.schedule.window_s
    edges = np.linspace(0.0, last - first, 8)
    for name in ("emission", "site_distance"):
        counts = rebinned(runs.plan.summary, name, edges)
        assert counts.sum() == SAMPLES
        throughout = runs.plan.summary.held_s[name].throughout.estimate
        assert counts[-1] >= throughout.value * SAMPLES - 0.5


def test_drawn_pyramids_enclose_the_cone_or_are_enclosed(runs: Runs) -> None:
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


def test_sight_at_mid_window_keeps_the_angles(runs: Runs) -> None:
    seen = observation_geometry.sight(runs.plan.mission, runs.plan.solution.burns_m_s, 14_838.8)
    assert 90.0 - seen.craft_at == pytest.approx(seen.emission)
    # Spherical law of cosines between the projected Sun and the exact angles.
    elevation = np.deg2rad(seen.sun_off_plane)
    for azimuth, exact in ((90.0, seen.incidence), (seen.craft_at, seen.phase)):
        drawn_angle = np.deg2rad(seen.sun_at - azimuth)
        cosine = np.cos(elevation) * np.cos(drawn_angle)
        assert np.rad2deg(np.arccos(cosine)) == pytest.approx(exact)


def test_the_table_shows_failed_rows_as_such(runs: Runs) -> None:
    lost = dict.fromkeys(runs.table[0], "") | {
        "label": "lost",
        "status": "failed: no",
        "paper_mean_s": "1",
        "paper_worst_1_sigma_s": "2",
    }
    text = tables.observation_table(Runs(runs.plan, runs.reference, [*runs.table, lost]))
    assert "| lost | failed: no |  |  |  | 1 | 2 |" in text
    assert "| SCP, cold start | 3397 | 3397 | " in text


# --- files --------------------------------------------------------------------------------------


def ready(figures: dict[str, Figure]) -> dict[str, Item]:
    """Figures that are drawn already."""
    return {
        name: replace(item, make=lambda _, name=name: figures[name])
        for name, item in FIGURES.items()
    }


def draw_one(name: str, runs: Path, out: Path, *more: str) -> int:
    return main([name, "--runs", str(runs), "--out", str(out), *more])


def test_everything_is_written_into_one_folder(
    folder: Path,
    runs: Runs,
    tmp_path: Path,
    drawn: dict[str, Figure],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(command_line, "FIGURES", ready(drawn))
    written = list(make_all(runs, folder, tmp_path / "figures"))
    expected = {f"{name}{ending}" for name in FIGURES for ending in PICTURES}
    expected |= {f"{name}.md" for name in TABLES} | {TABLE, "captions.md"}
    assert {path.name for path in written} == expected
    assert {path.name for path in (tmp_path / "figures").iterdir()} == expected
    assert all(path.stat().st_size > 200 for path in written)
    plan = runs.plan.solution.plan_hash.encode()
    assert all(plan in path.read_bytes() for path in written if path.suffix in PICTURES)
    captions = (tmp_path / "figures" / "captions.md").read_text("utf-8")
    assert all(f"## {name}\n" in captions for name in FIGURES)


@pytest.mark.parametrize("ending", [".pdf", ".png", ".svg"])
def test_a_figure_alone_writes_the_same_file_every_time(
    folder: Path, tmp_path: Path, ending: str
) -> None:
    files = [tmp_path / f"{number}{ending}" for number in range(2)]
    for file in files:
        assert draw_one("control_history", folder, file) == 0
    assert files[0].read_bytes() == files[1].read_bytes()


def test_a_table_alone_is_written_as_text(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "table.md"
    assert draw_one("observation_table", folder, file) == 0
    assert file.read_text("utf-8").startswith("# Observation times")


@pytest.mark.parametrize(
    "missing",
    [TABLE, *(f"{row}/{name}.json" for row in NEEDED for name in ("solution", "montecarlo"))],
)
def test_missing_input_exits_with_two_and_names_the_command(
    folder: Path, tmp_path: Path, missing: str, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    (copy / missing).unlink()
    out = tmp_path / "figures"
    assert main(["--runs", str(copy), "--out", str(out)]) == 2
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert missing in errors
    assert f"{COMMAND} --out {copy}" in errors
    assert not out.exists()
    assert draw_one("control_history", copy, tmp_path / "x.png") == 2


@pytest.mark.parametrize("damaged", [TABLE, "scp_cold/montecarlo.json"])
def test_damaged_input_says_how_to_write_it_anew(
    folder: Path, tmp_path: Path, damaged: str
) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    (copy / damaged).write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=f"{COMMAND} --fresh"):
        read_runs(copy)


@pytest.mark.parametrize("age", ["of another plan", "older"])
def test_flights_of_another_plan_are_refused(
    folder: Path, tmp_path: Path, age: str, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    file = copy / "scp_cold" / "montecarlo.json"
    if age == "older":
        data = json.loads(file.read_text("utf-8"))
        del data["plan_hash"]
        file.write_text(json.dumps(data), "utf-8")
    else:
        shutil.copy(copy / "ballistic" / "montecarlo.json", file)
    assert main(["--runs", str(copy), "--out", str(tmp_path / "figures")]) == 2
    errors = capsys.readouterr().err
    assert errors.count("error: ") == 1
    for words in (str(file), str(file.with_name("solution.json")), f"{COMMAND} --out {copy}`"):
        assert words in errors
    assert ("an unknown plan" in errors) == (age == "older")
    assert not (tmp_path / "figures").exists()


def test_a_bad_command_line_is_a_document(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["--no-such-option", "--json"])
    assert end.value.code == 2
    assert json.loads(capsys.readouterr().out)["command"] == "paper_figs"
    assert main(["no_such_figure", "--json"]) == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["given"] == "'no_such_figure'"
    assert "solver_comparison" in error["allowed"]


def test_the_files_of_a_figure_are_in_its_document(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(tmp_path / "x.png")
    assert draw_one("control_history", folder, Path(file), "--json") == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert (document["command"], document["files"]) == ("paper_figs", [file])
    assert said.err == f"written: {file}\n"
    assert main(["frames", "--out", file, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("ending", [".pdf", ".png", ".svg"])
def test_a_figure_names_its_plan_in_its_metadata(
    folder: Path, runs: Runs, tmp_path: Path, ending: str
) -> None:
    plan = runs.plan.solution.plan_hash.encode()
    file = tmp_path / f"x{ending}"
    assert draw_one("control_history", folder, file) == 0
    assert plan in file.read_bytes()
    assert draw_one("flyby", folder / "scp_cold", file) == 0
    assert plan in file.read_bytes()
    assert plan not in save(Figure(), file).read_bytes()


@pytest.mark.parametrize("ending", ["PDF", "eps", "jpg", "tif"])
def test_other_formats_are_written_without_the_plan(tmp_path: Path, ending: str) -> None:
    assert save(Figure(), tmp_path / f"x.{ending}", plan_hash="0" * 64).stat().st_size > 200


def test_a_folder_that_cannot_be_written_exits_with_two(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert main(["--runs", str(folder), "--out", str(tmp_path / "file")]) == 2
    assert "must be a folder to write to" in capsys.readouterr().err


# --- the flyby at a glance ----------------------------------------------------------------------


def test_the_flyby_is_drawn_to_the_file_named_and_says_so(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a site whose name would be a formula, and a wrong one."""
    text = (folder / "scp_cold" / "solution.json").read_text("utf-8")
    (tmp_path / "solution.json").write_text(text.replace("Nightingale", r"$\\frac{$"), "utf-8")
    picture = tmp_path / "flyby.png"
    assert draw_one("flyby", tmp_path, picture) == 0
    assert capsys.readouterr().out == f"written: {picture}\n"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_figures_that_are_named_go_to_a_folder_or_a_single_one_to_a_file(
    folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "folder.png").mkdir()
    names = ["frames", "control_history"]
    assert main([*names, "--runs", str(folder), "--out", str(tmp_path / "some")]) == 0
    expected = {f"{name}{ending}" for name in names for ending in PICTURES}
    assert {path.name for path in (tmp_path / "some").iterdir()} == expected
    assert main(["frames", "--out", str(tmp_path / "folder.png")]) == 0
    assert len(list((tmp_path / "folder.png").iterdir())) == len(PICTURES)


@pytest.mark.parametrize("name", ["file", "picture.xyz", "file/x.png"])
def test_what_is_no_pictures_name_is_refused_and_nothing_is_written(
    folder: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    before = sorted(tmp_path.rglob("*"))
    assert draw_one("flyby", folder / "scp_cold", tmp_path / name) == 2
    assert capsys.readouterr().err.count("error: ") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_a_figure_on_a_full_disk_leaves_the_old_one(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture = tmp_path / "x.png"
    picture.write_text("old", "utf-8")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    assert draw_one("control_history", folder, picture) == 2
    assert [file.name for file in tmp_path.iterdir()] == ["x.png"]
    assert picture.read_text("utf-8") == "old"


# --- of any plan --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def five_burns(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plan of one's own: five burns, two of them close to each other, and no flights beside it."""
    own = mission_of("burns.times_s=[0.0, 8000.0, 23200.0, 29800.0, 36400.0]")
    found = plan(own, initial_guess.cold(own), problem="P3")
    folder = tmp_path_factory.mktemp("own")
    make_solution(found).write(folder)
    return folder


@pytest.fixture(scope="module")
def own_runs(five_burns: Path) -> Runs:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inputs, "FLIGHTS", SAMPLES)
        return read_runs(five_burns)


@pytest.fixture(scope="module")
def own_drawn(own_runs: Runs) -> dict[str, Figure]:
    figures = {name: item.make(own_runs) for name, item in FIGURES.items()}
    figures["flyby"] = flyby.draw(own_runs.plan.solution)
    for figure in figures.values():
        FigureCanvasAgg(figure).draw()
    return figures


@pytest.mark.parametrize("name", [*FIGURES, "flyby"])
def test_words_keep_apart_in_figures_of_five_burns(own_drawn: dict[str, Figure], name: str) -> None:
    test_no_words_lie_on_others(own_drawn, name)
    test_no_words_leave_the_page(own_drawn, name)
    words = {text.get_text() for axes in own_drawn[name].axes for text in axes.texts}
    if name == "trajectories":
        assert words >= set("12345")
    if name == "flyby":
        assert {word[:2] for word in words} >= {f"{number}:" for number in range(1, 6)}


def test_figures_of_one_s_own_plan_are_written_without_the_paper_s_table(
    own_runs: Runs,
    own_drawn: dict[str, Figure],
    five_burns: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(command_line, "FIGURES", ready(own_drawn))
    monkeypatch.setattr(command_line, "PICTURES", PICTURES[:1])
    written = {path.name for path in make_all(own_runs, five_burns, tmp_path)}
    assert written == {
        *("parameters.md", "captions.md"),
        *(f"{name}{PICTURES[0]}" for name in FIGURES),
    }
    assert "ballistic arc" in caption("trajectories", own_runs)
    assert own_runs.plan.summary.is_of(own_runs.plan.solution)
