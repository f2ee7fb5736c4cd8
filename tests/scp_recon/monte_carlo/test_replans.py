"""Flights that are planned again before each burn: what they know, what they fly, and what fails."""

from dataclasses import replace

import numpy as np
import pytest

from formulations.arrays import Array
from scp_recon.api.plan_verbs import fly
from scp_recon.cli.commands import montecarlo
from scp_recon.errors import InputError
from scp_recon.monte_carlo import closed_loop as module
from scp_recon.monte_carlo.closed_loop import Replan, replans
from scp_recon.monte_carlo.sampling import FlightLog, Flyer
from scp_recon.monte_carlo.summary import read_summary
from scp_recon.results.solution import Solution
from tests.scp_recon.monte_carlo.test_closed_loop import case_of
from tests.scp_recon.support import mission_of

MEASURED = "navigation.sigma_position_m=10", "navigation.sigma_velocity_m_s=5e-4"


def flown(solution: Solution, flights: int, *words: str) -> tuple[FlightLog, tuple[Replan, ...]]:
    mission, burns = mission_of(*MEASURED, *words), solution.burns_m_s
    again = replans(mission, burns)
    times = np.array([*(one.cut_off_s for one in again), mission.times_s[-1]])
    return Flyer(mission, burns, again).fly_block(times, 0, flights=flights), again


@pytest.mark.parametrize("lead_s", [3600.0, 7000.0])
def test_knowledge_at_cut_offs_matches_planners_filter(solution, lead_s):
    """By rows of innovations, without corrections."""
    case = case_of(lead_s, solution, size=0.0)
    found = replans(case.mission, case.burns_m_s)
    assert [one.cut_off_s for one in found] == [one.cut_off_s for one in case.policy]
    for one, expected in zip(found, case.policy, strict=True):
        assert one.burn == expected.burn
        sigma = np.sqrt(np.diag(expected.estimate_covariance))
        scale = np.outer(sigma, sigma)
        np.testing.assert_allclose(
            one.estimate_covariance / scale, expected.estimate_covariance / scale, atol=1e-5
        )
        known = one.mission.initial_factor @ one.mission.initial_factor.T
        np.testing.assert_allclose(known / scale, one.estimate_covariance / scale, atol=1e-6)


def test_failed_replan_flies_the_last_plan(solution, monkeypatch):
    """Where the first replan finds burns for half of the flights, and the others none."""
    found: list[Array] = []

    def for_some(one: Replan, states: Array) -> Array:
        burns = np.full((len(states), *one.burns_m_s.shape), np.nan)
        if not found:
            burns[::2] = one.burns_m_s + 1e-4
        found.append(burns)
        return burns

    monkeypatch.setattr(module, "_plan_again", for_some)
    flights, _ = flown(solution, 20)
    np.testing.assert_array_equal(flights.failed.sum(axis=1), [10, 20, 20])
    np.testing.assert_allclose(flights.commanded_m_s[::2, 1:] - solution.burns_m_s[1:], 1e-4)
    alone = Flyer(mission_of(*MEASURED), solution.burns_m_s).fly_block(np.zeros(1), 0, flights=20)
    np.testing.assert_array_equal(flights.burns_m_s[1::2], alone.burns_m_s[1::2])


@pytest.mark.slow
def test_the_command_flies_a_plan_by_any_policy(solution, tmp_path, capsys):
    """Another policy than the plan's has a file of its own. What is planned again meets the end."""
    replace(solution, scenario=mission_of(*MEASURED).scenario).write(tmp_path)
    montecarlo.main([str(tmp_path), "--samples=20", "--policy=replan"])
    shown = capsys.readouterr().out
    assert "policy replan" in shown
    assert "failed replans" in shown
    again = read_summary(tmp_path / "montecarlo_replan.json")
    assert again.policy == "replan"
    assert [(burn.burn, burn.failed) for burn in again.commanded.burns] == [(2, 0), (3, 0), (4, 0)]
    assert not (tmp_path / "montecarlo.json").exists()
    montecarlo.main([str(tmp_path), "--samples=20"])
    alone = read_summary(tmp_path)
    assert alone.policy == "open"
    sizes = again.terminal.sigma_position_m.estimate, alone.terminal.sigma_position_m.estimate
    assert sizes[0].high < 0.25 * sizes[1].low


@pytest.mark.parametrize(
    ("policy", "words", "told"),
    [
        ("feedback", MEASURED, "without gains"),
        ("replan", (), "without a measurement"),
        ("replan", (*MEASURED, "navigation.lead_s=20000"), "cut-off of burn 3 precedes"),
    ],
)
def test_policies_that_a_plan_cannot_fly_are_refused(solution, policy, words, told):
    given = replace(solution, scenario=mission_of(*words).scenario)
    with pytest.raises(InputError, match=told):
        fly(given, samples=20, policy=policy)  # type: ignore[arg-type]
