"""Variations of P2: rows are what their cases describe, and tables follow from rows."""

import numpy as np
import pytest

from experiments.solvers.cases import PTR, REFERENCE, SHOOTING
from experiments.solvers.cells import posed
from experiments.solvers.variations import (
    ENOUGH,
    FACTORS,
    Begun,
    begin_p2,
    dynamics_weight,
    parameter_row,
    reached,
    stopped_row,
    with_errors,
)
from formulations.program import model, subproblem
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Planner

pytestmark = pytest.mark.slow

CHEAP = "replan"


@pytest.fixture(scope="module")
def begun() -> dict[str, Begun]:
    return {"recon_b": begin_p2("recon_b")}


@pytest.mark.parametrize("method", [REFERENCE, SHOOTING, PTR])
def test_stopped_runs_lead_to_one_optimum(begun, method):
    first, whole = (stopped_row(begun, ("recon_b", method, most)) for most in (1, ENOUGH))
    assert (first["iterations"], first["ended"]) == (1, False)
    assert 1 < whole["iterations"] < ENOUGH
    assert whole["ended"]
    assert whole["merit_m_s"] == pytest.approx(0.1401353, rel=2e-6)  # the default plan's
    assert first["merit_m_s"] > (1.0 + 1e-6) * whole["merit_m_s"]


def run_of(method: str, iterations: int, merit: float, *, ended: bool = False) -> dict[str, object]:
    seconds = {"processor_s": 0.1 * iterations, "merit_m_s": merit}
    return {"problem": "p", "method": method, "iterations": iterations, "ended": ended} | seconds


def test_near_counts_where_a_method_stays():
    rows = [
        *(run_of("a", 1, 1.005), run_of("a", 2, 1.5), run_of("a", 3, 1.005)),
        run_of("a", 4, 1.0, ended=True),
        *(run_of("b", 1, 0.99), run_of("b", 2, 1.02, ended=True)),
    ]
    rows[0]["processor_s"] = 0.35  # lengthened by other work
    found = with_errors(rows)
    a, b = reached(found)
    assert found.processor_s[0] == pytest.approx(0.2)
    assert [a["iterations"], b["iterations"]] == [4, 2]
    assert a["within_1e2_s"] == pytest.approx(0.3)
    assert a["within_1e6_s"] == a["end_s"] == pytest.approx(0.4)
    assert a["end_error"] == 0.0
    assert np.isnan(b["within_1e2_s"])
    assert b["end_error"] == pytest.approx(0.02)


@pytest.fixture(scope="module")
def usual() -> dict[str, object]:
    """The row of the default plan."""
    return parameter_row((CHEAP, "scvx", "penalty weight", 1.0))


@pytest.mark.parametrize("name", FACTORS)
def test_every_factor_reaches_the_loop(name, usual):
    row = parameter_row((CHEAP, "scvx", name, 0.01))
    assert row["iterations_p3"] > usual["iterations_p3"]
    assert row["total_dv_m_s"] == pytest.approx(usual["total_dv_m_s"], rel=1e-4)


def test_dynamics_weight_holds_within_its_context():
    mission = posed(CHEAP)
    start = initial_guess.cold(mission)
    merit = Planner(mission).plan(start, problem="P3").stages[0].merit
    lin = mission.dynamics.linearise(merit.problem, start)
    missed, rows = abs(lin.defects).sum(), merit(lin, 1.0)
    with dynamics_weight(0.5):
        assert merit(lin, 1.0) == pytest.approx(rows - (10.0 - 0.5) * missed)
        assert vars(model)["DYNAMICS_WEIGHT"] == 0.5
    assert vars(model)["DYNAMICS_WEIGHT"] == subproblem.DYNAMICS_WEIGHT == 10.0
    assert merit(lin, 1.0) == rows
