"""IPOPT's reference with uncertain parameters: rows and plans of the convex side."""

from typing import Any

import numpy as np
import pytest

from formulations.nlp.program import Start
from formulations.nlp.shooting import SingleShooting
from formulations.rows.uniform import ChanceRows
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess, ipopt
from scp_recon.planning.ipopt import IpoptPlanner, casadi_arcs
from scp_recon.planning.plan import Plan
from scp_recon.planning.solver import unobserved
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status
from tests.scp_recon.support import from_cold

KNOWN: dict[str, Any] = {
    "body": {"gm_m3_s2": 0.2, "j2": 0.002, "prime_meridian_deg": 1.0},
    "spacecraft": {"reflectivity_coefficient": 0.1},
    "site": {"position_body_m": [2.0, 3.0, 1.0], "normal_body": [0.02, 0.02, 0.01]},
}
"""Path and regions move, these with turns too: 10 numbers."""


def mission_with(**changes: Any) -> Mission:
    scenario = load_scenario().replace({"grid.step_max_s": 900.0, **changes})
    return Mission.from_scenario(scenario.replace({"knowledge": KNOWN}))


@pytest.fixture(scope="module")
def plan() -> Plan:
    return from_cold(mission_with(), facet_rounds=0)


@pytest.mark.slow
def test_rows_have_the_parameters_of_the_convex_side(plan):
    mission, lin, facets = plan.mission, plan.final.result.lin, plan.final.facets
    every = ChanceRows(mission.problem, facets, np.ones(len(facets.node), dtype=bool))
    start = Start(lin.iterate, lin.factor)
    arcs = casadi_arcs(mission.flow)
    program = SingleShooting()(mission.problem, arcs, facets, start, elastic=False)
    rows = program.residuals(program.start)
    for name, expected in every.margins(lin).items():
        np.testing.assert_allclose(rows[name], expected.margin, atol=1e-7)


@pytest.mark.slow
def test_ipopt_finds_the_same_plan_with_parameters(plan):
    """The same facets from the plan's burns: one problem, to 1e-5."""
    mission, lin = plan.mission, plan.final.result.lin
    stages = IpoptPlanner(mission, "shooting")
    pushed = mission.dynamics.linearise(
        mission.problem, initial_guess.from_burns(mission, 1.05 * plan.burns_m_s)
    )
    found = stages.solve(
        stages.p2_stage(plan.final.facets, lin), pushed, mission.dynamics, unobserved
    )
    assert found.result.status is Status.CONVERGED
    cost = found.result.lin.cost.value * mission.units.speed_m_s
    assert cost == pytest.approx(plan.total_dv_m_s, rel=1e-5)


@pytest.mark.parametrize(
    ("variant", "changes"),
    [
        ("tuned", {}),
        ("shooting", {"body.planned_degree": 2}),
        ("shooting", {"safety.missed_burns": True}),
    ],
)
def test_other_programs_refuse_parameters(variant, changes):
    mission = mission_with(**changes)
    with pytest.raises(InputError, match=r"shooting' if no force depends on time, without drifts"):
        ipopt.plan(mission, initial_guess.cold(mission), variant=variant)
