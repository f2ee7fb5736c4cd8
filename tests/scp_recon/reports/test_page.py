"""The page without a browser: it stands alone, and says what the solution file says."""

from __future__ import annotations

import base64
import itertools
import json
import re
from dataclasses import replace
from datetime import timedelta
from decimal import Decimal
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plotly.offline import get_plotlyjs

from scp_recon.cli.commands.plans import report
from scp_recon.errors import InputError
from scp_recon.reports import flights
from scp_recon.reports.flights import fly
from scp_recon.reports.ground import Camera
from scp_recon.reports.marks import DASHES, PLANS, compact, packed, script, significant
from scp_recon.reports.page import Page, plotly_script, render, verdict_of
from scp_recon.reports.scene import PATHS
from scp_recon.reports.subject import PLANS_MAX, Subject, subjects_of
from scp_recon.reports.write import page_of, write_report
from scp_recon.results.comparison import compare
from scp_recon.results.solution import Solution
from scp_recon.results.table import Cell
from scp_recon.scenario.load import load_scenario

from .conftest import MADE

BYTES_MAX = 8_000_000


@pytest.fixture
def few_flights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the numbers do not matter."""
    monkeypatch.setattr(flights, "fly", partial(fly, samples=200))


class Reader(HTMLParser):
    """Tables by key, texts by the class of what they stand in, and what tags refer to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tables: dict[str, list[list[tuple[str, float | None]]]] = {}
        self.referred: list[str] = []
        self.shown: list[str] = []
        self.json = ""
        self._in: list[str] = []
        self._table: list[list[tuple[str, float | None]]] | None = None
        self._cell: float | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.referred += [v for k, v in attrs if k in ("src", "href", "action") and v]
        if tag == "table":
            self._table = self.tables.setdefault(str(given["data-table"]), [])
        if tag == "tr" and self._table is not None:
            self._table.append([])
        if tag in ("td", "th"):
            value = given.get("data-value")
            self._cell = None if value is None else float(value)
            assert self._table is not None
            self._table[-1].append(("", self._cell))
        if tag not in ("meta", "link", "input", "img", "br"):
            self._in.append("data" if given.get("id") == "report-data" else tag)

    def handle_endtag(self, tag: str) -> None:
        if self._in:
            self._in.pop()
        if tag == "table":
            self._table = None

    def handle_data(self, data: str) -> None:
        inside = self._in[-1] if self._in else ""
        if inside == "data":
            self.json += data
        elif inside in ("td", "th") and self._table is not None:
            text, value = self._table[-1][-1]
            self._table[-1][-1] = (text + data, value)
        elif inside not in ("script", "style"):
            self.shown.append(data)


@pytest.fixture(scope="module")
def read(html_file: Path) -> Reader:
    return Reader(html_file.read_text("utf-8"))


def numbers(rows: list[list[tuple[str, float | None]]]) -> list[list[float]]:
    return [[value for _, value in row if value is not None] for row in rows[1:]]


def test_it_is_one_small_file_that_refers_to_nothing_else(html_file: Path, read: Reader) -> None:
    assert html_file.stat().st_size < BYTES_MAX
    assert read.referred
    assert all(where.startswith(("#", "data:")) for where in read.referred)
    assert "@import" not in html_file.read_text("utf-8").split("</style>")[0]


def test_the_verdict_comes_first_with_asked_against_achieved(
    read: Reader, verified: Solution
) -> None:
    text = " ".join(" ".join(read.shown).split())
    checked = verified.verification
    assert checked is not None
    lowest = min(checked.probabilities, key=lambda p: p.estimate)
    verdict = text.index("verified Asked: every limit at every node with at least 0.7")
    assert f"Achieved: {lowest.estimate:.4f} where it is least, {lowest.name}" in text
    assert f"Delta-v: {verified.total_dv_m_s:.6f} m/s in 4 burns" in text
    assert verdict < text.index("Flight in 3-D")


def test_every_sheet_says_scenario_utc_version_and_plan(read: Reader, verified: Solution) -> None:
    sheets = [text for text in read.shown if "| scp_recon " in text]
    assert len(sheets) >= 11
    for text in sheets:
        assert text.startswith("recon_b, t = 0 at 2020-01-21 20:32:08 UTC, plan ")
        assert verified.plan_hash[:12] in text
        assert text.endswith("made 2026-01-02 03:04:05 UTC")


def test_tables_equal_the_solution_file(read: Reader, verified: Solution) -> None:
    burns = numbers(read.tables["burns"])
    expected = [[b.t_s, *b.dv_m_s, float(np.linalg.norm(b.dv_m_s))] for b in verified.burns]
    assert burns == [*expected, [verified.total_dv_m_s]]
    margins = {row[0][0]: row for row in read.tables["constraints"][1:]}
    assert margins.keys() == {c.name for c in verified.constraints}
    for c in verified.constraints:
        assert margins[c.name][2][1] == c.worst_margin
        assert margins[c.name][4][1] == c.worst_t_s
    checked = verified.verification
    assert checked is not None
    assert numbers(read.tables["probabilities"]) == [
        [p.estimate, p.low, p.high, p.worst_t_s, 0.7] for p in checked.probabilities
    ]
    assert [row[0] for row in numbers(read.tables["mean_margins"])] == [
        np.rad2deg(m.worst_margin) if m.unit == "rad" else m.worst_margin
        for m in checked.mean_margins
    ]
    asked = {row[0][0]: row[1][0] for row in read.tables["mean_margins"][1:]}
    assert asked["site_distance_max"] == "at most 740 m"
    assert all(asked.values())
    assert numbers(read.tables["stages"]) == [
        [s.iterations, s.total_dv_m_s] for s in verified.stages
    ]
    keys = (
        *("k", "merit", "predicted", "actual"),
        *("trust_radius", "max_violation", "max_defect", "solver_s"),
    )
    assert numbers(read.tables["iterations"]) == [
        [getattr(r, key) for key in keys] for r in verified.iterations
    ]


def test_texts_in_tables_are_their_numbers(read: Reader) -> None:
    for key, rows in read.tables.items():
        for text, value in itertools.chain.from_iterable(rows):
            if value is not None:
                figure = text.split()[0]  # and after it may stand its interval
                last = 10.0 ** int(Decimal(figure).as_tuple().exponent)
                assert abs(float(figure) - value) <= 0.51 * last, (key, text, value)


def test_every_figure_is_one_of_plotlys(page: Page) -> None:
    """Plotly refuses what it does not know, names and values alike."""
    go = pytest.importorskip("plotly.graph_objects")
    figures = [{"data": page.scene["traces"], "layout": page.scene["layout"]}, *page.charts]
    for figure in figures:
        go.Figure({"data": figure["data"], "layout": figure["layout"]})
    keys = [chart["key"] for chart in page.charts]
    assert len(set(keys)) == len(keys) == 9  # without a simulation


def test_the_view_has_one_scale_and_shows_the_names_of_its_axes(page: Page) -> None:
    """Plotly leaves out what is written outside the ranges."""
    scene = page.scene["layout"]["scene"]
    ranges = {axis: scene[f"{axis}axis"]["range"] for axis in "xyz"}
    scales = [scene["aspectratio"][axis] / (high - low) for axis, (low, high) in ranges.items()]
    assert scales == pytest.approx(3 * [scales[0]], rel=1e-5)
    names = [a for a in scene["annotations"] if a["text"].endswith("(m)")]
    assert len(names) == 3
    for name in names:
        assert all(low <= name[axis] <= high for axis, (low, high) in ranges.items())


def test_panels_name_their_units(page: Page) -> None:
    for chart in page.charts:
        headings = [a["text"] for a in chart["layout"]["annotations"] if "<b>" in a["text"]]
        assert headings
        for heading in headings:
            assert re.search(r"\([^()]+\)</b>$", heading) or chart["key"] == "timeline", heading


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
    reader = Reader(text)
    assert "<b onload" not in text
    assert any(hostile in shown for shown in reader.shown)
    name = json.loads(reader.json)["scene"]["motion"]["plans"][0]["name"]
    assert name == hostile


@pytest.mark.usefixtures("few_flights")
def test_several_plans_are_laid_over_each_other(
    page: Page, verified: Solution, plan_folder: Path, tmp_path: Path
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
    file = write_report([verified, other], tmp_path / "both.html")
    assert file.stat().st_size < BYTES_MAX


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


def test_plans_at_other_epochs_are_refused_as_one_view_shows_one_body(verified: Solution) -> None:
    later = verified.scenario.epoch.tdb + timedelta(seconds=10)
    with pytest.raises(InputError, match=r"t = 0 at 2020-01-21T20:33:27.184\d* TDB"):
        subjects_of([verified, elsewhere(verified, epoch={"tdb": later})])


def test_a_figure_that_is_rounding_is_compared_as_zero(verified: Solution) -> None:
    burns = (
        replace(verified.burns[0], dv_m_s=(0.0, 3e-12, 0.0)),
        *verified.burns[1:],
    )
    other = replace(verified, burns=burns)
    rows = {row[0].text: row for row in compare(["a", "b"], [verified, other]).table.rows}
    assert rows["burn 1 (m/s)"][2] == Cell("0", 3e-12)


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


def test_plans_of_several_bodies_or_too_many_are_refused(verified: Solution) -> None:
    body = load_scenario().body.model_copy(update={"name": "Eros"})
    scenario = verified.scenario.model_copy(update={"body": body})
    with pytest.raises(InputError, match="must be of Bennu"):
        subjects_of([verified, replace(verified, scenario=scenario)])
    for given in ([], [verified] * (PLANS_MAX + 1)):
        with pytest.raises(InputError, match=f"must be 1 to {PLANS_MAX} plans"):
            subjects_of(given)


def test_a_missing_extra_is_told_before_any_work(
    verified: Solution, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "plotly", None)
    with pytest.raises(InputError, match=r"needs the extra scp_recon\[report\]"):
        write_report([verified], tmp_path / "x.html")
    assert not list(tmp_path.iterdir())


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


@pytest.mark.parametrize(("most", "kind"), [(65_535, "u2"), (65_536, "u4")])
def test_whole_numbers_are_packed_without_loss(most: int, kind: str) -> None:
    found = packed(np.array([0, 7, most]))
    assert found["dtype"] == kind
    read = np.frombuffer(base64.b64decode(found["bdata"]), f"<{kind}")
    assert read.tolist() == [0, 7, most]


def seen_without(cone: int, colour: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """A colour to an eye without one kind of cone: Machado et al. 2009, severity 1; linear RGB."""
    rows = """
        0.152286 1.052583 -0.204868  0.114503 0.786281 0.099216  -0.003882 -0.048116 1.051998
        0.367322 0.860646 -0.227968  0.280085 0.672501 0.047413  -0.011820 0.042940 0.968881
        1.255528 -0.076749 -0.178779  -0.078411 0.930809 0.147602  0.004733 0.691367 0.303900
    """
    missing = np.array(rows.split(), dtype=float).reshape(3, 3, 3)
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    shown = np.clip(missing[cone] @ linear, 0.0, 1.0)
    return np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("cone", range(3))
def test_plans_are_told_apart_without_full_colour_vision(cone: int) -> None:
    for one, other in itertools.combinations(PLANS, 2):
        apart = seen_without(cone, one) - seen_without(cone, other)
        assert np.linalg.norm(apart) > 0.08, (one, other)
    assert len(set(DASHES)) == len(PLANS) == PLANS_MAX
