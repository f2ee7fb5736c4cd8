"""The studies that the documents show: each can be run, and is as large as is said."""

from __future__ import annotations

import functools
import tomllib
from pathlib import Path

import pytest

from scp_recon.api.campaigns import work_of
from scp_recon.campaigns.study import Study

STUDIES = Path(__file__).parents[3] / "examples" / "studies"
SIZES = {"reconnaissance_map": 324, "errors": 64, "sizes": 24, "navigation": 6}


@functools.cache
def study_of(name: str) -> Study:
    return Study.validated(tomllib.loads((STUDIES / f"{name}.toml").read_text("utf-8")))


@pytest.mark.parametrize(("name", "cases"), SIZES.items())
def test_a_study_that_is_shown_can_be_run(name: str, cases: int) -> None:
    assert len(study_of(name).cases) == cases


def test_the_year_takes_a_window_of_so_many() -> None:
    tables = tomllib.loads((STUDIES / "asteroid_year.toml").read_text("utf-8"))
    axis = tables["axis"][0]["windows"]
    assert axis["span_days"] == pytest.approx(436.65, abs=0.1)  # Bennu's year
    # A window a rotation, of 4.2957 h; the search of a whole year takes half a minute.
    tables["axis"][0]["windows"] = axis | {"span_days": 10.0, "every": 20}
    cases = Study.validated(tables).cases
    assert len(cases) == round(10.0 * 24.0 / 4.2957 / 20.0)


def test_a_site_in_the_dark_is_refused_with_its_reason() -> None:
    study = study_of("reconnaissance_map")
    dark = next(case for case in study.cases if case.changes["site.latitude_deg"] < -70.0)
    with pytest.raises(ValueError, match="lighting window"):
        work_of(study)(dark)
    assert {path.stem for path in STUDIES.glob("*.toml")} == {*SIZES, "asteroid_year"}


@pytest.mark.usefixtures("few_flights")
def test_a_case_is_flown_by_the_campaigns_policy() -> None:
    """Planned again, it ends nearer to where it is to than its gains alone bring it, at its cost."""
    tables = tomllib.loads((STUDIES / "navigation.toml").read_text("utf-8"))
    quick = {"grid.step_max_s": 450.0, "policy.cost": "nominal"}
    tables["campaign"] |= {"samples": 20, "policy": "replan", "overrides": quick}
    study = Study.validated(tables)
    row = work_of(study)(study.cases[4]).values
    assert row["status"] == "converged"
    assert row["total_dv_m_s"] < row["dv99_m_s"] < row["flown_dv99_m_s"]
    assert row["flown_final_sigma_m"] < 0.5 * row["final_sigma_m"]
