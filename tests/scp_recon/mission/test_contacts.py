"""Contacts: which data a burn uses, and what a lost contact does."""

from typing import Any

import numpy as np
import pytest

from scp_recon.mission.feedback import contact_of, cut_offs_s
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.results.policy import policy_of
from scp_recon.results.solution import make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.verification.reintegration import verify
from tests.scp_recon.support import fly_few, from_cold, refusal

FEEDBACK: dict[str, Any] = {
    "policy.kind": "feedback",
    "navigation.sigma_position_m": 10.0,
    "navigation.sigma_velocity_m_s": 5e-4,
    "boundary.final_sigma_velocity_m_s": 1.0,
    "grid.step_max_s": 900.0,
}
"""Burns at 0, 8000, 25,000 and 34,842 s, of which all but the first are corrected."""


def scenario_with(**contacts: Any):
    return load_scenario().replace(FEEDBACK).replace({"navigation.contacts": contacts})


HOURLY = {"every_s": 3600.0, "turnaround_s": 3600.0}
SELDOM = {"every_s": 28_800.0, "turnaround_s": 3000.0}


def given(*windows: tuple[float, float]) -> dict[str, Any]:
    return {"windows_s": windows, "turnaround_s": 7100.0}


@pytest.mark.parametrize(
    ("contacts", "expected"),
    [
        (HOURLY, {1: 3600.0, 2: 18_000.0, 3: 28_800.0}),
        (HOURLY | {"length_s": 1000.0}, {1: 0.0, 2: 18_000.0, 3: 28_800.0}),
        (SELDOM | {"first_s": 2000.0}, {1: 2000.0, 3: 30_800.0}),
        (given((100.0, 900.0), (9000.0, 9000.0)), {1: 100.0, 2: 9000.0}),
        (given((100.0, 901.0), (9000.0, 9000.0)), {2: 9000.0}),
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
    draws = Flyer(mission, plan.burns_m_s, policy).draws(0, 0)[:20]
    spread = []
    for one in (policy, (policy[0].lost, *policy[1:])):
        flown = Flyer(mission, plan.burns_m_s, one).fly(mission.times_s[-1:], draws)
        spread.append(float(np.ptp(flown.commanded_m_s[:, 1], axis=0).max()))
    assert spread[0] > 1e-3
    assert spread[1] == 0.0
