"""Plans under absolute uncertainties and Gates' errors, held against IPOPT and against each other."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from formulations.arrays import Array
from formulations.problem.execution_errors import VANISHED, GatesErrors
from formulations.problem.flyby import Iterate
from formulations.registry import make_subproblem
from scp_recon.errors import InputError
from scp_recon.monte_carlo.flights import FlightConfig
from scp_recon.monte_carlo.sampling import BLOCK, fly_block
from scp_recon.planning import initial_guess, ipopt
from scp_recon.planning.planner import Plan, plan
from scp_recon.results.solution import make_solution
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.loop import Timing, trial_step
from scp_recon.scp.status import Status
from scp_recon.verification.reintegration import verify
from tests.helpers import usually
from tests.scenarios import COARSE
from tests.scp_recon.support import mission_of


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
POSITION = "uncertainty.initial_sigma_position_m=[12.0, 25.0, 6.0]"
VELOCITY = "uncertainty.initial_sigma_velocity_m_s=[8e-4, 2e-4, 3e-4]"


@cache
def planned(*overrides: str, formulation: str = "condensed") -> Plan:
    mission = mission_of(COARSE, *overrides)
    return plan(mission, initial_guess.cold(mission), formulation=formulation)


@pytest.mark.parametrize("formulation", usually(["tuned", "shooting", "lifted"], 1))
def test_every_method_finds_the_same_plan_under_gates_errors(formulation: str) -> None:
    ours = planned(UNLIKE)
    if formulation == "lifted":
        other = planned(UNLIKE, formulation=formulation)
    else:
        mission = ours.mission
        guess = ours.final.result.lin.iterate if formulation == "shooting" else None
        other = ipopt.plan(mission, guess or initial_guess.cold(mission), variant=formulation)
    assert (ours.status, other.status) == (Status.CONVERGED, Status.CONVERGED)
    assert other.total_dv_m_s == pytest.approx(ours.total_dv_m_s, rel=1e-4)


@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize("errors", [UNLIKE, ALIKE], ids=["unlike", "alike"])
def test_a_plan_under_gates_errors_is_verified(errors: str) -> None:
    """Its covariance by closed forms and variational equations, its probabilities by sampling."""
    found = planned(errors)
    checked = verify(found.mission, make_solution(found))
    assert checked.ok, checked.failed
    assert checked.covariance_error < 1e-6


def test_a_vanished_burn_comes_back_or_stays_and_the_iteration_ends() -> None:
    """P3 leaves out the third burn: one set of errors calls for it, the other does not."""
    for errors, needed in ((UNLIKE, True), (ALIKE, False)):
        found = planned(errors)
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


def test_a_vanished_burn_may_be_executed_where_that_promises_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Before the window, where its errors count: its own model forbids it to leave zero far."""
    found, radius = planned(UNLIKE), 0.3
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
    monkeypatch.setattr(GatesErrors, "otherwise", lambda *_: iter(()))
    assert both > 1.05 * promise() > 0.0


def drawn(*overrides: str, errors: str | None = None) -> tuple[Array, Array]:
    """Deviations of the initial states, and of the burns, of a block of flights."""
    mission = mission_of(COARSE, *overrides)
    burns = planned(UNLIKE).burns_m_s
    flights = fly_block(mission, burns, np.zeros(1), 0, errors=errors)  # type: ignore[arg-type]
    initial = flights.states[0] - mission.initial_state
    initial[:, 3:] -= flights.burns_m_s[:, 0]
    return initial, flights.burns_m_s - burns


def test_flights_have_the_errors_that_the_planner_counts_on() -> None:
    _, errors = drawn(UNLIKE)
    found = planned(UNLIKE)
    columns = mission_of(COARSE, UNLIKE).problem.execution_errors.columns(
        found.burns_m_s / found.mission.units.speed_m_s
    )
    for i, burn in enumerate(columns * found.mission.units.speed_m_s):
        expected, sampled = burn @ burn.T, errors[:, i].T @ errors[:, i] / BLOCK
        sigma = np.sqrt(np.diag(expected))
        scatter = np.outer(sigma, sigma) * np.sqrt(2.0 / BLOCK)
        assert (np.abs(sampled - expected) < 5.0 * scatter).all()


def test_flights_take_no_errors_by_component_for_gates() -> None:
    """The other way there is an isotropic counterpart of the same size."""
    found = planned(UNLIKE)
    with pytest.raises(InputError, match="gates"):
        FlightConfig(found.mission, found.burns_m_s, errors="componentwise")
    assert np.array_equal(drawn(UNLIKE)[1], drawn(UNLIKE, errors="gates")[1])
    assert not np.array_equal(drawn()[1], drawn(errors="gates")[1])
