"""Deliveries that cannot be are refused in one message; unlikely ones are told."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import scp_recon as sr
from formulations.arrays import Array
from scp_recon.errors import InputError
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import Planner
from scp_recon.replanning.flown import FlownPlan, predict
from scp_recon.replanning.remainder import Delivery, mission_left

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
    with pytest.raises(InputError, match=r"^at_s: .*must not be before 17000 s"):
        sr.replan(plan, 16_000.0, state)


def test_only_exact_risk_with_uncertainty_is_certified(default_plan, mission, state):
    exact = ["risk.allocation=exact"]
    p3_plan = Planner(mission).plan(initial_guess.cold(mission), problem="P3")
    with pytest.raises(InputError, match=r"^certify: got False; goes with problem='P2'"):
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
def test_nodes_that_do_not_follow_from_scenario_and_burns_are_told(
    solution, state, entry, value, failed
):
    edited = solution.scenario.replace({entry: value})
    flown = FlownPlan.of(replace(solution, scenario=edited))
    assert failed in flown.failed
    assert "parent" in [w.entry for w in mission_left(flown, Delivery(AT, state)).warnings]


def test_what_a_file_says_of_its_verification_is_told(solution, verification, state):
    bad = replace(verification, ok=False, failed=["safety_radius"])
    found = FlownPlan.of(replace(solution, verification=bad))
    (warning,) = mission_left(found, Delivery(AT, state)).warnings
    assert "not verified: safety_radius" in str(warning)


def test_a_solution_of_another_grid_is_refused(solution):
    finer = solution.scenario.replace({"grid.step_max_s": 200.0})
    with pytest.raises(InputError, match=r"^plan: got nodes.t_s that contradict"):
        FlownPlan.of(replace(solution, scenario=finer))
