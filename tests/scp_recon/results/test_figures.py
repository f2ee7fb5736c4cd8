"""Facts are stored once: figures follow from them, and a file that says otherwise is not believed.

`older` holds files of `scp_recon.solution/2` on very coarse grids, as that version wrote them.
"""

import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scp_recon.results.figures import FINAL_STATE, Figures
from scp_recon.results.read import parse_solution, read_solution
from scp_recon.results.solution import SCHEMA, Solution
from scp_recon.verification.reintegration import verify

OLDER = Path(__file__).parent / "older"
Data = dict[str, Any]


@pytest.fixture(params=["facets", "exact", "infeasible"])
def older(request) -> Data:
    """A file of the second schema, as it stands."""
    data: Data = json.loads((OLDER / f"{request.param}.json").read_text("utf-8"))
    assert data["schema"] == "scp_recon.solution/2"
    return data


@pytest.fixture
def written(older, tmp_path) -> Data:
    """The same plan as this version writes it."""
    return json.loads(parsed(older).write(tmp_path).read_text("utf-8"))


def parsed(data: Data) -> Solution:
    return parse_solution(data, "solution")


def read(data: Data, folder: Path) -> Solution:
    file = folder / "given.json"
    file.write_text(json.dumps(data), "utf-8")
    return read_solution(file)


def assert_agree(one: Figures, other: Figures) -> None:
    assert one.total_dv_m_s == pytest.approx(other.total_dv_m_s, rel=1e-12)
    for first, second in zip(one.constraints, other.constraints, strict=True):
        assert first.worst_margin == pytest.approx(second.worst_margin, abs=1e-9)
        assert replace(first, worst_margin=0.0) == replace(second, worst_margin=0.0)
    assert one.violation.max == pytest.approx(other.violation.max, rel=1e-9)
    assert one.violation.total == pytest.approx(other.violation.total, rel=1e-9)
    assert one.violation.by_constraint.keys() == other.violation.by_constraint.keys()


def keys_of(data: Any, path: str = "") -> set[str]:
    """Every key of a file with those that lead to it."""
    inner = data.items() if isinstance(data, dict) else [("", x) for x in data]
    below = [(f"{path}.{key}", value) for key, value in inner]
    return {name for name, _ in below}.union(
        *(keys_of(value, name) for name, value in below if isinstance(value, dict | list))
    )


@pytest.mark.parametrize("number", [1, 2, 3])
def test_the_figures_of_an_older_file_follow_from_its_facts(older, number, tmp_path):
    """Those that it carries were the planner's own."""
    data = older | {"schema": f"scp_recon.solution/{number}"}
    if number == 1:
        for one in data["constraints"]:
            one["worst_margin_m_or_rad"] = one.pop("worst_margin")
    found = read(data, tmp_path)
    assert found.carried is not None
    assert_agree(found.figures, found.carried)
    assert not any("solution" in str(warning) for warning in found.warnings)
    assert found.plan_hash == older["plan_hash"]


@pytest.mark.usefixtures("few_flights")
def test_an_older_file_is_verified_as_it_was(older, tmp_path):
    found = read(older, tmp_path)
    assert found.verification.failed == older["verification"]["failed"]
    assert verify(found.mission, found).failed == found.verification.failed


def test_written_again_it_is_a_file_of_today(older, written, tmp_path):
    assert written["schema"] == SCHEMA
    assert keys_of(older) - {".scenario.schedule.decision_lead_s"} <= keys_of(written)
    assert read(written, tmp_path) == parsed(older)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda d: d["constraints"][-1].update(worst_margin=99.0), "constraints"),
        (lambda d: d.update(total_dv_m_s=0.999 * d["total_dv_m_s"]), "total_dv_m_s"),
        (lambda d: d["violation"].update(total=1.0 + d["violation"]["total"]), "violation"),
    ],
)
def test_a_figure_that_does_not_follow_from_the_facts_is_not_believed(
    written, change, named, tmp_path
):
    failed = written["verification"]["failed"]
    change(written)
    found = read(written, tmp_path)
    assert not found.verification.ok
    assert found.verification.failed == [named, *failed]
    assert f"{named} that do not follow" in str(found.warnings[-1])
    assert found.figures == parsed(written).figures  # whatever the file carries


@pytest.mark.parametrize("older", ["exact"], indirect=True)
@pytest.mark.parametrize(
    "change",
    [
        lambda r: r["normal_law"][0]["probability"].__setitem__(0, 0.5),
        lambda r: r.update(asked=r["asked"] - 1e-6),
        lambda r: r.update(scope="flight"),
    ],
)
def test_a_risk_that_is_not_its_quantiles_or_not_the_scenarios_is_named(written, change, tmp_path):
    change(written["risk"])
    found = read(written, tmp_path)
    assert found.verification.failed[0] == "risk"


@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize(
    ("older", "status", "last_stage", "named"),
    [
        ("facets", "stalled", "converged", "status"),
        ("infeasible", "converged", "infeasible", "status, violation"),
        ("infeasible", "converged", "converged", "violation"),
    ],
    indirect=["older"],
)
def test_a_status_that_no_stage_ended_with_or_that_violations_refute_is_named(
    written, status, last_stage, named, tmp_path
):
    written["status"] = status
    written["stages"][-1]["status"] = last_stage
    found, failed = read(written, tmp_path), named.split(", ")
    assert found.verification.failed[: len(failed)] == failed
    assert set(failed) <= set(verify(found.mission, found).failed)
    assert f"{named} that do not follow" in str(found.warnings[-1])


def test_a_final_state_that_was_told_in_sigmas_is_one_in_metres(tmp_path):
    data = json.loads((OLDER / "infeasible.json").read_text("utf-8"))
    length = data["units"]["length_m"]
    data["nodes"]["state"][-1][0] += 0.1 * length
    whole, parts = data["violation"], data["violation"]["by_constraint"]
    parts[FINAL_STATE] = {"max": 0.1, "total": 0.2, "unit": "sigma"}  # its arc misses it too
    whole["total"] += 0.2 * length
    carried = parsed(data).carried
    assert carried.violation.by_constraint[FINAL_STATE].unit == "m"
    found = read(data, tmp_path)
    assert found.violation.by_constraint[FINAL_STATE].max == pytest.approx(0.1 * length, rel=1e-3)


def test_what_is_not_finite_is_not_written(written, tmp_path):
    solution = parsed(written)
    diverged = replace(solution.iterations[0], merit=np.inf)
    with pytest.raises(ValueError, match="not JSON compliant"):
        replace(solution, iterations=[diverged]).write(tmp_path, "diverged.json")
    assert not (tmp_path / "diverged.json").exists()


def test_a_copy_computes_its_figures_again_and_a_scenario_shows_its_own_names_alone(written):
    solution = parsed(written)
    figures, copy = solution.figures, pickle.loads(pickle.dumps(solution))
    assert copy == solution
    assert vars(copy).keys().isdisjoint({"mission", "figures"})
    assert copy.figures == figures
    for shown in (solution.scenario, solution.scenario.risk):
        assert {"replace", "p_chance"} & {*dir(shown)}
        assert not {*dir(shown)} & {"model_dump", "model_fields", "copy", "json"}
