"""What a plan predicts in flight: the spread of flights, whichever of their burns were measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formulations.problem.flyby import Iterate
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import execution_errors
from scp_recon.physics.flow import propagate
from scp_recon.planning.plan import Plan
from scp_recon.replanning.flown import FlownPlan, predict
from tests.helpers import share_of_examples

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
    factors = mission.dynamics.linearise(mission.problem, path).factor * units.state[:, None]
    return replace(FlownPlan.of(plan), mission=mission, factors=factors)


def test_no_measured_burn_makes_a_variance_negative(default_plan: Plan) -> None:
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


@pytest.mark.parametrize("measured", [(), (1,), (2,), (1, 3), (2, 3)])
def test_the_spread_is_that_of_flights_in_which_measured_burns_do_not_err(
    default_plan: Plan, measured: tuple[int, ...]
) -> None:
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
