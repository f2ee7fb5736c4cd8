"""Limits on the covariance after the last burn: they bind, cost, and are seen by flights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from formulations.rows.cones import FINAL_POSITION, FINAL_VELOCITY
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess, ipopt
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import Planner
from scp_recon.results.solution import Solution, make_solution
from scp_recon.scp.status import Status
from scp_recon.verification.consistency import inconsistencies
from scp_recon.verification.probabilities import exceeded, flown_sigmas
from scp_recon.verification.reintegration import verify
from tests.helpers import usually
from tests.scenarios import COARSE
from tests.scp_recon.support import mission_of

TANGENT = COARSE, "polytopes.ball='tangent'", "polytopes.cone=12"
LIMITS = {
    "position": "boundary.final_sigma_position_m",
    "velocity": "boundary.final_sigma_velocity_m_s",
}


def planned(*overrides: str) -> Plan:
    mission = mission_of(*TANGENT, *overrides)
    return Planner(mission).plan(initial_guess.cold(mission))


def final_sigmas(plan: Plan) -> tuple[float, float]:
    variances = np.diag(plan.covariances[-1])
    return float(np.sqrt(variances[:3].sum())), float(np.sqrt(variances[3:].sum()))


@pytest.fixture(scope="module")
def free() -> Plan:
    return planned()


@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize("part", ["position", "velocity"])
def test_a_limit_that_is_less_binds_and_costs(free: Plan, part: str) -> None:
    which = list(LIMITS).index(part)
    limit = 0.9 * final_sigmas(free)[which]
    plan = planned(f"{LIMITS[part]}={limit}")
    assert plan.status is Status.CONVERGED
    assert final_sigmas(plan)[which] == pytest.approx(limit, rel=1e-5)
    assert plan.total_dv_m_s > (1.0 + 1e-4) * free.total_dv_m_s
    name = (FINAL_POSITION, FINAL_VELOCITY)[which]
    margin, unit = plan.worst_margins[name]
    assert abs(margin) < 1e-3
    assert unit == ("m", "m/s")[which]
    solution = make_solution(plan)
    assert solution.primer.residual < 1e-2
    checked = verify(plan.mission, solution)
    assert checked.ok, checked.failed
    (flown,) = checked.final_sigmas
    assert flown.name == name
    assert flown.flown == pytest.approx(limit, rel=0.1)


def test_a_limit_that_is_more_changes_nothing(free: Plan) -> None:
    position, velocity = final_sigmas(free)
    loose = planned(
        f"{LIMITS['position']}={1.1 * position}", f"{LIMITS['velocity']}={1.1 * velocity}"
    )
    np.testing.assert_allclose(loose.burns_m_s, free.burns_m_s, atol=1e-6)


@pytest.mark.parametrize("scope", usually(["node", "flight"], 1))
def test_it_binds_with_exact_risk_too(scope: str) -> None:
    """Without a limit it is 204.96 m."""
    exact = "risk.allocation='exact'", f"risk.scope={scope!r}", "risk.p_chance=0.6"
    limit = 185.0
    plan = planned(*exact, f"{LIMITS['position']}={limit}")
    assert plan.status is Status.CONVERGED
    assert final_sigmas(plan)[0] == pytest.approx(limit, rel=1e-4)
    assert inconsistencies(plan.mission, make_solution(plan)) == []


def test_a_file_that_says_otherwise_is_found_out(free: Plan) -> None:
    limit = 0.9 * final_sigmas(free)[0]
    scenario = free.mission.scenario.replace({LIMITS["position"]: limit})
    mission = Mission.from_scenario(scenario)  # of other limits than were planned
    honest = make_solution(free)
    said: Solution = replace(honest, scenario=scenario, carried=honest.figures)
    assert "constraints" in inconsistencies(mission, said)
    assert FINAL_POSITION in exceeded(flown_sigmas(mission, free.burns_m_s, seed=1))


def test_what_cannot_keep_them_refuses_them() -> None:
    mission = mission_of(COARSE, f"{LIMITS['velocity']}=0.01")
    with pytest.raises(
        InputError, match=r"boundary\.final_sigma_velocity_m_s.*condensed and lifted"
    ):
        Planner(mission, formulation="frozen-stm")
    with pytest.raises(InputError, match=r"boundary\.final_sigma_velocity_m_s.*scp"):
        ipopt.plan(mission, initial_guess.cold(mission))
    assert mission.problem.final_spread[0] is None
