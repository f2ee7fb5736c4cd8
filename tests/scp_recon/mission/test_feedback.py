"""Burns that feedback corrects, their cut-offs by leads and contacts, and what is measured there."""

import re
from typing import Any

import numpy as np
import pytest

from formulations.arrays import Array
from scp_recon.mission.feedback import contact_of, cut_offs_s
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.results.policy import policy_of
from scp_recon.results.solution import make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.verification.reintegration import verify
from tests.scp_recon.support import fly_few, from_cold, mission_of, refusal

SIGMAS = "navigation.sigma_position_m=10", "navigation.sigma_velocity_m_s=5e-4"
FEEDBACK = (*SIGMAS, "policy.kind=feedback")
LAST = "boundary.final_sigma_velocity_m_s=0.01"
END = "boundary.final_sigma_position_m=400"
BIASED = (
    "uncertainty.gates={magnitude_fixed_m_s=1e-4, magnitude_proportional=0.03, "
    "pointing_fixed_m_s=1e-4, pointing_proportional_rad=0.02, magnitude_bias=0.02}"
)


@pytest.fixture(scope="module")
def corrected() -> Mission:
    return mission_of(*FEEDBACK, END)


def test_without_feedback_nothing_changes(mission):
    measured = mission_of(*SIGMAS, "navigation.lead_s=7000")
    np.testing.assert_array_equal(measured.times_s, mission.times_s)
    assert measured.problem.feedback is mission.problem.feedback is None


@pytest.mark.parametrize("lead_s", [0.0, 3600.0])
def test_a_useless_measurement_is_reported(mission, lead_s):
    """Errors a million times the dispersion: the mission is the one without feedback."""
    errors = "navigation.sigma_position_m=5e7", "navigation.sigma_velocity_m_s=5e4"
    found = mission_of("policy.kind=feedback", *errors, f"navigation.lead_s={lead_s:g}")
    assert found.problem.feedback is None
    np.testing.assert_array_equal(found.times_s, mission.times_s)
    (word,) = (word for word in found.warnings if "no burn is corrected" in word.given)
    assert word.entry == "navigation.sigma_position_m"
    assert re.search(r"errors are \d{1,3}(,000)+ times", word.given), word.given
    exact = "uncertainty.initial_sigma_fraction=0", "uncertainty.execution_error=0"
    sure = mission_of("policy.kind=feedback", *SIGMAS, *exact, f"navigation.lead_s={lead_s:g}")
    assert sure.problem.feedback is None
    assert "flights that stray" in sure.warnings[-1].given
    # One of the two told alone is a measurement.
    half = mission_of("policy.kind=feedback", SIGMAS[0], errors[1], f"navigation.lead_s={lead_s:g}")
    assert half.problem.feedback is not None


@pytest.mark.parametrize(
    ("overrides", "burns", "cut_offs"),
    [
        ((), [1], [4400.0]),  # nothing feels the burn after the window
        (("navigation.lead_s=0",), [1], [8000.0]),
        (("navigation.lead_s=8000", END), [1, 2], [0.0, 17_000.0]),
        (("navigation.lead_s=8000.5",), [2], [16_999.5]),
        ((LAST,), [1, 2, 3], [4400.0, 21_400.0, 31_242.0]),
        ((END,), [1, 2], [4400.0, 21_400.0]),
    ],
)
def test_cut_offs_are_nodes_before_inner_burns(overrides, burns, cut_offs):
    found = mission_of(*FEEDBACK, *overrides)
    feedback = found.problem.feedback
    assert feedback.burns.tolist() == burns
    assert found.times_s[feedback.cut_offs].tolist() == cut_offs


def in_flight(scenario: Scenario, at_s: float, *, flown: int) -> Mission:
    flight = {
        "at_s": at_s,
        "position_m": [-122.6, 419.9, -556.2],
        "velocity_m_s": [0.00695, 0.07949, 0.06553],
        "flown_m_s": [[0.0, 0.0, 0.0]] * flown,
    }
    return Mission.from_scenario(scenario.replace({"in_flight": flight}))


def test_in_flight_only_future_cut_offs_correct_burns(corrected):
    """A state delivered at its cut-off, to the last bit of a difference of times, is what is known."""
    left = in_flight(corrected.scenario, 17_000.0, flown=2)
    feedback = left.problem.feedback
    assert feedback.burns.tolist() == [0]
    assert left.times_s[feedback.cut_offs[0]] == 21_400.0
    for lead_s, at_s in ((3600.0, 21_400.0), (3600.1, 21_399.9)):
        scenario = corrected.scenario.replace({"navigation.lead_s": lead_s})
        left = in_flight(scenario, at_s, flown=2)
        assert left.problem.feedback is None
        assert not left.warnings


def covariances(mission: Mission) -> Array:
    """Of what is measured at each cut-off, SI."""
    factors = mission.units.state[:, None] * mission.problem.feedback.measurement
    return factors @ np.swapaxes(factors, 1, 2)


def test_measurements_cost_and_probability_are_the_scenarios(corrected):
    expected = np.diag([100.0] * 3 + [2.5e-7] * 3)
    np.testing.assert_allclose(covariances(corrected), [expected] * 2, rtol=1e-12)
    feedback = mission_of(*FEEDBACK, "policy.cost=expected", "risk.p_chance=0.9").problem.feedback
    assert (feedback.cost, feedback.probability) == ("expected", 0.9)
    given = np.diag([100.0, 400.0, 900.0, 1e-6, 4e-6, 9e-6])
    given[0, 4] = given[4, 0] = 0.5 * np.sqrt(given[0, 0] * given[4, 4])
    one = mission_of("policy.kind=feedback", f"navigation.covariance={given.tolist()}", END)
    np.testing.assert_allclose(covariances(one), [given] * 2, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("overrides", "entry", "words"),
    [
        (("policy.kind=feedback",), "policy.kind", "sigma_position_m with sigma_velocity_m_s"),
        ((*FEEDBACK, END, BIASED), "uncertainty.gates.magnitude_bias", "add it to magnitude_prop"),
        ((*FEEDBACK, "navigation.lead_s=25001"), "navigation.lead_s", "most 25000 s, for burn 3"),
        ((*FEEDBACK, LAST, "navigation.lead_s=40000"), "navigation.lead_s", "34842 s, for burn 4"),
    ],
)
def test_feedback_that_can_correct_nothing_is_refused(overrides, entry, words):
    error = refusal(mission_of, *overrides)
    assert error.entry == entry
    assert words in error.allowed


def test_a_cut_off_before_departure_is_named(corrected):
    assert not corrected.warnings
    (warning,) = mission_of(*FEEDBACK, "navigation.lead_s=9000").warnings
    assert str(warning) == (
        "navigation.lead_s: got 9000 s, so that burn 2 at 8000 s is not corrected: its cut-off "
        "precedes departure; expected at most 8000 s"
    )


@pytest.mark.parametrize("entry", ["sigma_position_m=0.01", "sigma_velocity_m_s=0.5"])
def test_errors_in_other_units_are_warned_about(entry):
    (warning,) = mission_of(*SIGMAS, f"navigation.{entry}").warnings
    assert warning.entry == f"navigation.{entry}".partition("=")[0]


CORRECTED: dict[str, Any] = {
    "policy.kind": "feedback",
    "navigation.sigma_position_m": 10.0,
    "navigation.sigma_velocity_m_s": 5e-4,
    "boundary.final_sigma_velocity_m_s": 1.0,
    "grid.step_max_s": 900.0,
}
"""Burns at 0, 8000, 25,000 and 34,842 s, of which all but the first are corrected."""


def scenario_with(**contacts: Any):
    return load_scenario().replace(CORRECTED).replace({"navigation.contacts": contacts})


HOURLY = {"every_s": 3600.0, "turnaround_s": 3600.0}
SELDOM = {"every_s": 28_800.0, "turnaround_s": 3000.0}


def windows(*windows: tuple[float, float]) -> dict[str, Any]:
    return {"windows_s": windows, "turnaround_s": 7100.0}


@pytest.mark.parametrize(
    ("contacts", "expected"),
    [
        (HOURLY, {1: 3600.0, 2: 18_000.0, 3: 28_800.0}),
        (HOURLY | {"length_s": 1000.0}, {1: 0.0, 2: 18_000.0, 3: 28_800.0}),
        (SELDOM | {"first_s": 2000.0}, {1: 2000.0, 3: 30_800.0}),
        (windows((100.0, 900.0), (9000.0, 9000.0)), {1: 100.0, 2: 9000.0}),
        (windows((100.0, 901.0), (9000.0, 9000.0)), {2: 9000.0}),
        (SELDOM | {"onboard": (2, 3)}, {1: 4400.0, 2: 21_400.0, 3: 28_800.0}),
    ],
)
def test_burns_use_the_last_contact_in_time(contacts, expected):
    """A turnaround after its end, with the data from before its beginning; on board all data count."""
    scenario = scenario_with(**contacts)
    assert cut_offs_s(scenario) == pytest.approx(expected)
    for burn in expected:
        contact = contact_of(scenario, burn)
        assert (contact is None) == (burn + 1 in contacts.get("onboard", ()))
        if contact is not None:
            assert contact[1] + contacts["turnaround_s"] <= scenario.burn_times_s[burn]


def test_burns_without_newer_data_are_named():
    mission = Mission.from_scenario(
        scenario_with(every_s=28_800.0, turnaround_s=3000.0, first_s=2000.0)
    )
    (told,) = [str(w) for w in mission.warnings if w.entry == "navigation.contacts"]
    assert "burn 3 at 25000 s" in told
    assert mission.feedback is not None
    assert mission.feedback.burns.tolist() == [1, 3]


@pytest.mark.parametrize(
    ("contacts", "words"),
    [
        ({"windows_s": ((40_000.0, 41_000.0),), "turnaround_s": 600.0}, "ends by 34242 s"),
        ({"windows_s": ((0.0, 900.0),), "turnaround_s": 40_000.0}, "turnaround_s: got 40000 s"),
        ({"windows_s": ((9000.0, 8000.0),), "turnaround_s": 600.0}, "in order"),
        ({"windows_s": ((0.0, 1.0),), "every_s": 600.0, "turnaround_s": 600.0}, "in one way"),
        ({"turnaround_s": 600.0}, "in one way"),
        ({"windows_s": ((0.0, 1.0),), "first_s": 5.0, "turnaround_s": 600.0}, "with every_s"),
        ({"every_s": 600.0, "length_s": 700.0, "turnaround_s": 600.0}, "below every_s"),
        ({"every_s": 600.0, "turnaround_s": 600.0, "onboard": (9,)}, "among 1 to 4"),
        ({"every_s": 600.0, "turnaround_s": -1.0}, "turnaround_s"),
        ({"every_s": 600.0, "turnaround_s": 1.0, "what_if_lost": "all"}, "what_if_lost"),
    ],
)
def test_bad_contacts_are_refused_in_one_message(contacts, words):
    error = refusal(lambda: Mission.from_scenario(scenario_with(**contacts)))
    assert words in str(error)
    assert "navigation.contacts" in str(error)


@pytest.mark.slow
def test_lost_contacts_are_reported(monkeypatch):
    """Without its contact a burn is commanded as predicted: with none before, as planned."""
    fly_few(monkeypatch)
    scenario = scenario_with(every_s=3600.0, turnaround_s=3600.0, what_if_lost="any")
    plan = from_cold(Mission.from_scenario(scenario))
    mission, policy = plan.mission, policy_of(plan.mission, plan.final.result.lin)
    checked = verify(mission, make_solution(plan))
    assert checked.ok
    assert checked.lost_contacts is not None
    found = [(one.burn, one.begin_s) for one in checked.lost_contacts]
    assert found == [(2, 3600.0), (3, 18_000.0), (4, 28_800.0)]
    first, *_, last = checked.lost_contacts
    kept = min(p.estimate for p in checked.probabilities)
    assert first.worst.estimate < kept - 0.05
    assert last.worst.estimate == pytest.approx(kept)  # it is after the window
    draws = Flyer(mission, plan.burns_m_s, policy).draws(0)[:20]
    spread = []
    for one in (policy, (policy[0].lost, *policy[1:])):
        flown = Flyer(mission, plan.burns_m_s, one).fly(mission.times_s[-1:], draws)
        spread.append(float(np.ptp(flown.commanded_m_s[:, 1], axis=0).max()))
    assert spread[0] > 1e-3
    assert spread[1] == 0.0
