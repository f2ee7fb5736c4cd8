"""A plan's prediction in flight: the spread of flights; what is delivered is compared with it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import scp_recon as sr
from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.api.verbs import replan
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import execution_errors
from scp_recon.physics.flow import propagate
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import Planner
from scp_recon.replanning.flown import FlownPlan, predict
from scp_recon.replanning.remainder import Delivery, mission_left
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
def test_spread_omits_errors_of_measured_burns(default_plan, measured):
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
def test_file_keeps_the_gains_of_its_plan(words):
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
def test_policy_alone_uses_estimate_at_cut_off(corrected, at_s):
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
def test_corrected_plan_continues_from_its_cut_off(corrected):
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
    assert "command burn 2 at 8000 s" in made.by_policy
    assert FlownPlan.of(made).failed == ()


AT = 17_000.0
SIGMA = np.array([10.0, 10.0, 10.0, 3e-4, 3e-4, 3e-4])
METRES = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def state(default_plan) -> Array:
    return predict(FlownPlan.of(default_plan), AT, {}).state


MIXED = 10.0 * np.outer(METRES, METRES)
NONE_OF_THESE: dict[str, list[tuple[str, Any]]] = {
    "at_s": [
        ("at or after the last burn", 34_842.0),
        ("at or after the last burn", 1e6),
        ("lead time.*at most 21400 s, or 25000 s and more", 24_000.0),
        ("lead time.*at most 31242 s$", 34_000.0),
        ("must not be before 0 s", -1.0),
        *(("must be a time", at_s) for at_s in (float("nan"), "17000", True, 10**400)),
    ],
    "state": [
        ("", lambda state: state / 1000.0),
        ("", lambda state: state * np.where(METRES > 0.0, 1.0, 1e-3)),
        ("", lambda state: state + 5e5 * np.eye(6)[0]),
        ("", lambda state: state * np.where(METRES > 0.0, 0.2, 1.0)),
        ("", lambda state: state[:5]),
        *(("", state) for state in (np.full(6, np.nan), ["a"] * 6, None)),
    ],
    "covariance": [
        ("no negative variance", np.diag(-(SIGMA**2))),
        (
            "positive semidefinite",
            np.diag(SIGMA**2) + 20.0 * MIXED * (np.eye(6, k=1) + np.eye(6, k=-1)),
        ),
        ("symmetric", np.diag(SIGMA**2) + MIXED * np.eye(6, k=1)),
        ("six rows of six", np.eye(5)),
        ("at most 755 m", 1e6 * np.diag(SIGMA**2)),
        ("six rows of six", "none"),
    ],
    "covariance_frame": [("must be one of", "body")],
    "frame": [("got 'icrf'; must be one of j2000, sun_north", "icrf")],
    "measured_burns": [
        ("burn 3; must be one of those flown by 17000 s, 1 to 2", {3: np.ones(3)}),
        *(("whole number", {number: np.ones(3)}) for number in (0, "1")),
        *(("three numbers", {1: burn}) for burn in (np.ones(2), [np.inf, 0.0, 0.0])),
        ("by number", [0.1, 0.2, 0.3]),
        ("got burn 1 of .*in m/s", lambda burns: {1: 1e3 * burns[0]}),
        ("got burn 2 of .*in m/s", lambda burns: {2: 1e3 * burns[1]}),
    ],
    "overrides": [
        ("must be a list of section", "risk.p_chance=0.6"),
        ("must be a list of section", [("risk.p_chance", 0.6)]),
    ],
    "plan": [("got 7", 7)],
    "certify": [("got True; goes with", True)],
}


@pytest.mark.parametrize(
    ("name", "words", "value"),
    [(name, *case) for name, cases in NONE_OF_THESE.items() for case in cases],
)
def test_what_cannot_be_is_refused_by_its_name(default_plan, state, name, words, value):
    """States in other units or of another flight; burns not flown, or in mm/s."""
    made_of = {"state": state, "measured_burns": default_plan.burns_m_s}
    wrong = value(made_of[name]) if callable(value) else value
    given = {"plan": default_plan, "at_s": AT, "state": state, name: wrong}
    if name == "covariance_frame":
        given["covariance"] = np.diag(SIGMA**2)
    with pytest.raises(InputError, match=f"^{name}: .*{words}") as caught:
        sr.replan(**given)
    assert "\n" not in str(caught.value)


def told(plan: Plan, *given: Any, **named: Any) -> set[str]:
    """Entries of the warnings about what is delivered."""
    mission = mission_left(FlownPlan.of(plan), Delivery.of(*given, **named))
    return {warning.entry for warning in mission.warnings}


def test_what_hardly_can_be_is_told(default_plan, state):
    """Far from the prediction, in other axes or units; times may be any real number."""
    for off in (10_000.0 * METRES, 60.0 * METRES, 0.01 * (1.0 - METRES)):
        assert "state" in told(default_plan, AT, state + off)
    assert told(default_plan, np.float32(AT), state, frame="sun_north") == {"state"}
    small = 1e-6 * np.diag(SIGMA**2)
    assert told(default_plan, np.int64(AT), state, covariance=small) == {"covariance"}
    burn = {2: 1e-3 * default_plan.burns_m_s[1]}
    assert "measured_burns" in told(default_plan, AT, state, measured=burn)


def test_a_covariance_has_axes_of_its_own(default_plan, state):
    """The radial direction is the position's."""
    radial = np.diag([100.0, 0.0, 0.0, 1e-8, 1e-8, 1e-8])
    plan = sr.replan(default_plan, AT, state, radial, covariance_frame="rtn")
    axis = state[:3] / np.linalg.norm(state[:3])
    assert plan.covariances[0, :3, :3] == pytest.approx(100.0 * np.outer(axis, axis), abs=1e-6)
    with pytest.raises(InputError, match=r"^at_s: .*before 17000 s"):
        sr.replan(plan, 16_000.0, state)


def test_only_exact_risk_with_uncertainty_is_certified(default_plan, mission, state):
    exact = ["risk.allocation=exact"]
    p3_plan = Planner(mission).plan(initial_guess.cold(mission), problem="P3")
    with pytest.raises(InputError, match=r"^certify: got False; .*problem='P2'"):
        sr.replan(p3_plan, AT, state, overrides=exact, certify=False)
    plan = sr.replan(default_plan, AT, state, overrides=exact, certify=False)
    assert plan.certificate is None
    assert plan.target is not None


@pytest.mark.parametrize(
    ("entry", "value", "failed"),
    [
        ("uncertainty.execution_error", 0.05, "covariance_error"),
        ("spacecraft.mass_kg", 150.0, "max_defect"),
        ("boundary.initial_velocity_m_s", [0.0, 0.0, 0.05], "max_defect"),
    ],
)
def test_nodes_inconsistent_with_burns_are_told(solution, state, entry, value, failed):
    edited = solution.scenario.replace({entry: value})
    flown = FlownPlan.of(replace(solution, scenario=edited))
    assert failed in flown.failed
    assert "parent" in [w.entry for w in mission_left(flown, Delivery(AT, state)).warnings]


def test_doubtful_file_is_told_other_grid_refused(solution, verification, state):
    bad = replace(verification, ok=False, failed=["safety_radius"])
    found = FlownPlan.of(replace(solution, verification=bad))
    (warning,) = mission_left(found, Delivery(AT, state)).warnings
    assert "not verified: safety_radius" in str(warning)
    finer = solution.scenario.replace({"grid.step_max_s": 200.0})
    with pytest.raises(InputError, match=r"^plan: got nodes.t_s"):
        FlownPlan.of(replace(solution, scenario=finer))
