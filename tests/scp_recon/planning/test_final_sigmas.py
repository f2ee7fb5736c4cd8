"""Plans with limits of the final spread, and under other execution errors."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from formulations.arrays import Array
from formulations.problem.execution_errors import VANISHED, GatesErrors
from formulations.problem.flyby import Iterate
from formulations.registry import make_subproblem
from formulations.rows.cones import FINAL_POSITION, FINAL_VELOCITY
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.planning import initial_guess, ipopt
from scp_recon.planning.plan import Plan
from scp_recon.results.solution import Solution, make_solution
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.loop import Timing, trial_step
from scp_recon.scp.status import Status
from scp_recon.verification.consistency import inconsistencies
from scp_recon.verification.probabilities import exceeded, flown_sigmas
from scp_recon.verification.reintegration import verify
from tests.helpers import nightly, usually
from tests.scenarios import COARSE
from tests.scp_recon.support import from_cold, mission_of

TANGENT = COARSE, "polytopes.ball='tangent'", "polytopes.cone=12"
LIMITS = {
    "position": "boundary.final_sigma_position_m",
    "velocity": "boundary.final_sigma_velocity_m_s",
}


def planned(*overrides: str) -> Plan:
    return from_cold(mission_of(*TANGENT, *overrides))


def final_sigmas(plan: Plan) -> tuple[float, float]:
    variances = np.diag(plan.covariances[-1])
    return float(np.sqrt(variances[:3].sum())), float(np.sqrt(variances[3:].sum()))


@pytest.fixture(scope="module")
def free() -> Plan:
    return planned()


@pytest.mark.slow
@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize("part", ["position", "velocity"])
def test_a_limit_that_is_less_binds_and_costs(free, part):
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


@pytest.mark.slow
def test_a_limit_that_is_more_changes_nothing(free):
    position, velocity = final_sigmas(free)
    loose = planned(
        f"{LIMITS['position']}={1.1 * position}", f"{LIMITS['velocity']}={1.1 * velocity}"
    )
    np.testing.assert_allclose(loose.burns_m_s, free.burns_m_s, atol=1e-6)


def test_a_file_that_says_otherwise_is_found_out(free):
    limit = 0.9 * final_sigmas(free)[0]
    scenario = free.mission.scenario.replace({LIMITS["position"]: limit})
    mission = Mission.from_scenario(scenario)  # of other limits than were planned
    honest = make_solution(free)
    said: Solution = replace(honest, scenario=scenario, carried=honest.figures)
    assert "constraints" in inconsistencies(mission, said)
    blocks = Flyer(mission, free.burns_m_s, seed=1).fly_blocks(mission.times_s[-1:], 5000)
    ends = np.concatenate([flown.states[-1] for flown in blocks])
    assert FINAL_POSITION in exceeded(flown_sigmas(mission, ends))


def gates(fixed: tuple[float, float], proportional: tuple[float, float], bias: float = 0.0) -> str:
    """Gates' model: (magnitude, pointing) of each part, m/s and a fraction or rad."""
    return (
        f"uncertainty.gates={{magnitude_fixed_m_s={fixed[0]}, pointing_fixed_m_s={fixed[1]}, "
        f"magnitude_proportional={proportional[0]}, pointing_proportional_rad={proportional[1]}, "
        f"magnitude_bias={bias}}}"
    )


UNLIKE = gates((2e-3, 5e-4), (0.01, 0.02), 0.02)
"""A magnitude that errs otherwise than the pointing, and a bias of all burns."""
ALIKE = gates((1e-3, 1e-3), (0.01, np.deg2rad(0.5)))


@cache
def planned_by(*overrides: str, formulation: str = "condensed") -> Plan:
    return from_cold(mission_of(COARSE, *overrides), formulation=formulation)


@pytest.mark.slow
@pytest.mark.parametrize("formulation", usually(["tuned", "shooting", "lifted"], 1))
def test_methods_agree_under_gates_errors(formulation):
    ours = planned_by(UNLIKE)
    if formulation == "lifted":
        other = planned_by(UNLIKE, formulation=formulation)
    else:
        mission = ours.mission
        guess = ours.final.result.lin.iterate if formulation == "shooting" else None
        other = ipopt.plan(mission, guess or initial_guess.cold(mission), variant=formulation)
    assert (ours.status, other.status) == (Status.CONVERGED, Status.CONVERGED)
    assert other.total_dv_m_s == pytest.approx(ours.total_dv_m_s, rel=1e-4)


@pytest.mark.slow
@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize("errors", [UNLIKE, ALIKE], ids=["unlike", "alike"])
def test_a_plan_under_gates_errors_is_verified(errors):
    """Its covariance by closed forms and variational equations, its probabilities by sampling."""
    found = planned_by(errors)
    checked = verify(found.mission, make_solution(found))
    assert checked.ok, checked.failed
    assert checked.covariance_error < 1e-6


def test_a_vanished_burn_returns_only_if_needed():
    """P3 leaves out the third burn: one set of errors calls for it, the other does not."""
    for errors, needed in ((UNLIKE, True), (ALIKE, False)):
        found = planned_by(errors)
        assert {stage.result.status for stage in found.stages} == {Status.CONVERGED}
        assert len(found.final.result.records) <= 15
        model = found.mission.problem.execution_errors
        assert isinstance(model, GatesErrors)
        first, last = (
            np.linalg.norm(stage.result.lin.iterate.burns, axis=1)
            for stage in (found.stages[0], found.final)
        )
        assert first[2] < VANISHED * model.fixed_bound
        assert (last[2] > model.fixed_bound) == needed
        assert (last[2] < VANISHED * model.fixed_bound) != needed


def test_executing_a_vanished_burn_may_predict_more(monkeypatch):
    """Before the window, where its errors count: its own model forbids it to leave zero far."""
    found, radius = planned_by(UNLIKE), 0.3
    problem, dynamics = found.mission.problem, found.mission.dynamics
    subproblem = make_subproblem(problem, found.final.merit.rows)
    burns = found.final.result.lin.iterate.burns.copy()
    burns[1] = 0.0
    means = dynamics.rollout(problem.initial_state, burns)
    lin = dynamics.linearise(problem, Iterate(burns, means))
    state = SCvx().init(subproblem, lin)

    def promise() -> float:
        return trial_step(subproblem, dynamics, state, radius, Timing(), 1e-6).predicted

    both = promise()
    monkeypatch.setattr(GatesErrors, "alternatives", lambda *_: iter(()))
    assert both > 1.05 * promise() > 0.0


def drawn(*overrides: str, errors: str | None = None) -> Array:
    """Deviations of the burns of a block of flights."""
    mission, burns = mission_of(COARSE, *overrides), planned_by(UNLIKE).burns_m_s
    flights = Flyer(mission, burns, errors=errors).fly_block(np.zeros(1), 0)  # type: ignore[arg-type]
    return flights.burns_m_s - burns


def test_flights_take_no_errors_by_component_for_gates():
    """The other way there is an isotropic counterpart of the same size."""
    found = planned_by(UNLIKE)
    with pytest.raises(InputError, match="gates"):
        Flyer(found.mission, found.burns_m_s, errors="componentwise")
    assert np.array_equal(drawn(UNLIKE), drawn(UNLIKE, errors="gates"))
    assert not np.array_equal(drawn(), drawn(errors="gates"))


@nightly
def test_a_later_correction_compensates_an_earlier_one():
    """A limit too loose to bind has that burn corrected too, to nothing where the other is large."""
    navigated = (
        "risk.p_chance=0.9",
        'policy.kind="feedback"',
        "navigation.lead_s=0",
        "navigation.sigma_position_m=10",
        "navigation.sigma_velocity_m_s=0.0005",
    )
    costs = []
    for limit in ((), (f"{LIMITS['position']}=1000",)):
        found = from_cold(mission_of(*navigated, *limit))
        assert found.status is Status.CONVERGED
        costs.append(found.final.result.lin.cost.value)
    assert final_sigmas(found)[0] < 900.0
    assert costs[1] < 0.98 * costs[0]
