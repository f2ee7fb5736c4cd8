"""Flights whose filter estimates uncertain parameters with the state, or considers them."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from formulations.linearisation.linearisation import Linearisation
from formulations.problem.flyby import Iterate
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.closed_loop import replans
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.results.policy import policy_of, with_policy
from scp_recon.verification.reintegration import full_stm, integrated
from tests.oracles.information_filter import Information
from tests.scp_recon.support import mission_of

BURNS = 1e-4 * np.array([[-100, 516, 170], [-58, 181, -81], [-37, 6, -99], [-103, 379, 40]])
"""About those of the default plan, m/s."""
FLIGHTS = 40


@cache
def case(*words: str, lead_s: float = 3600.0) -> tuple[Mission, Linearisation]:
    """Small errors, three uncertain parameters, and random gains of three corrected burns."""
    mission = mission_of(
        "uncertainty.initial_sigma_fraction=1e-4",
        "uncertainty.execution_error=3e-4",
        "navigation.sigma_position_m=0.5",
        "navigation.sigma_velocity_m_s=3e-5",
        "policy.kind=feedback",
        f"navigation.lead_s={lead_s}",
        "boundary.final_sigma_velocity_m_s=1",
        "knowledge.body.gm_m3_s2=0.005",
        "knowledge.body.j2=0.001",
        "knowledge.spacecraft.reflectivity_coefficient=0.02",
        *words,
    )
    problem, speed = mission.problem, mission.units.speed_m_s
    assert problem.feedback is not None
    gains = 1e-5 / speed * np.random.default_rng(1).normal(size=problem.feedback.size)
    burns = BURNS / speed
    path = Iterate(burns, mission.dynamics.rollout(problem.initial_state, burns), gains)
    return mission, mission.dynamics.linearise(problem, path)


@pytest.mark.parametrize("lead_s", [0.0, 3600.0, 17_500.0])
def test_filter_is_a_square_root_information_filter(lead_s):
    """Commanded corrections and covariances, by another integrator; also across an earlier burn."""
    mission, lin = case(lead_s=lead_s)
    policy = policy_of(mission, lin)
    draws = Flyer(mission, BURNS, policy).draws(0)[:FLIGHTS]
    cut_offs = np.array([one.cut_off_s for one in policy])
    flown = Flyer(mission, BURNS, policy).fly(cut_offs, draws)
    commanded = flown.commanded_m_s - BURNS
    noise = draws[:, -6 * len(policy) :].reshape(FLIGHTS, len(policy), 6)
    size, units = 6 + mission.uncertain.count, mission.units.state
    first = np.zeros((size, size))
    first[:6, :6] = mission.initial_factor @ mission.initial_factor.T
    first[6:, 6:] = np.eye(size - 6)
    told = Information.before(first, FLIGHTS)
    firing = mission.scenario.burn_times_s
    now, state = 0.0, mission.initial_state.copy()
    estimates = []
    for time in sorted({*firing, *cut_offs}):
        if time > now:
            answer = integrated(mission, state, (now, time))
            now, state = time, answer.y[:6, -1]
            told = told.carried(full_stm(answer.y[6:, -1]))
        for j in np.flatnonzero(cut_offs == time):
            seen = flown.states[j].T - state[:, None]
            if time in firing:  # flown states are those after the burn
                seen[3:] -= flown.burns_m_s[:, firing.index(time)].T
            told = told.measured(
                seen + policy[j].noise(noise[:, j]), policy[j].measurement_covariance
            )
            estimates.append(told.estimate[:6])
            scale = np.sqrt(np.diag(told.covariance))
            expected = told.covariance / np.outer(scale, scale)
            found = policy[j].estimate_covariance / np.outer(scale, scale)
            np.testing.assert_allclose(found, expected, atol=2e-6)
        if time in firing:
            burn = firing.index(time)
            errors = np.diag((3e-4 * BURNS[burn]) ** 2)
            for j, one in enumerate(policy):
                if one.burn == burn:
                    own = sum(g @ x for g, x in zip(one.gains, estimates, strict=False))
                    np.testing.assert_allclose(
                        commanded[:, burn], own.T, rtol=0, atol=1e-4 * np.abs(own).max()
                    )
                    gains = lin.problem.gains_of(lin.iterate, j) * units[3]
                    errors += np.diag((3e-4) ** 2 * np.sum(gains**2, axis=1))
            told = told.burnt(commanded[:, burn].T, errors)
            state[3:] += BURNS[burn]
    assert len(estimates) == len(policy) >= 2
    learnt = np.sqrt(np.diag(policy[-1].estimate_covariance))[6:]
    assert learnt[0] < 0.5  # GM, in standard deviations before the flight


@pytest.mark.parametrize("considers", [False, True])
def test_stored_policies_give_back_their_gains(considers):
    words = ("navigation.estimate_parameters=false",) if considers else ()
    mission, lin = case(*words)
    policy = policy_of(mission, lin)
    assert len(policy[0].estimate_covariance) == (6 if considers else 9)
    plain = Linearisation(
        lin.problem, replace(lin.iterate, gains=np.zeros_like(lin.iterate.gains)), lin.arcs
    )
    again = with_policy(mission, plain, policy)
    np.testing.assert_allclose(
        again.iterate.gains, lin.iterate.gains, atol=1e-7 * np.abs(lin.iterate.gains).max()
    )


def test_filter_that_considers_parameters_commands_the_same():
    """Its estimates err more, and gains on all of them so far make up for it."""
    (mission, lin), (other, considering) = case(), case("navigation.estimate_parameters=false")
    policies = policy_of(mission, lin), policy_of(other, considering)
    draws = Flyer(mission, BURNS, policies[0]).draws(0)[:FLIGHTS]
    commands = [
        Flyer(one, BURNS, policy).fly(one.times_s[-1:], draws).commanded_m_s
        for one, policy in zip((mission, other), policies, strict=True)
    ]
    most = np.abs(commands[0] - BURNS).max()
    np.testing.assert_allclose(commands[1], commands[0], rtol=0, atol=1e-6 * most)
    for best, worse in zip(*policies, strict=True):
        more = np.diag(worse.estimate_covariance) / np.diag(best.estimate_covariance)[:6]
        assert more.min() > 1.0 - 1e-9
    assert more.max() > 1.02


@pytest.mark.slow
def test_flights_are_planned_again_with_uncertain_parameters():
    """The filter considers the parameter: what it delivers allows for the spread that GM causes."""
    words = ("grid.step_max_s=900", "uncertainty.initial_sigma_fraction=0", "burns.dv_min_m_s=0")
    words = (*words, "navigation.sigma_position_m=10", "navigation.sigma_velocity_m_s=5e-4")
    known = mission_of(*words, "uncertainty.execution_error=0.01")
    mission = Mission.from_scenario(known.scenario.replace({"knowledge.body.gm_m3_s2": 0.3}))
    policies = [replans(one, BURNS) for one in (known, mission)]
    spreads = [np.sqrt(np.diag(policy[0].estimate_covariance)) for policy in policies]
    assert np.all(spreads[1] > spreads[0])
    assert (spreads[1] / spreads[0]).max() > 2.0
    draws = Flyer(mission, BURNS, policies[1]).draws(0)[:2]
    flown = Flyer(mission, BURNS, policies[1]).fly(mission.times_s[-1:], draws)
    assert not flown.failed.any()
    assert np.abs(flown.commanded_m_s - BURNS).max() > 1e-4
