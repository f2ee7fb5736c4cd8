"""Sensitivity: a row is a plan by its parameters, each of which reaches the loop."""

import pytest

from experiments.solvers.cases import PROBLEMS
from experiments.solvers.sensitivity import (
    FACTORS,
    VARIED,
    by_value,
    compared,
    dynamics_weight,
    measure,
)
from formulations.program import model, subproblem
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Planner
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.algorithms import SCvx

CHEAP = "replan"


@pytest.fixture(scope="module")
def usual() -> dict[str, object]:
    """The row of the default plan."""
    return measure((CHEAP, "scvx", "penalty weight", 1.0))


@pytest.fixture(scope="module")
def mission() -> Mission:
    base, overrides = PROBLEMS[CHEAP]
    return Mission.from_scenario(load_scenario(base, overrides))


def test_a_row_is_what_a_plan_by_its_parameters_gives(mission, usual):
    start = initial_guess.cold(mission)
    assert usual["total_dv_m_s"] == Planner(mission).plan(start).total_dv_m_s
    planner = Planner(mission)
    planner.algorithm = SCvx(weight=0.1)
    plan, row = planner.plan(start), measure((CHEAP, "scvx", "penalty weight", 0.01))
    assert row["status"] == plan.status.value.name == "converged"
    assert row["total_dv_m_s"] == plan.total_dv_m_s
    iterations = [stage.name[:2] for stage in plan.stages for _ in stage.result.records]
    assert row["iterations_p3"] == iterations.count("P3") > usual["iterations_p3"]
    assert row["iterations_p2"] == iterations.count("P2")
    assert row["value_si"] == pytest.approx(0.1 * mission.units.speed_m_s / mission.units.length_m)


@pytest.mark.parametrize("name", FACTORS)
def test_every_factor_reaches_the_loop(name, usual):
    row = measure((CHEAP, "scvx", name, 0.01))
    assert row["iterations_p3"] > usual["iterations_p3"]
    assert row["total_dv_m_s"] == pytest.approx(usual["total_dv_m_s"], rel=1e-4)


def test_the_dynamics_weight_is_that_of_program_and_merit_and_then_the_usual_one(mission):
    start = initial_guess.cold(mission)
    plan = Planner(mission).plan(start, problem="P3")
    merit = plan.stages[0].merit
    lin = mission.dynamics.linearise(merit.problem, start)
    missed, rows = abs(lin.defects).sum(), merit(lin, 1.0)
    with dynamics_weight(0.5):
        assert merit(lin, 1.0) == pytest.approx(rows - (10.0 - 0.5) * missed)
        assert vars(model)["DYNAMICS_WEIGHT"] == 0.5
    assert vars(model)["DYNAMICS_WEIGHT"] == subproblem.DYNAMICS_WEIGHT == 10.0
    assert merit(lin, 1.0) == rows


def row(problem: str, multiple: float, dv: float, status: str = "converged") -> dict[str, object]:
    return {
        "problem": problem,
        "algorithm": VARIED[0],
        "factor": "penalty weight",
        "multiple": multiple,
        "value": 10.0 * multiple,
        "status": status,
        "total_dv_m_s": dv,
        "iterations_p3": 7,
        "iterations_p2": 4,
    }


def test_a_value_has_one_row_and_what_is_no_plan_is_not_the_best():
    rows = [row("a", 1.0, 0.2), row("b", 1.0, 0.4), row("a", 0.1, 0.25)]
    rows.append(row("b", 0.1, 0.1, "max_iterations"))
    assert [one["off"] for one in compared(rows)] == pytest.approx([0.0, 0.0, 0.25, -0.75])
    first, second = by_value(rows)
    assert (first["value"], first["a"], first["b"]) == (
        10.0,
        "0.200000 (7 + 4)",
        "0.400000 (7 + 4)",
    )
    assert (second["multiple"], second["b"]) == (0.1, "max iterations (7 + 4)")
