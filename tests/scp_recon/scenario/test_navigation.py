"""The tables `[navigation]` and `[policy]`: what is said in them, what is refused, what is kept."""

import json

import numpy as np
import pytest

from scp_recon.errors import InputError
from scp_recon.scenario.dependencies import with_todays_lead
from scp_recon.scenario.load import load_scenario, scenario_text, validate_scenario

SIGMAS = "navigation.sigma_position_m=10", "navigation.sigma_velocity_m_s=5e-4"
MATRIX = f"navigation.covariance={np.diag([100.0] * 3 + [2.5e-7] * 3).tolist()}"
RTN = "navigation.frame=rtn"


def test_tables_that_say_nothing_are_not_written():
    """So that files, and hashes of plans, from before there were any stay what they were."""
    scenario = load_scenario()
    assert not {"navigation", "policy"} & scenario.model_dump(mode="json").keys()
    same = load_scenario(None, ["navigation.lead_s=3600", "policy.kind=open", "policy.cost=dv99"])
    assert scenario_text(same) == scenario_text(scenario)


def test_what_is_said_is_written_and_read_again(tmp_path):
    told = load_scenario(None, [MATRIX, RTN, "navigation.lead_s=14400", "policy.kind=feedback"])
    file = tmp_path / "mine.toml"
    file.write_text(scenario_text(told), "utf-8")
    assert load_scenario(file) == validate_scenario(json.loads(told.model_dump_json())) == told
    assert told.navigation.measures
    assert not load_scenario(None, ["navigation.lead_s=0"]).navigation.measures


def test_one_way_to_say_the_errors_replaces_the_other():
    first = load_scenario(None, [MATRIX, RTN])
    second = first.replace(
        {"navigation.sigma_position_m": 1.0, "navigation.sigma_velocity_m_s": 1e-4}
    )
    assert second.navigation.covariance is second.navigation.frame is None
    assert (
        second.replace({"navigation.sigma_position_m": 2.0}).navigation.sigma_velocity_m_s == 1e-4
    )
    assert first.replace({"navigation.lead_s": 0.0}).navigation.covariance is not None


@pytest.mark.parametrize(
    ("overrides", "entry", "words"),
    [
        (["navigation.lead_s=-1"], "navigation.lead_s", "at least 0"),
        (
            ["navigation.sigma_position_m=-10", SIGMAS[1]],
            "navigation.sigma_position_m",
            "least 1e-12",
        ),
        (
            ["navigation.sigma_position_m=0", SIGMAS[1]],
            "navigation.sigma_position_m",
            "least 1e-12",
        ),
        ([MATRIX.replace("100.0", "0.0", 1), RTN], "navigation.covariance", "positive definite"),
        (
            [
                MATRIX.replace("[100.0, 0.0", "[100.0, 100.0", 1).replace(
                    "[0.0, 100.0", "[100.0, 100.0"
                ),
                RTN,
            ],
            "navigation.covariance",
            "positive definite",
        ),
        (SIGMAS[:1], "navigation", "must have sigma_velocity_m_s"),
        (SIGMAS[1:], "navigation", "must have sigma_position_m"),
        ([*SIGMAS, MATRIX, RTN], "navigation", "in one way"),
        ([MATRIX], "navigation", "must have frame"),
        ([RTN], "navigation", "must have covariance"),
        ([MATRIX, "navigation.frame=body_fixed"], "navigation.frame", "'j2000' or 'rtn'"),
        (["navigation.covariance=[[1.0]]", RTN], "navigation.covariance", "6 rows of 6"),
        ([MATRIX.replace("100.0", "-100.0", 1), RTN], "navigation.covariance", "entry 1,1 is -100"),
        (["policy.kind=closed"], "policy.kind", "'open' or 'feedback'"),
        (["policy.cost=mean"], "policy.cost", "'nominal', 'expected' or 'dv99'"),
        (["schedule.decision_lead_s=900"], "schedule.decision_lead_s", "navigation.lead_s"),
    ],
)
def test_what_does_not_go_is_refused_in_one_message(overrides, entry, words):
    with pytest.raises(InputError) as caught:
        load_scenario(None, overrides)
    assert (caught.value.entry, "\n" in caught.value.allowed) == (entry, False)
    assert words in caught.value.allowed


def test_a_stored_flight_under_way_keeps_the_lead_that_it_was_planned_with():
    """Of a whole flight, on which only later decisions bear, today's default counts."""
    stored = {"schedule": {"attitude_s": 1800.0, "decision_lead_s": 1800.0}, "in_flight": None}
    assert with_todays_lead(stored) == {"schedule": {"attitude_s": 1800.0}, "in_flight": None}
    flying = stored | {"in_flight": {"at_s": 17_000.0}}
    assert with_todays_lead(flying)["navigation"] == {"lead_s": 1800.0}
    assert stored["schedule"] == {"attitude_s": 1800.0, "decision_lead_s": 1800.0}
