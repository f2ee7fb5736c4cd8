"""The page without a browser: it stands alone, and says what the solution file says."""

from __future__ import annotations

import base64
import json
import re
import shlex
from dataclasses import replace
from datetime import timedelta
from decimal import Decimal
from functools import partial
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plotly.offline import get_plotlyjs

from scp_recon.cli.commands import report, solve
from scp_recon.errors import InputError
from scp_recon.reports import flights
from scp_recon.reports.flights import fly
from scp_recon.reports.ground import Camera
from scp_recon.reports.marks import DASHES, PLANS, compact, packed, script, significant
from scp_recon.reports.page import Page, _surplus, plotly_script, render, verdict_of
from scp_recon.reports.scene import PATHS
from scp_recon.reports.subject import PLANS_MAX, Subject, subjects_of
from scp_recon.reports.write import page_of
from scp_recon.results.solution import Solution
from scp_recon.results.table import Table
from scp_recon.scenario.load import load_scenario

from .conftest import MADE

BYTES_MAX = 8_000_000


@pytest.fixture
def few_flights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the numbers do not matter."""
    monkeypatch.setattr(flights, "fly", partial(fly, samples=200))


@pytest.fixture(scope="module")
def html(html_file: Path) -> str:
    return html_file.read_text("utf-8")


def words_of(html: str) -> str:
    """What a reader sees of a page, in one line."""
    bare = re.sub(r"<(style|script)\b.*?</\1>|<[^>]*>", " ", html, flags=re.DOTALL)
    return " ".join(unescape(bare).split())


def numbers(table: Table) -> list[list[float]]:
    return [[cell.value for cell in row if cell.is_number] for row in table.rows]  # type: ignore[misc]


def test_it_is_one_small_file_that_refers_to_nothing_else(html_file: Path, html: str) -> None:
    assert html_file.stat().st_size < BYTES_MAX
    shown = html[: html.index('id="report-data"')]
    referred = re.findall(r'\b(?:src|href|action)="([^"]*)"', shown)
    assert referred
    assert all(where.startswith(("#", "data:")) for where in referred)
    assert "@import" not in shown


def test_the_verdict_comes_first_and_every_sheet_says_whose_it_is(
    html: str, verified: Solution
) -> None:
    text, checked = words_of(html), verified.verification
    assert checked is not None
    lowest = min(checked.probabilities, key=lambda p: p.estimate)
    verdict = text.index("verified Required: every limit at every node with at least 0.7")
    assert verdict < text.index("Flight in 3-D")
    assert f"Achieved: {lowest.estimate:.4f} where it is least, {lowest.name}" in text
    assert f"Delta-v: {verified.total_dv_m_s:.6f} m/s in 4 burns" in text
    identity = (
        f"recon_b, t = 0 at 2020-01-21 20:32:08 UTC, plan {verified.plan_hash[:12]} | scp_recon "
    )
    assert text.count(identity) >= 11
    assert text.count("made 2026-01-02 03:04:05 UTC") == text.count(identity)


def test_tables_equal_the_solution_file(page: Page, verified: Solution, html: str) -> None:
    tables = {table.key: table for table in page.tables[0]}
    assert all(table.html() in html for table in tables.values())
    expected = [[b.t_s, *b.dv_m_s, float(np.linalg.norm(b.dv_m_s))] for b in verified.burns]
    assert numbers(tables["burns"]) == [*expected, [verified.total_dv_m_s]]
    margins = {row[0].text: row for row in tables["constraints"].rows}
    assert {name: (row[2].value, row[4].value) for name, row in margins.items()} == {
        c.name: (c.worst_margin, c.worst_t_s) for c in verified.constraints
    }
    checked = verified.verification
    assert checked is not None
    assert numbers(tables["probabilities"]) == [
        [p.estimate, p.low, p.high, p.worst_t_s, 0.7] for p in checked.probabilities
    ]
    assert [row[0] for row in numbers(tables["mean_margins"])] == [
        np.rad2deg(m.worst_margin) if m.unit == "rad" else m.worst_margin
        for m in checked.mean_margins
    ]
    required = {row[0].text: row[1].text for row in tables["mean_margins"].rows}
    assert required["site_distance_max"] == "at most 740 m"
    assert all(required.values())
    assert numbers(tables["stages"]) == [[s.iterations, s.total_dv_m_s] for s in verified.stages]
    keys = (
        *("k", "merit", "predicted", "actual"),
        *("trust_radius", "max_violation", "max_defect", "solver_s"),
    )
    assert numbers(tables["iterations"]) == [
        [getattr(r, key) for key in keys] for r in verified.iterations
    ]
    for cell in (cell for table in tables.values() for row in table.rows for cell in row):
        if cell.is_number:
            figure = cell.text.split()[0]  # and after it may stand its interval
            last = 10.0 ** int(Decimal(figure).as_tuple().exponent)
            assert abs(float(figure) - cell.value) <= 0.51 * last, cell  # type: ignore[operator]


def test_every_figure_is_one_of_plotlys(page: Page) -> None:
    """Plotly refuses what it does not know, names and values alike."""
    go = pytest.importorskip("plotly.graph_objects")
    figures = [{"data": page.scene["traces"], "layout": page.scene["layout"]}, *page.charts]
    for figure in figures:
        go.Figure({"data": figure["data"], "layout": figure["layout"]})
    keys = [chart["key"] for chart in page.charts]
    assert len(set(keys)) == len(keys) == 9  # without a simulation


def test_the_view_has_one_scale(page: Page) -> None:
    scene = page.scene["layout"]["scene"]
    edges = {axis: np.ptp(scene[f"{axis}axis"]["range"]) for axis in "xyz"}
    scales = [scene["aspectratio"][axis] / edge for axis, edge in edges.items()]
    assert scales == pytest.approx(3 * [scales[0]], rel=1e-5)


def test_names_of_limits_do_not_overprint(page: Page) -> None:
    """Those of a panel stand at different places, however close their lines are."""
    for chart in page.charts:
        places = [
            (a["yref"], a["x"])
            for a in chart["layout"]["annotations"]
            if a.get("xref") == "paper" and ":" in a["text"]
        ]
        assert len(set(places)) == len(places), chart["key"]


def test_a_uniform_plan_that_reaches_more_is_told_of_exact_risk(verified: Solution) -> None:
    (line,) = _surplus(Subject("plan", verified, path=Path("my runs/one")))
    assert re.match(r"flights reach at least 0\.\d{4} where 0\.7 is required", line)
    program, *words = shlex.split(line.rpartition("with: ")[2])
    assert program == "scp-recon"
    options = solve.parser().parse_args(words[1:])
    assert (words[0], options.init) == ("solve", "my runs/one")
    assert load_scenario(None, options.overrides).risk.allocation == "exact"
    exact = verified.scenario.replace({"risk.allocation": "exact"})
    sure = verified.scenario.replace({"risk.p_chance": 0.999})
    for other in (exact, sure):
        assert _surplus(Subject("plan", replace(verified, scenario=other))) == []


def test_limits_are_in_the_histories_and_every_band_around_its_mean(page: Page) -> None:
    chart = next(chart for chart in page.charts if chart["key"] == "observation")
    said = {a["text"].split(":")[0] for a in chart["layout"]["annotations"]}
    assert said >= {
        *("site_distance_min", "site_distance_max", "emission_min", "emission_max"),
        *("phase_min", "battery_observation"),
    }
    for axis in ("y", "y2", "y3"):
        lines = [trace for trace in chart["data"] if trace["yaxis"] == axis]
        low2, high2, low1, high1, mean = (np.array(line["y"]) for line in lines)
        assert (low2 < low1).all()
        assert (low1 < mean).all()
        assert (mean < high1).all()
        assert (high1 < high2).all()


@pytest.mark.usefixtures("few_flights")
def test_names_are_shown_as_they_are_and_end_no_script(verified: Solution) -> None:
    hostile = "</script><b onload=alert(1)>&\"'"
    scenario = verified.scenario.model_copy(update={"name": hostile})
    solution = replace(verified, scenario=scenario)
    text = render(page_of(subjects_of([solution]), Camera(), MADE))
    assert "<b onload" not in text
    assert hostile in unescape(text)
    data = re.search(r'id="report-data">(.*?)</script>', text)
    assert data is not None
    assert json.loads(data[1])["scene"]["motion"]["plans"][0]["name"] == hostile


@pytest.mark.usefixtures("few_flights")
def test_several_plans_are_laid_over_each_other(
    page: Page, verified: Solution, plan_folder: Path
) -> None:
    other = replace(verified, burns=verified.burns[:], status="stalled")
    both = page_of(subjects_of([plan_folder, other]), Camera(), MADE)
    assert [verdict_of(plan).good for plan in both.plans] == [True, False]
    assert "stalled" in both.comparison.rows[2][2].text if both.comparison else False
    assert len(both.scene["motion"]["plans"]) == 2
    for chart, alone in zip(both.charts, page.charts, strict=True):
        assert chart["key"] == alone["key"]
        named = {trace.get("name", "") for trace in chart["data"]}
        if chart["key"] != "timeline":
            assert any(name.startswith(str(plan_folder)) for name in named), chart["key"]
            assert any(name.startswith("recon_b") for name in named), chart["key"]
    assert len(render(both)) < BYTES_MAX


@pytest.mark.usefixtures("few_flights")
def test_the_command_writes_beside_the_plan_or_where_it_is_told(
    plan_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "new" / "page.html"
    arguments = ["--field-deg", "10", "--pixels", "512", "--out", str(file)]
    assert report.main([str(plan_folder), *arguments]) == 0
    assert f"written: {file}" in capsys.readouterr().out
    assert "camera of 10 deg and 512 pixels across" in file.read_text("utf-8")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--out", "page.pdf"], "must be a file that ends in .html"),
        (["--out", "folder.html"], "must be a file that ends in .html"),
        (["nowhere"], "no such file"),
    ],
)
def test_bad_input_ends_in_one_message(
    plan_folder: Path,
    arguments: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.html").mkdir()
    assert report.main([str(plan_folder), *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ")
    assert said in captured.err
    assert list(tmp_path.iterdir()) == [tmp_path / "folder.html"]


def elsewhere(solution: Solution, **sections: dict[str, Any]) -> Solution:
    """The same burns in a scenario with other entries in some of its sections."""
    sections = {
        name: getattr(solution.scenario, name).model_copy(update=entries)
        for name, entries in sections.items()
    }
    scenario = solution.scenario.model_copy(update=sections)
    return replace(solution, scenario=scenario)


def test_too_many_plans_and_those_of_several_bodies_or_epochs_are_refused(
    verified: Solution,
) -> None:
    later = verified.scenario.epoch.tdb + timedelta(seconds=10)
    for others, said in (
        ([elsewhere(verified, epoch={"tdb": later})], r"t = 0 at 2020-01-21T20:33:27.184\d* TDB"),
        ([elsewhere(verified, body={"name": "Eros"})], "must be of Bennu"),
        ([verified] * PLANS_MAX, f"must be 1 to {PLANS_MAX} plans"),
    ):
        with pytest.raises(InputError, match=said):
            subjects_of([verified, *others])
    with pytest.raises(InputError, match=f"must be 1 to {PLANS_MAX} plans"):
        subjects_of([])


@pytest.mark.usefixtures("few_flights")
def test_each_plan_has_its_own_site_and_its_part_of_the_flights_shown(verified: Solution) -> None:
    position = tuple(x + 2.0 for x in verified.scenario.site.position_body_m)
    other = elsewhere(verified, site={"name": "Above", "position_body_m": position})
    shown = page_of(subjects_of([verified, other]), Camera(), MADE)
    sites = [plan["site"] for plan in shown.scene["motion"]["plans"]]
    assert sites[1] == pytest.approx(position)
    assert sites[0] == pytest.approx(verified.scenario.site.position_body_m)
    ground = next(chart for chart in shown.charts if chart["key"] == "ground")
    for traces in (shown.scene["traces"], ground["data"]):
        named = [trace["name"] for trace in traces if trace["name"].startswith("site ")]
        assert named == ["site Nightingale", "site Above"]
    flights = [t["name"] for t in shown.scene["traces"] if "paths" in t["meta"]]
    assert [name.split(": ")[1] for name in flights] == [f"{PATHS // 2} sampled flights"] * 2


def test_plotlys_script_is_there_without_its_loader() -> None:
    whole, bare = get_plotlyjs(), plotly_script()
    assert bare.startswith("/**\n* plotly.js v")
    assert "Licensed under the MIT license" in bare
    assert "factory" not in bare[:400]
    assert 0 < len(whole) - len(bare) < 500


def test_flights_of_another_plan_are_passed_over_and_named(
    plan_folder: Path, subject: Subject, tmp_path: Path
) -> None:
    assert subject.summary is not None
    other = replace(subject.solution, burns=subject.solution.burns[::1])
    other.write(tmp_path)
    text = (plan_folder / "montecarlo.json").read_text("utf-8")
    (tmp_path / "montecarlo.json").write_text(
        text.replace(subject.solution.plan_hash, "0" * 64), "utf-8"
    )
    (found,) = subjects_of([tmp_path])
    assert found.summary is None
    assert found.passed_over == (f"{tmp_path / 'montecarlo.json'}: flights of another plan",)


def test_numbers_are_rounded_and_what_is_none_is_null() -> None:
    assert compact([[1.23456, np.nan], [2.0, -0.0]], 2) == [[1.23, None], [2.0, 0.0]]
    assert significant([123456.789, np.inf], 3) == [123000.0, None]
    assert json.loads(script({"a": "</script>&"})) == {"a": "</script>&"}
    assert "<" not in script("</script>")
    assert len(set(DASHES)) == len(PLANS) == PLANS_MAX


@pytest.mark.parametrize(("most", "kind"), [(65_535, "u2"), (65_536, "u4")])
def test_whole_numbers_are_packed_without_loss(most: int, kind: str) -> None:
    found = packed(np.array([0, 7, most]))
    assert found["dtype"] == kind
    read = np.frombuffer(base64.b64decode(found["bdata"]), f"<{kind}")
    assert read.tolist() == [0, 7, most]
