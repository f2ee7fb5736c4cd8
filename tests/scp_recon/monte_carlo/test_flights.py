"""What flights add up to depends on their configuration alone; intervals narrow as promised."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo import flights as flights_module
from scp_recon.monte_carlo.flights import FlightConfig, FlightTally, fly_many
from scp_recon.monte_carlo.observation_time import ALL, SCIENCE
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import FILE_NAME, read_summary
from scp_recon.montecarlo import main
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.scenario.uncertainty import Uncertainty
from scp_recon.solution.file import Solution
from scp_recon.solution.from_plan import make_solution


@pytest.fixture(scope="module")
def flown(mission: Mission, solution: Solution) -> FlightTally:
    return fly_many(FlightConfig(mission, solution.burns_m_s), samples=3000)


def test_workers_do_not_change_the_result(
    mission: Mission, solution: Solution, flown: FlightTally
) -> None:
    other = fly_many(FlightConfig(mission, solution.burns_m_s), samples=3000, workers=2)
    assert summarise(other, solution) == summarise(flown, solution)


def test_until_stops_at_the_width_asked(mission: Mission, solution: Solution) -> None:
    config = FlightConfig(mission, solution.burns_m_s)
    stopped = fly_many(config, samples=20_000, until=0.03)
    assert stopped.widest_interval() <= 0.03
    assert stopped.samples < 20_000
    earlier = fly_many(config, samples=stopped.samples - 1000)
    assert earlier.widest_interval() > 0.03


def test_memory_does_not_grow_with_the_flights(flown: FlightTally) -> None:
    assert len(flown.terminal) <= flights_module.TERMINAL_KEPT
    sizes = {len(tally.counts) for tally in flown.held.values()}
    assert max(sizes) < 10_000


def test_a_plan_holds_all_constraints_when_nothing_errs(
    mission: Mission, solution: Solution
) -> None:
    certain = mission.scenario.uncertainty.model_copy(
        update={"initial_sigma_fraction": 0.0, "execution_error": 0.0}
    )
    sure = Mission.from_scenario(mission.scenario.model_copy(update={"uncertainty": certain}))
    flown = fly_many(FlightConfig(sure, solution.burns_m_s), samples=20)
    first, last = sure.schedule.window_s
    assert flown.held[ALL].mean().value == pytest.approx(last - first, abs=1e-6)
    assert flown.executed_dv.mean().value == pytest.approx(solution.total_dv_m_s, abs=1e-12)


def test_probabilities_exceed_what_was_asked(flown: FlightTally, mission: Mission) -> None:
    for name in SCIENCE:
        _, estimate = flown.worst_probability(name)
        assert estimate.low > mission.scenario.risk.p_chance
        assert estimate.low <= estimate.value <= estimate.high


def test_all_at_once_is_bounded_by_its_parts(flown: FlightTally) -> None:
    """Frechet: no more than the least probable part, no less than Boole allows."""
    parts = [flown.node_counts[name] for name in SCIENCE]
    together = flown.node_counts[ALL]
    assert (together <= np.minimum.reduce(parts)).all()
    assert (together >= sum(parts) - 2 * flown.samples).all()


def test_predicted_covariance_lies_in_the_interval_of_the_sampled_one_for_small_errors(
    mission: Mission,
) -> None:
    """With errors a hundred times smaller the flow is linear over the whole flight."""
    from scp_recon.planning import initial_guess
    from scp_recon.planning.planner import plan
    from scp_recon.solution.from_plan import make_solution

    small = mission.scenario.uncertainty.model_copy(
        update={"initial_sigma_fraction": 1e-4, "execution_error": 8e-4}
    )
    tame = Mission.from_scenario(mission.scenario.model_copy(update={"uncertainty": small}))
    design = make_solution(plan(tame, initial_guess.cold(tame)))
    summary = summarise(fly_many(FlightConfig(tame, design.burns_m_s), samples=3000), design)
    ratios = [ratio.estimate for ratio in summary.terminal.sigma_ratio.values()]
    # Six intervals at 95 %: more than one miss has a probability of 3 %.
    assert sum(not r.low <= 1.0 <= r.high for r in ratios) <= 1
    p_values = [test.p_value for test in summary.terminal.normality.values()]
    assert min(p_values) > 1e-4


def test_command_writes_a_summary_beside_the_solution(
    solution: Solution, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    solution.write(tmp_path)
    assert main([str(tmp_path), "--samples", "400", "--errors", "gates"]) == 0
    summary = read_summary(tmp_path)
    assert summary.samples == 400
    assert summary.errors == "gates"
    assert summary.is_of(solution)
    printed = capsys.readouterr().out
    for name in (*SCIENCE, "all at once", "closest approach", "normality"):
        assert name in printed


def test_without_uncertainty_nothing_spreads_and_the_report_is_json(
    mission: Mission, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    none = {"initial_sigma_fraction": 0.0, "execution_error": 0.0}
    certain = Mission.from_scenario(
        mission.scenario.model_copy(update={"uncertainty": Uncertainty(**none)})
    )
    make_solution(plan(certain, initial_guess.cold(certain))).write(tmp_path)
    assert main([str(tmp_path), "--samples", "50"]) == 0

    def no_constant(text: str) -> None:
        raise AssertionError(f"{text} is no JSON")

    text = (tmp_path / FILE_NAME).read_text("utf-8")
    report = json.loads(text, parse_constant=no_constant)
    assert report["terminal"] == {"sigma_ratio": {}, "normality": {}}
    assert "no component spreads" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments",
    [
        ["--samples", "1"],
        ["--until", "0.5"],
        ["--until", "0%"],
        ["--workers", "0"],
        ["--truth", "x"],
    ],
)
def test_bad_options_exit_with_two(tmp_path: Path, arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([str(tmp_path), *arguments])
    assert stop.value.code == 2


def test_a_folder_without_a_solution_exits_with_two(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path)]) == 2
    assert "solution.json" in capsys.readouterr().err.replace("\n", "")
    assert list(tmp_path.iterdir()) == []
