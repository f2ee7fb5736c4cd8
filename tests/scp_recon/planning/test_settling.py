"""Facets settle where no choice is cheaper, on both sides of what is infeasible with P3's facets."""

import pytest

from experiments.solvers.cases import drawn
from formulations.problem.facets import Facets, choose_facets
from scp_recon.mission.mission import Mission
from scp_recon.planning.plan import Plan, Stage
from scp_recon.planning.planner import Planner
from scp_recon.planning.settling import ROUGH
from scp_recon.planning.stages import Pipeline
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status
from tests.helpers import usually
from tests.scp_recon.support import from_cold

UNIFORM = {"risk.allocation": "uniform", "risk.scope": "node"}


@pytest.fixture(scope="module")
def settled(mission) -> Plan:
    return from_cold(mission, facet_rounds="settle")


def test_settled_facets_save_delta_v(settled, default_plan):
    assert settled.status is Status.CONVERGED
    assert settled.final.name == "P2.settled"
    assert settled.total_dv_m_s == pytest.approx(0.125660, rel=1e-4)
    least = settled.without_uncertainty
    assert least.total_dv_m_s < settled.total_dv_m_s < 0.93 * default_plan.total_dv_m_s
    assert least.optima == 1


def test_no_choice_is_cheaper_than_settled_facets(mission, settled):
    """Neither all anew, nor where the new ones hold."""
    lin = settled.final.result.lin
    fresh = choose_facets(mission.problem, mission.polytopes, lin.iterate.mean, lin.factor)
    holding = settled.final.facets.where_they_hold(fresh, lin.iterate.mean, lin.factor)
    for facets in (fresh, holding):
        again = planned_with(mission, facets, settled)
        is_plan = again.result.status is Status.CONVERGED
        cost = again.result.lin.iterate.total_dv
        assert not is_plan or cost > (1.0 - 2.0 * ROUGH) * lin.iterate.total_dv


def planned_with(mission: Mission, facets: Facets, start: Plan) -> Stage:
    planner, lin = Planner(mission), start.final.result.lin
    return Pipeline(mission, planner).run([planner.p2_stage(facets, lin)], lin)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", usually([{"algorithm": "ptr"}, {"formulation": "frozen-stm"}], 1)
)
def test_every_method_settles_alike(settled, mission, options):
    """The same scout chooses the facets for all."""
    other = from_cold(mission, facet_rounds="settle", **options)
    assert other.total_dv_m_s == pytest.approx(settled.total_dv_m_s, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "most"),
    usually([(17, 0.1126), (13, 0.1650), (7, 0.1375), (12, 0.1212), (22, 0.15), (511, 0.1278)], 2),
)
def test_settled_plan_may_be_far_cheaper(seed, most):
    """Infeasible with P3's facets at the cheapest optimum of P3, or a third dearer or more."""
    mission = Mission.from_scenario(load_scenario().replace(drawn(seed)[1] | UNIFORM))
    assert from_cold(mission, facet_rounds="settle").total_dv_m_s < most
