"""Facts are stored once: figures follow from them, and `verify` names those that do not.

`stored` holds files on very coarse grids, as an earlier version of the planner found them.
"""

import json
import pickle
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scp_recon.results.figures import Figures
from scp_recon.results.read import parse_solution, read_solution
from scp_recon.results.solution import Solution
from scp_recon.verification.reintegration import verify

STORED = Path(__file__).parent / "stored"
Data = dict[str, Any]


@pytest.fixture(params=["facets", "exact", "infeasible"])
def stored(request) -> Data:
    """A file that an earlier version wrote, as it stands."""
    data: Data = json.loads((STORED / f"{request.param}.json").read_text("utf-8"))
    return data


def parsed(data: Data) -> Solution:
    return parse_solution(data, "solution")


def read(data: Data, folder: Path) -> Solution:
    file = folder / "given.json"
    file.write_text(json.dumps(data), "utf-8")
    return read_solution(file)


def failures(data: Data, folder: Path) -> list[str]:
    """What `verify` names of a file."""
    found = read(data, folder)
    return verify(found.mission, found).failed


def assert_agree(one: Figures, other: Figures) -> None:
    assert one.total_dv_m_s == pytest.approx(other.total_dv_m_s, rel=1e-12)
    for first, second in zip(one.constraints, other.constraints, strict=True):
        assert first.worst_margin == pytest.approx(second.worst_margin, abs=1e-9)
        assert replace(first, worst_margin=0.0) == replace(second, worst_margin=0.0)
    assert one.violation.max == pytest.approx(other.violation.max, rel=1e-9)
    assert one.violation.total == pytest.approx(other.violation.total, rel=1e-9)
    assert one.violation.by_constraint.keys() == other.violation.by_constraint.keys()


def test_carried_figures_follow_from_the_facts(stored, tmp_path):
    """Those that a file carries were the planner's own."""
    found = read(stored, tmp_path)
    assert_agree(found.figures, found.carried)
    assert not any("solution" in str(warning) for warning in found.warnings)
    assert found.plan_hash == stored["plan_hash"]
    assert json.loads(found.text()).keys() == stored.keys() | {"without_uncertainty"}


@pytest.mark.usefixtures("few_flights")
def test_verify_agrees_with_the_stored_verdict(stored, tmp_path):
    assert failures(stored, tmp_path) == stored["verification"]["failed"]


@pytest.mark.usefixtures("few_flights")
def test_verify_names_every_wrong_figure(stored, tmp_path):
    failed, figures = stored["verification"]["failed"], parsed(stored).figures
    stored["constraints"][-1].update(worst_margin=99.0)
    stored.update(total_dv_m_s=0.999 * stored["total_dv_m_s"])
    stored["violation"].update(total=1.0 + stored["violation"]["total"])
    assert set(failures(stored, tmp_path)) == {
        *("constraints", "total_dv_m_s", "violation"),
        *failed,
    }
    assert read(stored, tmp_path).figures == figures  # whatever the file carries


@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize("stored", ["exact"], indirect=True)
@pytest.mark.parametrize(
    "change",
    [
        lambda r: r["normal_law"][0]["probability"].__setitem__(0, 0.5),
        lambda r: r.update(asked=r["asked"] - 1e-6),
        lambda r: r.update(scope="flight"),
    ],
)
def test_verify_names_a_wrong_risk(stored, change, tmp_path):
    change(stored["risk"])
    assert "risk" in failures(stored, tmp_path)


@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize(
    ("stored", "status", "last_stage", "named"),
    [
        ("facets", "stalled", "converged", ["status"]),
        ("infeasible", "converged", "infeasible", ["status", "violation"]),
        ("infeasible", "converged", "converged", ["violation"]),
    ],
    indirect=["stored"],
)
def test_verify_names_a_refuted_status(stored, status, last_stage, named, tmp_path):
    """No stage ended so, or violations refute it."""
    stored["status"] = status
    stored["stages"][-1]["status"] = last_stage
    assert set(named) <= set(failures(stored, tmp_path))


def test_infinity_is_not_written(stored, tmp_path):
    solution = parsed(stored)
    diverged = replace(solution.iterations[0], merit=np.inf)
    with pytest.raises(ValueError, match="not JSON compliant"):
        replace(solution, iterations=[diverged]).write(tmp_path, "diverged.json")
    assert not (tmp_path / "diverged.json").exists()


def test_a_pickled_copy_computes_figures_again(stored):
    solution = parsed(stored)
    figures, copy = solution.figures, pickle.loads(pickle.dumps(solution))
    assert copy == solution
    assert vars(copy).keys().isdisjoint({"mission", "figures"})
    assert copy.figures == figures


def test_a_scenario_lists_its_own_names_alone(stored):
    scenario = parsed(stored).scenario
    for shown in (scenario, scenario.risk):
        assert {"replace", "p_chance"} & {*dir(shown)}
        assert not {*dir(shown)} & {"model_dump", "model_fields", "copy", "json"}


def test_timing_adds_up(solution):
    parts = asdict(solution.timing_s)
    assert parts.pop("total") == pytest.approx(sum(parts.values()))
    assert min(parts.values()) >= 0.0
    solver = sum(i.solver_s for i in solution.iterations)
    assert parts["conic_solver"] == pytest.approx(solver)


def test_every_constraint_has_its_worst_margin(mission, solution):
    named = {c.name: c for c in solution.constraints}
    assert set(named) == {"dv_max", "dv_battery", *(c.name for c in mission.problem.constraints)}
    assert all(c.worst_margin >= -2e-3 for c in named.values())  # a millimetre
    in_window = [c for name, c in named.items() if not name.startswith(("dv_", "safety"))]
    first, last = mission.schedule.window_s
    assert all(first <= c.worst_t_s <= last for c in in_window)
    facets = {"site_distance_max": 24, "emission_max": 4, "site_distance_min": 1}
    assert {name: named[name].facets for name in facets} == facets
    sizes = np.linalg.norm(solution.burns_m_s, axis=1)
    assert named["dv_max"].unit == "m/s"
    assert named["dv_max"].worst_margin == pytest.approx(0.2 - sizes.max())
    assert named["dv_max"].worst_t_s == solution.burns[int(np.argmax(sizes))].t_s
    kinds = {name: c.kind for name, c in named.items()}
    assert kinds["emission_max"] == "keep_in"
    assert kinds["safety_radius"] == kinds["phase_min"] == "keep_out"
    assert kinds["dv_max"] == "burn"


def test_the_primer_is_known_at_every_node(solution):
    primer = solution.primer
    assert primer.t_s == solution.nodes.t_s
    assert np.all(np.array(primer.allowed) <= np.linalg.norm(primer.vector, axis=1) + 1e-12)
    assert primer.residual < 1e-3
    assert not any(primer.legal)  # four burns leave none of the default flight's gaps to a fifth
