"""Time the parts of an iteration by pytest-benchmark: `python -m pytest benchmarks/micro.py`."""

from __future__ import annotations

from typing import Any

import pytest

from formulations.linearisation.linearisation import Linearisation, condense
from formulations.registry import make_subproblem
from formulations.rows.uniform import ChanceRows
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import run_block
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario


@pytest.fixture(scope="module")
def mission() -> Mission:
    return Mission.from_scenario(load_scenario())


@pytest.fixture(scope="module")
def planned(mission: Mission) -> Plan:
    return plan(mission, initial_guess.cold(mission))


def fresh(lin: Linearisation) -> Linearisation:
    """Without what it remembers."""
    return Linearisation(lin.problem, lin.iterate, lin.arcs)


def test_first_derivatives_of_all_arcs(benchmark: Any, mission: Mission, planned: Plan) -> None:
    benchmark(mission.flow.differentiate, planned.final.result.lin.iterate.mean[:-1])


def test_second_derivatives_of_all_arcs(benchmark: Any, mission: Mission, planned: Plan) -> None:
    mean = planned.final.result.lin.iterate.mean[:-1]
    benchmark(lambda: mission.flow.differentiate(mean).tensor)


def test_condense(benchmark: Any, planned: Plan) -> None:
    nodes = planned.final.merit.rows.nodes
    benchmark(lambda: condense(fresh(planned.final.result.lin), nodes))


def test_cones_of_p2(benchmark: Any, planned: Plan) -> None:
    rows, lin = planned.final.merit.rows, planned.final.result.lin
    assert isinstance(rows, ChanceRows)
    sensitivity = condense(lin, rows.nodes)
    benchmark(rows.cones, lin, sensitivity)


@pytest.mark.parametrize("stage", [0, -1], ids=["P3", "P2"])
def test_solve_a_subproblem(benchmark: Any, planned: Plan, stage: int) -> None:
    chosen = planned.stages[stage]
    subproblem = make_subproblem(chosen.merit.problem, chosen.merit.rows)
    subproblem.update(chosen.result.lin)
    benchmark(subproblem.solve, 1.0, 10.0)


def test_fly_a_step(benchmark: Any, mission: Mission, planned: Plan) -> None:
    lin = planned.stages[0].result.lin
    benchmark(mission.dynamics.close_defects, lin, planned.final.result.lin.iterate.burns)


def test_fly_a_thousand_samples(benchmark: Any, mission: Mission, planned: Plan) -> None:
    burns = planned.final.result.lin.iterate.burns * mission.units.speed_m_s
    benchmark(run_block, Flyer(mission, burns), (0, 1000))
