"""A campaign's folder: whose it is, a table that is whole or not there; studies that are shown."""

import functools
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import pyarrow
import pytest

from scp_recon.api import campaigns
from scp_recon.api.campaigns import work_of
from scp_recon.api.planning import PlanOutcome
from scp_recon.campaigns import run as run_module
from scp_recon.campaigns import study as study_module
from scp_recon.campaigns.axes import Axis, Case
from scp_recon.campaigns.run import (
    FILE_NAME,
    RESULTS,
    ROWS,
    Observer,
    cell,
    read_results,
    run_study,
)
from scp_recon.campaigns.study import Campaign, Do, Study, kind_of
from scp_recon.errors import InputError
from scp_recon.jobs import store
from scp_recon.jobs.job import Executor, here
from scp_recon.jobs.store import Row
from scp_recon.results.solution import make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from tests.helpers import nightly
from tests.scenarios import COARSE
from tests.scp_recon.campaigns.shown import table_of
from tests.scp_recon.support import raising

STUDY = Study(
    Campaign(), load_scenario(), ([{"risk.p_chance": 0.1 * i} for i in range(9)],), Path(), {}
)


def work(case: Case) -> Row:
    """Depends on seed and changes to the last bit; every fourth case is refused."""
    if case.number % 4 == 3:
        raise InputError("x", "0", "must be more")
    value = (case.seed % 1_003) / 7.0 * case.changes["risk.p_chance"]
    return Row({"status": "converged", "total_dv_m_s": value})


def run(folder: Path, executor: Executor = here, observe: Observer | None = None) -> pyarrow.Table:
    run_study(STUDY, folder, work, executor, observe)
    return table_of(folder)


def test_two_campaigns_in_one_folder_are_refused(tmp_path, monkeypatch):
    def again(*_: object) -> None:
        with pytest.raises(InputError, match="at work"):
            run(tmp_path)

    run(tmp_path, here, again)
    with pytest.raises(InputError, match=r"holds another campaign"):
        run_study(replace(STUDY, campaign=Campaign(seed=1)), tmp_path, work, here)
    for module in (study_module, run_module):
        monkeypatch.setattr(module, "VERSION", 3)
    with pytest.raises(InputError, match="version 3"):
        run_study(replace(STUDY), tmp_path, work, here)


def test_folder_of_something_else_is_refused(tmp_path):
    """A table that was copied there would pass for this study's."""
    for left in (RESULTS, ROWS):
        (tmp_path / left).write_bytes(b"")
        with pytest.raises(InputError, match=f"with {left} but no campaign.json; must be a folder"):
            run(tmp_path)
        (tmp_path / left).unlink()
    with pytest.raises(InputError, match="must hold a campaign"):
        read_results(tmp_path)
    for text in ("{", "[]", '{"schema": "scp_recon.campaign/0"}'):
        (tmp_path / FILE_NAME).write_text(text)
        with pytest.raises(InputError, match="is damaged"):
            run(tmp_path)


def test_finished_campaign_is_not_run_again(tmp_path, monkeypatch):
    """Nor with other versions of the packages."""
    seen: list[tuple[Any, ...]] = []
    first = run(tmp_path)
    monkeypatch.setattr(store, "version_of", lambda _: "99.0")
    assert run(tmp_path, raising(AssertionError()), lambda *told: seen.append(told)).equals(first)
    assert seen == [(9, 9, None)]


def test_table_is_written_whole_or_not_at_all(tmp_path):
    """Whatever an executor leaves out."""
    with pytest.raises(RuntimeError, match="2 rows of 9 cases"):
        run(tmp_path, lambda work, jobs: here(work, list(jobs)[:2]))
    assert not (tmp_path / RESULTS).exists()
    assert len(run(tmp_path)) == 9


@pytest.mark.parametrize(
    ("values", "cells"),
    [
        ([1, 2.5], [1.0, 2.5]),
        ([True, False], [True, False]),
        ([1, True], ["1", "true"]),
        (["paper", 24, [1.5, "x"]], ["paper", "24", '[1.5, "x"]']),
    ],
)
def test_a_column_holds_all_values_of_an_entry(values, cells):
    found = [cell(value, kind_of(values)) for value in values]
    assert found == cells
    assert list(map(type, found)) == list(map(type, cells))


@pytest.mark.slow
@pytest.mark.parametrize("do", get_args(Do))
def test_case_follows_the_do_of_its_study(do, default_plan, verification, monkeypatch):
    """With its own seed; only what is to be certified is planned so."""
    certified: list[bool] = []

    outcome = PlanOutcome(default_plan, make_solution(default_plan).with_verification(verification))

    def planned(_: Scenario, *, certify: bool) -> PlanOutcome:
        certified.append(certify)
        return outcome

    ways = {"certify": "certified_row", "fly": "flown_row", "simulate": "simulated_row"}
    ways["replan"] = "rest_row"
    for name in ways.values():
        monkeypatch.setattr(campaigns, name, lambda *given, name=name: {"done": (name, given)})
    monkeypatch.setattr(campaigns, "planned", planned)
    monkeypatch.setattr(campaigns, "designed", lambda _: (outcome, {}))
    monkeypatch.setattr(campaigns, "check_do", lambda *_: None)
    row = campaigns.StudyWork(load_scenario(), Path(), Campaign(do=do))(Case(0, 7, {})).values
    assert certified == ([] if do == "design" else [do == "certify"])
    way, given = row.get("done", (None, ()))
    assert way == ways.get(do)
    seeds = [7 for one in given if one == 7 or getattr(one, "seed", None) == 7]
    assert len(seeds) == (do in ("fly", "simulate"))


@pytest.mark.slow
def test_campaigns_sweep_free_times_of_the_rest():
    base = load_scenario(None, [COARSE])
    times = Axis(entry="campaign.free_times", values=(False, True)).rows(base, ())
    work = campaigns.StudyWork(base, Path(), Campaign(do="replan", at_s=2000.0))
    given, free = (work(Case(i, 0, row)).values for i, row in enumerate(times))
    assert given["rest_status"] == free["rest_status"] == "converged"
    assert free["rest_dv_m_s"] < 0.995 * given["rest_dv_m_s"] < given["total_dv_m_s"]
    assert given["rest_times_s"] == "8000.0 25000.0 34842.0" != free["rest_times_s"]


STUDIES = Path(__file__).parents[3] / "examples" / "studies"
SIZES = {"reconnaissance_map": 324, "errors": 64, "sizes": 24, "navigation": 6}


@functools.cache
def study_of(name: str) -> Study:
    return Study.validated(tomllib.loads((STUDIES / f"{name}.toml").read_text("utf-8")))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "cases"), SIZES.items())
def test_a_study_that_is_shown_can_be_run(name, cases):
    assert len(study_of(name).cases) == cases


def test_the_year_takes_a_window_of_so_many():
    tables = tomllib.loads((STUDIES / "asteroid_year.toml").read_text("utf-8"))
    axis = tables["axis"][0]["windows"]
    assert axis["span_days"] == pytest.approx(436.65, abs=0.1)  # Bennu's year
    # A window a rotation, of 4.2957 h; the search of a whole year takes half a minute.
    tables["axis"][0]["windows"] = axis | {"span_days": 10.0, "every": 20}
    cases = Study.validated(tables).cases
    assert len(cases) == round(10.0 * 24.0 / 4.2957 / 20.0)


def test_dark_site_is_refused_with_its_reason():
    study = study_of("reconnaissance_map")
    dark = next(case for case in study.cases if case.changes["site.latitude_deg"] < -70.0)
    with pytest.raises(ValueError, match="lighting window"):
        work_of(study)(dark)
    assert {path.stem for path in STUDIES.glob("*.toml")} == {*SIZES, "asteroid_year", "ryugu_map"}


@nightly
@pytest.mark.slow
@pytest.mark.usefixtures("few_flights")
def test_a_case_is_flown_by_the_campaigns_policy():
    """Planned again, it ends nearer to where it is to than its gains alone bring it, at its cost."""
    tables = tomllib.loads((STUDIES / "navigation.toml").read_text("utf-8"))
    quick = {"grid.step_max_s": 450.0, "policy.cost": "nominal"}
    tables["campaign"] |= {"samples": 20, "policy": "replan", "overrides": quick}
    study = Study.validated(tables)
    row = work_of(study)(study.cases[4]).values
    assert row["status"] == "converged"
    assert row["total_dv_m_s"] < row["dv99_m_s"] < row["flown_dv99_m_s"]
    assert row["flown_final_sigma_m"] < 0.5 * row["final_sigma_m"]
