"""The front door: what a notebook needs, in SI, lazily imported, with docstrings that run."""

import copy
import doctest
import pickle
import re
import runpy
import sys
from collections.abc import Callable
from dataclasses import replace
from inspect import getdoc, isfunction, ismodule, signature
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

import scp_recon as sr
from scp_recon.api import files, flying, planning
from scp_recon.api.options import PlanOptions
from scp_recon.display import Displayed
from scp_recon.errors import InputError
from scp_recon.planning.plan import Plan, as_interrupted
from scp_recon.planning.records import Certificate, Parent
from scp_recon.results.comparison import Comparison
from scp_recon.results.read import read_solution
from scp_recon.results.solution import make_solution
from tests.helpers import nightly
from tests.scp_recon.support import raising

campaign = sr.campaign  # imported here, before a test puts anything in its modules' place

PROJECT = Path(__file__).parents[2]
BY_NIGHT = {"read_campaign", "campaign", "charts", "report", "simulate", "design", "new"}
"""Their examples take seconds, and extras."""


@pytest.mark.slow
@nightly
@pytest.mark.usefixtures("few_flights")
def test_the_example_runs(capsys):
    runpy.run_path(str(PROJECT / "examples" / "first_plan.py"))
    printed = capsys.readouterr().out
    assert "recon_b, P2: Converged" in printed
    assert "verified: True" in printed
    assert "the first (m)" in printed


@nightly
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "cost"),
    [
        ("hill_rendezvous", "cost 0.44 m/s"),
        ("halo_transfer", "cost 0.1945583"),
        ("nrho_keeping", "cost 0.36 m/s"),
    ],
)
def test_problem_by_hand_costs_its_pages_figure(name, cost, capsys):
    script = PROJECT / "examples" / f"{name}.py"
    assert len(script.read_text("utf-8").splitlines()) <= 80
    runpy.run_path(str(script))
    printed = capsys.readouterr().out
    assert "Converged" in printed
    assert printed.splitlines()[-1] == cost
    page = (PROJECT / "docs" / "impulsive.md").read_text("utf-8")
    assert cost.split()[1] in page


@pytest.mark.slow
@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=nightly if name in BY_NIGHT else ()) for name in sr.__all__]
)
def test_docstrings_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    part = sys.modules[getattr(sr, name).__module__]
    (found,) = doctest.DocTestFinder(recurse=False).find(getattr(sr, name), name, part)
    assert found.examples
    assert doctest.DocTestRunner().run(found).failed == 0


@pytest.mark.parametrize(
    "function",
    [
        *filter(isfunction, (getattr(sr, name) for name in sr.__all__)),
        Displayed.plot,
        Displayed.to_frame,
    ],
)
def test_help_tells_parameters_returns_and_raises(function):
    """In this order, as SciPy's does, and examples last."""
    said = getdoc(function) or ""
    sections = re.findall(r"^(Args|Returns|Raises|Examples):$", said, re.MULTILINE)
    order = ["Args", "Returns", "Raises", "Examples"]
    assert sections == [name for name in order if name in sections]
    arguments = said.partition("\nArgs:\n")[2].partition("\n\n")[0]
    told = re.findall(r"^    (\w+): ", arguments, re.MULTILINE)
    hints = signature(function)
    assert told == [name for name in hints.parameters if name != "self"]
    assert ("Returns" in sections) == (hints.return_annotation not in (None, "None"))
    assert function is sr.scenarios or "Raises" in sections


def test_a_plan_speaks_si(default_plan, solution):
    plan = default_plan
    n = len(plan.times_s)
    assert plan.states.shape == (n, 6)
    assert plan.covariances.shape == (n, 6, 6)
    np.testing.assert_array_equal(plan.burns_m_s, solution.burns_m_s)
    np.testing.assert_array_equal(plan.states, solution.nodes.state)
    np.testing.assert_array_equal(plan.covariances, solution.nodes.covariance)
    assert plan.total_dv_m_s == solution.total_dv_m_s
    stored = {c.name: (pytest.approx(c.worst_margin), c.unit) for c in solution.constraints}
    assert plan.worst_margins == stored


@pytest.mark.slow
def test_what_comes_back_tells_its_verdict(default_plan, solution, verification):
    """What a plan is made of too, which is thousands of numbers."""
    assert all(name in str(default_plan) for name in default_plan.worst_margins)
    assert default_plan._repr_html_().startswith("<pre style")
    failed = replace(verification, ok=False, failed=["status"])
    assert str(verification).splitlines()[0] == "verified"
    for verdict, found in {"verified": verification, "not verified: status": failed}.items():
        judged = replace(solution, verification=found)
        assert repr(found) == f"<Verification: {verdict}>"
        assert repr(judged) == f"<Solution recon_b: converged, {verdict}, 0.140135 m/s>"
    mission = default_plan.mission
    for part in (default_plan.final, mission, mission.scenario):
        assert repr(part).startswith(f"<{type(part).__name__} ")
        assert len(repr(part)) < 100
    with pytest.raises(AttributeError, match="no attribute 'plann'"):
        sr.plann  # noqa: B018 -- the attribute is what is asked for


def test_misspelt_result_name_suggests_near_one(default_plan, solution):
    flights = sr.fly(default_plan, samples=20)
    table = sr.compare(solution)
    for results, name, near in (
        (flights.probability, "emision", "emission"),
        (flights.held_s, "phases", "phase"),
        (flights.terminal.sigma_ratio, "vxx", "vx"),
        (default_plan.worst_margins, "emision_min", "emission_min"),
        (solution.violation.by_constraint, "emission", None),
        (table, "total deltav", "total delta-v"),
    ):
        meant = f"did you mean '{near}'?" if near else "there are none"
        with pytest.raises(KeyError, match=re.escape(meant)):
            results[name]


@pytest.mark.slow
def test_plans_equal_unless_more_than_timing_differs(default_plan):
    """What it is made of holds arrays, and is equal only to itself: asking ends in no traceback."""
    for again in (pickle.loads(pickle.dumps(default_plan)), copy.deepcopy(default_plan)):
        assert (again, hash(again)) == (default_plan, hash(default_plan))
        for plan in (default_plan, again):
            for array in (plan.burns_m_s, plan.times_s, plan.states, plan.covariances):
                with pytest.raises(ValueError, match="read-only"):
                    array[0] = 0.0
    certificate = Certificate(1000, 0, 0.71, 0.7, 0.72, 0.71, 1, 1, 0.975)
    for other in (
        sr.plan(init="warm"),
        as_interrupted(default_plan),
        replace(default_plan, target=0.7),
        replace(default_plan, certificate=certificate),
        replace(default_plan, parent=Parent("runs/mine", "0" * 64, 17000.0)),
        replace(default_plan, provenance=replace(default_plan.provenance, init="warm")),
        replace(default_plan, stages=default_plan.stages[1:]),
    ):
        assert other != default_plan
        assert pickle.loads(pickle.dumps(other)) == other
    assert replace(default_plan, total_s=1e3) == default_plan != 3
    for path in (
        *("mission", "mission.problem", "mission.dynamics", "final", "final.facets"),
        *("final.result", "final.result.lin", "final.result.lin.iterate", "final.result.lin.arcs"),
    ):
        one, part = map(attrgetter(path), (default_plan, again))
        assert one == one
        assert one != part
        assert len({one, part}) == 2


@pytest.mark.slow
@pytest.mark.usefixtures("few_flights")
def test_planning_starts_from_files_and_tables(default_plan, tmp_path):
    saved = sr.save(default_plan, str(tmp_path / "mine"))
    again = sr.load(sr.save(str(tmp_path / "mine"), tmp_path / "again"))
    assert again.verification == read_solution(saved).verification is not None
    table = np.column_stack([default_plan.times_s, default_plan.states])
    for init in (str(tmp_path / "mine"), saved, table, default_plan):
        found = sr.plan(init=init, facet_rounds=0)
        assert found.total_dv_m_s == pytest.approx(default_plan.total_dv_m_s, rel=1e-4)
    assert found.provenance.init == "a plan"
    with pytest.raises(InputError, match=r"shape \(154, 6\).*shape \(n, 7\): t_s, x_m"):
        sr.plan(init=default_plan.states)
    three = sr.load_scenario().replace({"burns.times_s": [0.0, 8000.0, 34842.0]})
    with pytest.raises(InputError, match=r"^init: got 4 burns; .* 3"):
        sr.plan(three, init=default_plan)


EXACT = sr.load_scenario().replace({"risk.allocation": "exact"})
MEASURED = EXACT.replace(
    {
        "policy.kind": "feedback",
        "navigation.sigma_position_m": 10.0,
        "navigation.sigma_velocity_m_s": 5e-4,
        "grid.step_max_s": 450.0,
    }
)


@pytest.mark.slow
def test_planning_goes_on_from_gains_of_solutions():
    first = sr.plan(MEASURED, certify=False)
    again = sr.plan(init=make_solution(first), certify=False)
    assert [stage.name for stage in again.stages] == ["P2", "P2.held"]
    assert again.cost_m_s == pytest.approx(first.cost_m_s, rel=1e-4)


BAD_CALLS: dict[str, tuple[str, Callable[[Plan, Path], object]]] = {
    "certified maybe": ("certify", lambda *_: sr.plan(EXACT, certify="maybe")),
    "certified by a number": ("certify", lambda *_: sr.plan(EXACT, certify=0)),
    "no problem": ("problem", lambda *_: sr.plan(problem=None)),
    "a solver that is no name": ("solver", lambda *_: sr.plan(solver=1)),
    "rounds in parts": ("facet_rounds", lambda *_: sr.plan(facet_rounds=1.5)),
    "true rounds": ("facet_rounds", lambda *_: sr.plan(facet_rounds=True)),
    "a scenario that is a number": ("scenario", lambda *_: sr.plan(5)),
    "no scenario": ("scenario", lambda *_: sr.plan([])),
    "a scenario for its file": ("scenario", lambda *_: sr.load_scenario(sr.load_scenario())),
    "a change in one text": ("changes", lambda *_: sr.load_scenario().replace("x=1")),
    "no start": ("init", lambda *_: sr.plan(init=None)),
    "a list as start": ("init", lambda *_: sr.plan(init=[[0.0] * 7] * 3)),
    "a start that is no file": ("init lukewarm", lambda *_: sr.plan(init="lukewarm")),
    "words as states": ("init", lambda *_: sr.plan(init=np.array([["0"] * 7] * 3))),
    "states that are not finite": ("init", lambda *_: sr.plan(init=np.full((3, 7), np.nan))),
    "no flights": ("samples", lambda plan, _: sr.fly(plan, samples=0)),
    "too few flights": ("samples", lambda plan, _: sr.fly(plan, samples=1)),
    "flights in parts": ("samples", lambda plan, _: sr.fly(plan, samples=99.5)),
    "a seed below zero": ("seed", lambda plan, _: sr.fly(plan, seed=-1)),
    "a truth": ("truth", lambda plan, _: sr.fly(plan, truth="flat")),
    "errors": ("errors", lambda plan, _: sr.fly(plan, errors="none")),
    "no workers": ("workers", lambda plan, _: sr.fly(plan, workers=0)),
    "a flight of a folder": ("plan", lambda *_: sr.fly(5)),
    "a check of a folder": ("plan", lambda *_: sr.verify(5)),
    "saved nowhere": ("folder", lambda plan, _: sr.save(plan, None)),
    "a report nowhere": ("out", lambda *_: sr.report("runs/mine", out=5)),
    "a camera that sees nothing": ("field_deg", lambda *_: sr.report("runs/mine", field_deg=0)),
    "no pixels": ("pixels", lambda *_: sr.report("runs/mine", pixels=0)),
    "a draft without a name": ("name", lambda *_: sr.new(5, "Bennu", (20.0, 150.0))),
    "a site of one number": ("site", lambda *_: sr.new("x", "Bennu", 20.0)),
    "a campaign nowhere": ("out", lambda *_: campaign("study.toml", None)),
    "a campaign by nobody": ("workers", lambda _, out: campaign({}, out, workers=-1)),
    "a campaign that is a number": ("study", lambda _, out: campaign(3, out)),
    "a campaign of an entry": ("axes", lambda _, out: campaign({"axes": []}, out)),
    "nothing saved": ("plan", lambda _, folder: sr.save(None, folder)),
    "a folder that is a file": ("folder", lambda plan, folder: sr.save(plan, folder / "file")),
    "nothing side by side": ("plans", lambda *_: sr.compare()),
    "none beside a plan": ("plan", lambda plan, _: sr.compare(plan, None)),
}
"""The entry that the message names, and the call."""


def test_whole_numbers_may_be_written_as_floats(default_plan):
    """As on the command line."""
    flown = sr.fly(default_plan, samples=2e1, seed=1.0)
    assert flown == sr.fly(default_plan, samples=20, seed=1)
    options = PlanOptions(starts=4.0, facet_rounds=np.float64(2))
    assert repr(options) == repr(PlanOptions(starts=4, facet_rounds=2))
    for given in (1e4 + 0.5, float("nan"), float("inf"), 1e300):
        with pytest.raises(InputError, match="whole number"):
            sr.fly(default_plan, samples=given)


@pytest.mark.slow
@pytest.mark.parametrize("name", BAD_CALLS)
def test_a_wrong_argument_is_named_before_any_work(name, default_plan, tmp_path, monkeypatch):
    work = raising(AssertionError("work was begun"))
    monkeypatch.setattr(planning.planner, "plan", work)
    for module, done in ((files, "make_solution"), (flying, "summarise")):
        monkeypatch.setattr(module, done, work)
    monkeypatch.setattr(files.reintegration, "verify", work)
    (tmp_path / "file").write_text("x", "utf-8")
    entry, call = BAD_CALLS[name]
    with pytest.raises(InputError) as caught:
        call(default_plan, tmp_path)
    assert caught.value.entry == entry
    assert "--" not in str(caught.value)


def test_flights_are_counted_with_intervals(default_plan):
    flights = sr.fly(default_plan, samples=500, seed=1)
    low, value, high = (
        getattr(flights.probability["emission"], n) for n in ("low", "value", "high")
    )
    assert 0.9 < low < value < high <= 1.0
    assert sr.fly(default_plan, samples=500, seed=1) == flights
    assert repr(flights) == "<Summary: 500 flights, seed 1, planner, componentwise errors>"
    first, *lines = str(flights).splitlines()
    assert first in repr(flights)
    assert len(lines) == len(flights.probability)
    assert any(f"P(emission) {value:.4f}, {low:.4f}" in line for line in lines)


@pytest.mark.usefixtures("few_flights")
def test_results_are_frames_of_pandas(default_plan, solution, monkeypatch):
    """With the very figures, by names with units."""
    pytest.importorskip("pandas")
    for plan in (default_plan, solution):
        np.testing.assert_array_equal(plan.to_frame()[["x_m_s", "y_m_s", "z_m_s"]], plan.burns_m_s)
        assert [*plan.to_frame("constraints")["constraint"]] == [*default_plan.worst_margins]
    path = default_plan.to_frame("path")
    last = path.loc[path["t_s"] == default_plan.times_s[-1], ["x_m", "y_m", "z_m"]]
    np.testing.assert_allclose(last.iloc[0], default_plan.states[-1, :3], atol=0.1)
    flown = sr.fly(default_plan, samples=20)
    found = flown.to_frame().set_index("constraint").loc["emission"]
    assert found["probability"] == flown.probability["emission"].value
    assert found["held_mean_s"] == flown.held_s["emission"].mean.value
    table = sr.compare(solution, solution)
    assert [*table.to_frame()["total delta-v (m/s)"]] == [*table["total delta-v"]]
    assert f"total delta-v (mm/s)  {1e3 * solution.total_dv_m_s:.6g}" in re.sub(
        "  +", "  ", str(table)
    )
    survey = sr.windows("recon_b", span_days=0.2)
    assert [*survey.to_frame()["opens_s"]] == [window.edges_s[0] for window in survey.windows]
    with pytest.raises(InputError, match=r"^table: got 'path'; .* figures"):
        flown.to_frame("path")
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match=r"scp_recon\[notebooks\]"):
        flown.to_frame()


@pytest.mark.parametrize(
    ("name", "unit", "figure", "text"),
    [
        ("margin emission_max", "m", -9e-9, "0"),
        ("margin emission_max", "m", 1e-5, "0"),
        ("margin emission_max", "sigma", -2e-4, "-0.0002"),
        ("margin dv_max", "m/s", 1e-5, "0.01"),
        ("total delta-v", "m", 2e-7, "2e-07"),
        ("farthest from the first", "m", 1e-11, "0"),
        ("farthest from the first", "m", 1.23456789e7, "12345679"),
    ],
)
def test_rounding_counts_as_zero_in_comparisons(name, unit, figure, text):
    compared = Comparison(("one",), ((name, unit, (figure,)),), ())
    assert compared.table.rows[0][1].text == text
    assert compared[name] == (figure,)


def test_flights_are_drawn(default_plan):
    flown = sr.fly(default_plan, samples=200)
    held, lowest = flown.plot(), flown.plot("probability")
    with pytest.raises(InputError, match=r"^chart: got 'budget'; .* held, probability"):
        flown.plot("budget")
    for curve, found in zip(held.data, flown.held_s.values(), strict=True):
        assert curve.y[0] == 100.0
        assert (np.diff(curve.y) <= 0.0).all()
        assert curve.y[-1] == pytest.approx(100.0 * found.throughout.value)
    (marks,) = lowest.data
    values = [one.value for one in flown.probability.values()]
    assert [*marks.y] == [*values, flown.whole_flight.value]
    low = np.array(marks.y) - marks.error_y.arrayminus
    np.testing.assert_allclose(low[:-1], [one.low for one in flown.probability.values()], atol=1e-5)


def test_completion_offers_the_front_door_and_modules():
    offered = dir(sr)
    assert set(sr.__all__) <= set(offered)
    assert {name for name in offered if not ismodule(getattr(sr, name))} == set(sr.__all__)


@pytest.mark.slow
@pytest.mark.usefixtures("few_flights")
def test_plans_stand_side_by_side(default_plan):
    p3 = sr.plan(problem="P3")
    table = sr.compare(default_plan, p3)
    assert table["total delta-v"] == (default_plan.total_dv_m_s, p3.total_dv_m_s)
    assert table["burn 2"][1] == pytest.approx(np.linalg.norm(p3.burns_m_s[1]))
    same, apart = table["farthest from the first"]
    assert same == 0.0
    distance = np.linalg.norm(default_plan.states[:, :3] - p3.states[:, :3], axis=1).max()
    assert apart == pytest.approx(distance)
    assert table["verified"] == ("yes", "yes")
    assert table["p_chance asked of"] == ("every node", None)
    assert "total delta-v" in table._repr_html_()
    assert repr(table) == str(table)
    with pytest.raises(KeyError, match=r"'delta-v'; .* scenario, .*total delta-v"):
        table["delta-v"]


def test_comparison_names_scenario_and_verification(solution, verification):
    """Figures are those of the burns; what stands beside them says how far they can be compared."""
    failed = replace(verification, ok=False, failed=["status", "violation"])
    other = solution.scenario.replace(
        {"name": "later", "safety.radius_min_m": 490.0, "battery.delta_v_cone_deg": 31.0}
    )
    riskier = solution.scenario.replace({"risk.p_chance": 0.6, "safety.radius_min_m": 490.0})
    table = sr.compare(
        solution,
        replace(solution, verification=failed),
        replace(solution, verification=verification, scenario=riskier),
        replace(solution, scenario=other),
    )
    assert table["verified"] == ("not checked", "no: status, violation", "yes", "not checked")
    assert table["scenario"] == ("recon_b", "recon_b", "recon_b", "later")
    assert table["differs from the first in"] == (None, None, "safety, risk", "safety, battery")
    assert set(table["total delta-v"]) == {solution.total_dv_m_s}
    whole = solution.scenario.replace({"risk.scope": "flight", "risk.allocation": "exact"})
    table = sr.compare(solution, replace(solution, scenario=whole))
    assert table["p_chance asked of"] == ("every node", "whole flights")


@nightly
def test_paths_on_different_grids_compare_at_time():
    """The same burns on a grid twice as fine: the path between nodes is a cubic of its states."""
    fine = sr.plan(
        sr.load_scenario("recon_b").replace({"grid.step_max_s": 116.0}), init="cold", problem="P3"
    )
    coarse = sr.plan(problem="P3")
    apart = sr.compare(coarse, fine)["farthest from the first"][1]
    difference = np.abs(coarse.burns_m_s - fine.burns_m_s).max()
    assert isinstance(apart, float)
    assert apart < 0.02 + 60_000.0 * difference


@pytest.mark.slow
@pytest.mark.usefixtures("few_flights")
def test_a_campaign_gives_a_table_and_figures(tmp_path):
    study = {"axis": [{"entry": "risk.p_chance", "values": [0.7, 0.75]}]}
    table, figures = sr.campaign(study, tmp_path, workers=0)
    assert list(table["risk.p_chance"]) == [0.7, 0.75]
    assert list(table["verdict"]) == ["verified"] * 2
    assert table["total_dv_m_s"][0] == pytest.approx(0.125660, abs=2e-6)
    assert table["total_dv_m_s"][1] > table["total_dv_m_s"][0]
    assert list(figures) == ["dv99_m_s", "probability"]
    again, _ = sr.campaign(study, tmp_path, workers=0)
    assert again.equals(table)
    assert sr.read_campaign(str(tmp_path)).equals(table)
    with pytest.raises(InputError, match="without rows"):
        sr.read_campaign(str(tmp_path / "none"))
