"""A plan's prediction in flight: the spread of flights, whichever of their burns were measured."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formulations.problem.flyby import Iterate
from scp_recon.api.verbs import replan
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import execution_errors
from scp_recon.physics.flow import propagate
from scp_recon.planning.plan import Plan
from scp_recon.replanning.flown import FlownPlan, predict
from scp_recon.results.policy import policy_of, with_policy
from scp_recon.results.solution import Solution, make_solution
from scp_recon.scp.status import Status
from tests.helpers import share_of_examples
from tests.scp_recon.verification.test_closed_loop import EXPECTED, LAST_TOO, gates, with_gains

FLIGHTS = 4_000


def with_gates(plan: Plan, initial: float, **gates: float) -> FlownPlan:
    """The default burns, flown with Gates' errors; nothing is optimised."""
    errors = {
        "magnitude_fixed_m_s": 0.0,
        "magnitude_proportional": 0.0,
        "pointing_fixed_m_s": 0.0,
        "pointing_proportional_rad": 0.0,
    }
    changes = {"uncertainty.initial_sigma_fraction": initial, "uncertainty.gates": errors | gates}
    mission = Mission.from_scenario(plan.mission.scenario.replace(changes))
    units = mission.units
    path = Iterate(plan.burns_m_s / units.speed_m_s, plan.states / units.state)
    lin = mission.dynamics.linearise(mission.problem, path)
    return replace(FlownPlan.of(plan), mission=mission, lin=lin)


def test_no_measured_burn_makes_a_variance_negative(default_plan):
    @given(
        bias=st.just(0.0) | st.floats(1e-6, 0.3),
        own=st.just(0.0) | st.floats(1e-6, 0.1),
        numbers=st.sets(st.sampled_from([1, 2, 3])),
        at_s=st.floats(25_000.0, 34_000.0),
        scale=st.floats(0.5, 1.5),
    )
    @settings(max_examples=share_of_examples(10))
    def check(bias: float, own: float, numbers: set[int], at_s: float, scale: float) -> None:
        flown = with_gates(default_plan, 0.01, magnitude_bias=bias, magnitude_proportional=own)
        measured = {number: scale * default_plan.burns_m_s[number - 1] for number in numbers}
        covariance = predict(flown, at_s, measured).covariance
        sigma = np.sqrt(np.diag(covariance))
        assert np.linalg.eigvalsh(covariance / np.outer(sigma, sigma)).min() > -1e-9

    check()


@pytest.mark.slow
@pytest.mark.parametrize("measured", [(), (1,), (2,), (1, 3), (2, 3)])
def test_the_spread_is_that_of_flights_in_which_measured_burns_do_not_err(default_plan, measured):
    """Small errors, so that flights are linear; the bias is one draw for all burns of a flight."""
    flown = with_gates(default_plan, 2e-3, magnitude_bias=0.02, pointing_proportional_rad=0.005)
    mission, firing = flown.mission, (0.0, 8_000.0, 25_000.0)
    rng, errors = np.random.default_rng(3), execution_errors(flown.mission.scenario)
    executed = errors.execute(
        default_plan.burns_m_s,
        rng.normal(size=(FLIGHTS, errors.draws(len(default_plan.burns_m_s)))),
    )
    known = {n: 1.01 * default_plan.burns_m_s[n - 1] for n in measured}
    for number, burn in known.items():
        executed[:, number - 1] = burn
    states = mission.initial_state + rng.normal(size=(FLIGHTS, 6)) @ mission.initial_factor.T
    for i, (time, following) in enumerate(zip(firing, (*firing[1:], 27_000.0), strict=True)):
        states[:, 3:] += executed[:, i]
        states = propagate(states, following - time, mission.forces, 100)
    found = predict(flown, 27_000.0, known)
    sigma = np.sqrt(np.diag(found.covariance))
    assert (states.mean(axis=0) - found.state) / sigma == pytest.approx(np.zeros(6), abs=0.1)
    spread = np.cov((states / sigma).T)
    assert spread == pytest.approx(found.covariance / np.outer(sigma, sigma), abs=0.1)


@pytest.fixture(scope="module")
def corrected() -> Solution:
    """Corrections of burns 2, 3 and 4, of which the later ones act on every estimate so far."""
    made = with_gains("navigation.lead_s=3600", LAST_TOO, EXPECTED)
    return replace(made, problem="P2")


@pytest.mark.parametrize(
    "words", [("navigation.lead_s=0",), ("navigation.lead_s=20000", LAST_TOO), (gates(0.03, 0.0),)]
)
def test_the_gains_of_a_file_are_those_that_it_was_made_of(words):
    given = with_gains(*words)
    flown = FlownPlan.of(given)
    assert flown.failed == ()
    plain = replace(flown.lin, iterate=Iterate(flown.lin.iterate.burns, flown.lin.iterate.mean))
    again = with_policy(flown.mission, plain, policy_of(flown.mission, flown.lin))
    np.testing.assert_allclose(again.iterate.gains, flown.lin.iterate.gains, rtol=1e-9, atol=1e-15)
    assert flown.lin.iterate.gains.any()
    for ours, stored in zip(flown.policy, given.corrections, strict=True):
        np.testing.assert_allclose(ours.gains, stored.gains, rtol=1e-9, atol=1e-12)


def test_a_file_of_other_gains_contradicts_its_covariances(corrected):
    first, *others = corrected.policy.corrections
    gain = [(2.0 * np.array(block)).tolist() for block in first.gain]
    policy = replace(corrected.policy, corrections=[replace(first, gain=gain), *others])
    assert "covariance_error" in FlownPlan.of(replace(corrected, policy=policy)).failed


def test_a_measured_burn_was_not_corrected_by_chance(corrected):
    """Its correction adds as little to the spread as its errors."""
    flown = FlownPlan.of(corrected)
    found = predict(flown, 15_000.0, {2: flown.burns_m_s[1]})
    alone = predict(replace(flown, lin=flown.lin.known(None)), 15_000.0, {2: flown.burns_m_s[1]})
    size = np.abs(alone.covariance).max(axis=1, keepdims=True)
    np.testing.assert_allclose(found.covariance / size, alone.covariance / size, atol=1e-9)
    assert np.trace(predict(flown, 15_000.0, {}).covariance) != pytest.approx(
        np.trace(found.covariance), rel=1e-2
    )


OFF = np.array([20.0, -10.0, 5.0, 1e-3, 2e-3, -1e-3])
"""A deviation at the first cut-off."""


@pytest.mark.parametrize("at_s", [4_400.0, 3_000.0])
def test_the_policy_alone_acts_on_the_estimate_at_the_cut_off(corrected, at_s):
    """From an earlier state on the estimate that follows from it."""
    flown, first = FlownPlan.of(corrected), corrected.corrections[0]
    planned = predict(flown, at_s, {}).state
    till = 4_400.0 - at_s
    start = np.stack([planned, planned + OFF])
    path, other = propagate(start, np.full(2, till), flown.mission.forces, 20) if till else start
    commanded = flown.commanded(planned + OFF, at_s)
    expected = flown.burns_m_s[1] + first.gains[0] @ (other - path)
    assert commanded == pytest.approx(expected, rel=1e-3)  # the path is not linear
    assert np.linalg.norm(commanded - flown.burns_m_s[1]) > 1e-3
    # Gains of later burns act on what was estimated before, which a state does not tell.
    assert flown.commanded(planned + OFF, 17_000.0) is None
    # No burn is left.
    assert flown.commanded(planned, flown.mission.scenario.burn_times_s[-1]) is None


@pytest.mark.slow
def test_a_plan_with_corrections_is_continued_from_its_cut_off(corrected):
    """The next burn is as it is; later ones are corrected by measurements to come."""
    flown, first = FlownPlan.of(corrected), corrected.corrections[0]
    state = predict(flown, 4_400.0, {}).state + OFF
    again = replan(corrected, 4_400.0, state)
    assert again.status is Status.CONVERGED
    units = again.mission.units.state
    known = again.mission.initial_factor @ again.mission.initial_factor.T
    np.testing.assert_allclose(
        known / np.outer(units, units),
        first.estimate_covariance / np.outer(units, units),
        rtol=1e-6,
        atol=1e-12,
    )
    made = make_solution(again)
    assert [(one.burn, one.cut_off_s) for one in made.corrections] == [(1, 21_400.0), (2, 31_242.0)]
    assert [one.burn for one in made.policy.corrections] == [3, 4]
    assert again.parent.commanded_m_s == pytest.approx(flown.commanded(state, 4_400.0))
    assert made.by_policy is not None
    assert "the policy of a solution alone would command burn 2 at 8000 s as" in made.by_policy
    assert FlownPlan.of(made).failed == ()
