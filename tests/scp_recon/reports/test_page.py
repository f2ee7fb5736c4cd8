"""The page without a browser: it stands alone, says what the solution file says, also of a flight."""

import json
import re
from dataclasses import replace
from datetime import timedelta
from decimal import Decimal
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from scp_recon.advice.infeasibility import Diagnosis
from scp_recon.api.planning import plan_left
from scp_recon.cli import plan_run
from scp_recon.cli.commands import report
from scp_recon.errors import InputError
from scp_recon.monte_carlo.summary import Contingency, Interval
from scp_recon.physics.geometry import track
from scp_recon.replanning.flown import FlownPlan, predict
from scp_recon.replanning.remainder import Delivery
from scp_recon.reports.flight_tables import missed_burns_table
from scp_recon.reports.histories import probability_chart
from scp_recon.reports.page import Page, _remarks, render, verdict_of
from scp_recon.reports.shown import PLANS_MAX, plans_of
from scp_recon.reports.tables import constraints_table, limits_table
from scp_recon.reports.write import page_of
from scp_recon.results.figures import Violation, ViolationAmount
from scp_recon.results.solution import Solution, make_solution
from scp_recon.results.table import SCALES, Table
from scp_recon.scp.status import Status
from tests.scenarios import COARSE
from tests.scp_recon.support import run_solve

from .conftest import MADE

pytestmark = pytest.mark.slow

BYTES_MAX = 8_000_000


@pytest.fixture(scope="module")
def html(html_file) -> str:
    return html_file.read_text("utf-8")


def words_of(html: str) -> str:
    """What a reader sees of a page, in one line."""
    bare = re.sub(r"<(style|script)\b.*?</\1>|<[^>]*>", " ", html, flags=re.DOTALL)
    return " ".join(unescape(bare).split())


def numbers(table: Table) -> list[list[float]]:
    return [[cell.value for cell in row if cell.is_number] for row in table.rows]  # type: ignore[misc]


def test_page_is_self_contained_and_begins_with_verdict(html_file, html, verified):
    assert html_file.stat().st_size < BYTES_MAX
    shown = html[: html.index('id="report-data"')]
    referred = re.findall(r'\b(?:src|href|action)="([^"]*)"', shown)
    assert referred
    assert all(where.startswith(("#", "data:")) for where in referred)
    assert "@import" not in shown
    text = words_of(html)
    verdict = text.index("verified Required: every limit at every node with at least 0.7")
    assert verdict < text.index("Flight in 3-D")
    assert f"Delta-v: {1e3 * verified.total_dv_m_s:.3f} mm/s in 4 burns" in text
    when = "t = 0 at 2020-01-21 20:32:08 UTC"
    assert text.count(f"recon_b, {when}, plan {verified.plan_hash[:12]} | scp_recon ") >= 11


def test_tables_equal_the_solution_file(page, verified, html):
    tables = {table.key: table for table in page.tables[0]}
    assert all(table.html() in html for table in tables.values())
    expected = [[b.t_s, *b.dv_m_s, float(np.linalg.norm(b.dv_m_s))] for b in verified.burns]
    assert numbers(tables["burns"]) == [*expected, [verified.total_dv_m_s]]
    margins = {row[0].text: row for row in tables["constraints"].rows}
    assert {name: (row[2].value, row[4].value) for name, row in margins.items()} == {
        c.name: (c.worst_margin, c.worst_t_s) for c in verified.constraints
    }
    checked = verified.verification
    limits = {row[0].text: row for row in tables["limits"].rows}
    for p in checked.probabilities:
        row = limits[p.name]
        assert (row[3].value, row[4].text) == (p.estimate, f"{p.low:.4f} to {p.high:.4f}")
    assert limits["site_distance"][1].text == "500 to 740 m"
    assert numbers(tables["stages"]) == [[s.iterations, s.total_dv_m_s] for s in verified.stages]
    keys = (
        *("k", "merit", "predicted", "actual"),
        *("trust_radius", "max_violation", "max_defect", "solver_s"),
    )
    assert numbers(tables["iterations"]) == [
        [getattr(r, key) for key in keys] for r in verified.iterations
    ]
    for table in tables.values():
        for column, cell in (
            pair for row in table.rows for pair in zip(table.columns, row, strict=True)
        ):
            if cell.is_number:
                figure = cell.text.split()[0]  # and after it may stand its interval
                last = 10.0 ** int(Decimal(figure).as_tuple().exponent)
                value = cell.value * SCALES.get((column.unit, column.shown_unit), 1.0)
                assert abs(float(figure) - value) <= 0.51 * last, cell


def test_every_figure_is_one_of_plotlys(page):
    """Plotly refuses what it does not know, names and values alike."""
    go = pytest.importorskip("plotly.graph_objects")
    figures = [{"data": page.scene["traces"], "layout": page.scene["layout"]}, *page.charts]
    for figure in figures:
        go.Figure({"data": figure["data"], "layout": figure["layout"]})
    keys = [chart["key"] for chart in page.charts]
    assert len(set(keys)) == len(keys) == 9  # without a simulation


def test_required_probability_is_drawn_where_it_applies(page):
    """That of nodes not across the share of whole flights, which is all that several plans show."""
    (shown,) = page.plans
    flight = {"risk.p_chance": 0.8, "risk.scope": "flight", "risk.allocation": "exact"}
    solution = shown.solution
    changed = {
        "node": solution,
        "flight": replace(solution, scenario=solution.scenario.replace(flight)),
        "P3": replace(solution, problem="P3"),
    }
    of = {name: replace(shown, solution=one, samples=100) for name, one in changed.items()}
    node = ["required of each at every node: at least 0.7"]
    whole = ["required of whole flights: at least 0.8"]
    for names, expected in (
        (["node"], node),
        (["flight"], whole),
        (["P3"], []),
        (["node", "flight"], whole),
        (["node", "P3"], []),
    ):
        layout = probability_chart([of[name] for name in names])["layout"]
        said = [a["text"] for a in layout["annotations"] if "at least" in a["text"]]
        assert said == expected
        assert sum(s["type"] == "line" for s in layout["shapes"]) == len(expected)


@pytest.mark.usefixtures("few_flights")
def test_names_are_escaped(verified):
    hostile = "</script><b onload=alert(1)>&\"'"
    scenario = verified.scenario.model_copy(update={"name": hostile})
    solution = replace(verified, scenario=scenario)
    text = render(page_of(plans_of([solution]), MADE))
    assert "<b onload" not in text
    assert hostile in unescape(text)
    data = re.search(r'id="report-data">(.*?)</script>', text)
    assert json.loads(data[1])["scene"]["motion"]["plans"][0]["name"] == hostile


@pytest.mark.usefixtures("few_flights")
def test_latest_run_is_named_by_its_own_folder(plan_folder, tmp_path):
    (tmp_path / "latest").symlink_to(plan_folder)
    (found,) = plans_of([tmp_path / "latest"])
    assert found.name == str(plan_folder)


def test_several_plans_are_laid_over_each_other(page, verified, plan_folder):
    other = replace(verified, burns=verified.burns[:], status="stalled", advice=("next: less",))
    both = page_of(plans_of([plan_folder, other]), MADE)
    assert [verdict_of(plan).good for plan in both.plans] == [True, False]
    assert "stalled" in both.comparison.rows[2][2].text if both.comparison else False
    assert len(both.scene["motion"]["plans"]) == 2
    for chart, alone in zip(both.charts, page.charts, strict=True):
        assert chart["key"] == alone["key"]
        named = {trace.get("name", "") for trace in chart["data"]}
        if chart["key"] != "timeline":
            assert any(name.startswith(str(plan_folder)) for name in named), chart["key"]
            assert any(name.startswith("recon_b") for name in named), chart["key"]
        if chart["key"] == "convergence":
            entries = [trace for trace in chart["data"] if trace["showlegend"]]
            assert [trace["name"] for trace in entries] == [str(plan_folder), "recon_b"]
            assert len({trace["line"]["color"] for trace in entries}) == 2
    written = render(both)
    assert written.count("next: less") == 1
    assert "next: next" not in written
    assert len(written) < BYTES_MAX


@pytest.mark.usefixtures("few_flights")
def test_command_writes_out_or_refuses(plan_folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.html").mkdir()
    for arguments, said in (
        (["--out", "page.pdf"], "must be a file that ends in .html"),
        (["--out", "folder.html"], "must be a file that ends in .html"),
        (["nowhere"], "no such file"),
    ):
        assert report.main([str(plan_folder), *arguments]) == 2
        assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [tmp_path / "folder.html"]
    camera = ["--field-deg", "10", "--pixels", "512"]
    assert report.main([str(plan_folder), *camera, "--out", "new/page.html"]) == 0
    assert f"written: {Path('new/page.html')}" in capsys.readouterr().out
    page = Path("new/page.html").read_text("utf-8")
    assert "10 deg and 512 pixels" in page


def elsewhere(solution: Solution, table: str, **entries: Any) -> Solution:
    """The same burns in a scenario with other entries in a table."""
    section = getattr(solution.scenario, table).model_copy(update=entries)
    return replace(solution, scenario=solution.scenario.model_copy(update={table: section}))


def test_plans_that_do_not_fit_are_refused(verified):
    later = verified.scenario.epoch.tdb + timedelta(seconds=10)
    number = f"must be 1 to {PLANS_MAX} plans"
    for plans, said in (
        ([verified, elsewhere(verified, "epoch", tdb=later)], r"t = 0 at .*T20:33:27.184\d* TDB"),
        ([verified, elsewhere(verified, "body", name="Eros")], "must be of Bennu"),
        ([verified] * (PLANS_MAX + 1), number),
        ([], number),
    ):
        with pytest.raises(InputError, match=said):
            plans_of(plans)


def test_flights_beside_plan_are_shown_or_named(shown, tmp_path):
    """Those that miss a burn with the way home, where it was planned; not those of another plan."""
    shown.solution.write(tmp_path)
    drift = shown.solution.verification.drifts[1]
    kept = Interval(value=0.99, low=0.98, high=1.0)
    home = Contingency(
        status="converged", total_dv_m_s=0.06, burn_times_s=(25000.0,), whole_flight=kept
    )
    flown = shown.summary.model_copy(update={"drift": drift, "then": home})
    flown.write(tmp_path, "montecarlo_miss_2.json")
    for summary, name in ((flown, "montecarlo_miss_3.json"), (shown.summary, "montecarlo.json")):
        summary.model_copy(update={"plan_hash": "0" * 64}).write(tmp_path, name)
    (found,) = plans_of([tmp_path])
    assert found.missed == (flown,)
    assert found.summary is None
    names = ("montecarlo.json", "montecarlo_miss_3.json")
    assert found.passed_over == tuple(f"{tmp_path / n}: flights of another plan" for n in names)
    (row,) = missed_burns_table(found.missed).rows
    texts = ["burn 2 is missed", "converged", "60.000", "25000", "0.9900 (0.9800 to 1.0000)"]
    assert [row[k].text for k in (0, 4, 5, 6, 7)] == texts


def test_planned_drifts_are_rows_of_limits(shown):
    """Of limits and of margins, with what flights keep; one cut short by its share."""
    solution, v = shown.solution, shown.solution.verification
    planned = replace(v.drifts[1], required=0.997, low=0.996, high=0.999)
    planned = replace(planned, closest_m=512.0, share=0.3)
    judged = replace(v, drifts=(v.drifts[0], planned))
    row = limits_table(shown.mission, solution, judged).rows[-1]
    name, *figures = (cell.text for cell in row)
    assert name == "drift: burn 2 stops at 30 %"
    assert figures[:2] == [">= 500 m", ">= 512 m"]
    assert figures[-1] == "binds"
    name, kind, margin = constraints_table(replace(solution, verification=judged)).rows[-1][:3]
    assert (name.text, kind.text, margin.value) == ("drift: burn 2 stops at 30 %", "drift", 12.0)
    assert "drift: " not in str(limits_table(shown.mission, solution, v).rows)


def test_violated_angles_are_shown_in_degrees(shown):
    """The larger side of two; seen from the site, or from where the burn begins."""
    solution, mission, off = shown.solution, shown.mission, np.sin(np.deg2rad(2.0))
    at = {c.name: c.worst_t_s for c in solution.constraints}
    node = solution.nodes.t_s.index(at["emission_max"])
    site = track(mission.site, mission.rotation, np.array([at["emission_max"]])).position[0]
    far = np.linalg.norm(np.array(solution.nodes.state[node])[:3] - site)
    burn = next(b.dv_m_s for b in solution.burns if b.t_s == at["dv_battery"])
    amounts = {
        "emission_min": ViolationAmount(1.0, 1.0, "m"),
        "emission_max": ViolationAmount(far * off, far * off, "m"),
        "dv_battery": ViolationAmount(off * np.linalg.norm(burn), 1.0, "m/s"),
        "site_distance_min": ViolationAmount(3.0, 3.0, "m"),
    }
    violated = SimpleNamespace(
        violation=Violation(far, far, amounts),
        **{name: getattr(solution, name) for name in ("constraints", "nodes", "burns")},
    )
    rows = limits_table(mission, violated, solution.verification).rows
    marks = {row[0].text: row[-1].text for row in rows}
    assert marks["emission"] == "max off 2 deg"
    assert marks["dv_battery"] == "off 2 deg"
    assert marks["site_distance"] == "min off 3 m"


def test_stored_plan_keeps_all_warnings(shown):
    wider = replace(shown.solution.verification, wider={"vz": 2.0})
    doubtful = replace(shown, solution=replace(shown.solution, verification=wider))
    said = _remarks(doubtful, Status.CONVERGED)
    assert any(one.startswith("warning: after the last burn") for one in said)


@pytest.mark.usefixtures("few_flights")
def test_solve_writes_the_report_beside_the_plan(tmp_path, monkeypatch):
    unknown = Diagnosis(Status.MAX_ITERATIONS, (), ())  # which takes long to find out
    monkeypatch.setattr(plan_run, "diagnose", lambda *_: unknown)
    run = run_solve(tmp_path, "--report")
    assert run.exit_code == 0
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "<strong>verified</strong>" in page
    assert run.output.rstrip().endswith(f"written: {tmp_path / 'report.html'}")
    impossible = ("--problem", "P3", "--set", "burns.dv_max_m_s=0.02", "--set", COARSE)
    assert run_solve(tmp_path, *impossible, "--report").exit_code == 3
    assert (tmp_path / "report.html").read_text("utf-8") == page
    other = (tmp_path / "report_unverified.html").read_text("utf-8")
    assert "<strong>not verified: status" in other
    assert "violated by" in other


IN_THE_WINDOW, AFTER_IT = 15_000.0, 17_000.0
OF_THE_WINDOW = {"observation", "resolution"}


@pytest.fixture(scope="module")
def left(default_plan) -> dict[float, Solution]:
    flown = FlownPlan.of(default_plan)

    def from_time(at_s: float) -> Solution:
        delivery = Delivery(at_s, predict(flown, at_s, {}).state)
        return make_solution(plan_left(flown, delivery))

    return {at_s: from_time(at_s) for at_s in (IN_THE_WINDOW, AFTER_IT)}


def earliest(page: Page, keys: set[str]) -> float:
    """Of all times on the horizontal axes of some charts."""
    charts = [chart for chart in page.charts if chart["key"] in keys]
    given = [trace["x"] for chart in charts for trace in chart["data"]]
    return float(min(np.nanmin(np.array(x, dtype=float)) for x in given if len(x)))


@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize("at_s", [IN_THE_WINDOW, AFTER_IT])
def test_report_begins_at_the_start_of_plan(left, at_s):
    (shown,) = plans_of([left[at_s]])
    assert shown.flown.times_s[0] == at_s
    page = page_of([shown], MADE)
    assert earliest(page, {"ranges", "probability", *OF_THE_WINDOW}) == pytest.approx(at_s)
    moving = page.scene["motion"]
    assert moving["ends_s"][0] == at_s
    assert all(look >= at_s for look in moving["plans"][0]["looks_s"])
    keys = {chart["key"] for chart in page.charts}
    assert (keys >= OF_THE_WINDOW) == (at_s < shown.mission.schedule.window_s[1])
    assert "<html" in render(page)


@pytest.mark.usefixtures("few_flights")
def test_burns_keep_their_numbers_of_the_flight(left):
    page = page_of(plans_of([left[AFTER_IT]]), MADE)
    charts = {chart["key"]: chart["data"] for chart in page.charts}
    assert charts["budget"][0]["x"] == ["burn 3", "burn 4"]
    words = [word["text"] for word in page.scene["layout"]["scene"]["annotations"]]
    words += [text for trace in charts["timeline"] for text in trace.get("text", ())]
    assert [word[0] for word in words if word.endswith("mm/s")] == ["3", "4"] * 2
    tables = {table.key: table for table in page.tables[0]}
    assert [row[0].text for row in tables["burns"].rows[:2]] == ["3", "4"]
    assert [row[0].text for row in tables["budget"].rows[:2]] == ["3", "4"]
