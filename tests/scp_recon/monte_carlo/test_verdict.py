"""A campaign ends with a verdict: every probability beside the one that was asked."""

from __future__ import annotations

from pathlib import Path

import pytest

from scp_recon import montecarlo
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import Summary
from scp_recon.monte_carlo.verdict import probability_asked, shortfalls
from scp_recon.solution.file import Solution
from tests.scp_recon.support import file_of, mission_of


@pytest.fixture(scope="module")
def summary(mission: Mission, solution: Solution) -> Summary:
    return summarise(fly_many(FlightConfig(mission, solution.burns_m_s), samples=1000), solution)


def asking(solution: Solution, p: float) -> Solution:
    return solution.model_copy(update={"scenario": solution.scenario.replace({"risk.p_chance": p})})


def test_what_was_asked_is_met(summary: Summary, solution: Solution) -> None:
    assert shortfalls(summary, solution) == []


@pytest.mark.parametrize(("until", "status"), [("30%", 0), ("5%", 4)])
def test_an_interval_that_stays_too_wide_is_not_what_was_asked(
    until: str, status: int, solution: Solution, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where the flights allowed are too few to narrow it."""
    solution.write(tmp_path)
    assert montecarlo.main([str(tmp_path), "--samples", "300", "--until", until]) == status
    said = " ".join(capsys.readouterr().out.split())
    assert ("%, asked 5 %: needs more --samples" in said) == bool(status)


def test_what_is_not_met_stands_beside_what_was_asked(summary: Summary, solution: Solution) -> None:
    found = shortfalls(summary, asking(solution, 0.99))
    short = {n for n, p in summary.probability.items() if p.estimate.value < 0.99} - {ALL}
    assert "site_distance" in short
    assert {line.split()[0] for line in found} == short
    assert all(line.endswith("asked 0.99") for line in found)


def test_nothing_is_asked_of_a_plan_without_uncertainty(
    summary: Summary, solution: Solution
) -> None:
    certain = asking(solution, 0.99).model_copy(update={"problem": "P3"})
    assert probability_asked(certain) is None
    assert shortfalls(summary, certain) == []


def test_a_plan_that_did_not_converge_is_named(summary: Summary, solution: Solution) -> None:
    infeasible = solution.model_copy(update={"status": "infeasible"})
    assert shortfalls(summary, infeasible) == ["the plan is infeasible, asked converged"]


def test_the_command_ends_with_four_and_says_why(
    solution: Solution, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    infeasible = asking(solution, 0.99).model_copy(update={"status": "infeasible"})
    infeasible.write(tmp_path)
    assert montecarlo.main([str(tmp_path), "--samples", "200"]) == 4
    said = " ".join(capsys.readouterr().out.split())
    assert "not as asked: the plan is infeasible, asked converged, site_distance 0." in said
    assert "asked 0.99" in said


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("body.gm_m3_s2=4.0", "body.gm_m3_s2 4"),
        ("body.reference_radius_m=280.0", "body.reference_radius_m 280"),
        ("body.j2=0.01", "body.j2 0.01"),
    ],
)
def test_the_packaged_field_is_flown_about_its_own_body_only(
    override: str, words: str, solution: Solution
) -> None:
    mission = mission_of(override)
    with pytest.raises(InputError, match=words):
        FlightConfig(mission, solution.burns_m_s, truth="harmonics")
    FlightConfig(mission, solution.burns_m_s)


def test_the_packaged_field_is_not_flown_about_a_body_of_another_name(solution: Solution) -> None:
    """Though all its figures are Bennu's."""
    mission = Mission.from_scenario(file_of(solution.scenario, {}, name="Apophis"))
    with pytest.raises(InputError, match="nothing for Apophis"):
        FlightConfig(mission, solution.burns_m_s, truth="harmonics")


def test_the_packaged_field_is_flown_about_bennu(mission: Mission, solution: Solution) -> None:
    FlightConfig(mission, solution.burns_m_s, truth="harmonics")
