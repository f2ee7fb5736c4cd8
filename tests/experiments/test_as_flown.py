"""The flight's kernel is read, followed by impulses, and refused in one sentence where it cannot be."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
import spiceypy

from experiments.__main__ import main
from experiments.observation_table.rows import as_flown_burns, read_states
from formulations.arrays import Array
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.physics.flow import propagate
from scp_recon.planning import initial_guess
from scp_recon.results.read import read_solution
from scp_recon.scenario.schema import Epoch
from tests.helpers import nightly

from .support import QUICK, table_of, write_kernel


def study(*words: str) -> int:
    """The command."""
    return main(["observation_table", *words])


@pytest.fixture(scope="module")
def flight(mission: Mission) -> Array:
    """The ballistic arc, its departure in two halves of which the second comes half an hour late."""
    half = 0.5 * initial_guess.ballistic(mission).burns[0] * mission.units.speed_m_s
    late = int(np.searchsorted(mission.times_s, 1800.0))
    states = np.empty((len(mission.times_s), 6))
    states[0] = mission.initial_state
    for k, duration in enumerate(np.diff(mission.times_s)):
        if k in (0, late):
            states[k, 3:] += half
        states[k + 1] = propagate(states[k], duration, mission.forces)
    return states


@pytest.fixture(scope="module")
def kernel(mission: Mission, flight: Array, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_kernel(tmp_path_factory.mktemp("kernel") / "flight.bsp", mission, flight)


def test_states_come_back_from_the_kernel(mission: Mission, kernel: Path, flight: Array) -> None:
    np.testing.assert_allclose(read_states(mission, kernel), flight, rtol=1e-12, atol=1e-9)
    assert spiceypy.ktotal("ALL") == 0  # and the kernel is put back


def test_fitted_impulses_follow_a_burn_that_was_fired_away_from_the_firing_times(
    mission: Mission, kernel: Path, flight: Array, tmp_path: Path
) -> None:
    burns, distance_m = as_flown_burns(mission, kernel, tmp_path / "states.csv")
    flown = initial_guess.from_burns(mission, burns).mean * mission.units.state
    window = mission.window_nodes
    off = np.linalg.norm(flown[window, :3] - flight[window, :3], axis=1).max()
    assert off == pytest.approx(distance_m, rel=1e-6)
    assert off < 10.0
    np.testing.assert_allclose(flown[-1, 3:], mission.final_state[3:], atol=1e-9)
    # Read off at the firing times alone the second half is lost.
    table = initial_guess.from_table(mission, tmp_path / "states.csv")
    lost = initial_guess.from_burns(mission, table.burns * mission.units.speed_m_s).mean
    assert np.linalg.norm(lost[window, :3] - flown[window, :3] / mission.units.length_m) > 0.1


@nightly
def test_the_flight_gets_a_row_and_warm_rows_are_designed_anew_when_their_start_changes(
    copy: Path, kernel: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*arguments: str) -> dict[str, str]:
        """What is said of every row."""
        assert study(*QUICK, "--out", str(copy), *arguments) == 0
        lines = capsys.readouterr().out.splitlines()
        return {line.split()[0]: line for line in lines if " m/s, observes " in line}

    assert read_solution(copy / "scp_warm").init == "warm"
    by_flight = run("--as-flown", str(kernel))
    assert read_solution(copy / "scp_warm").init == "as_flown"
    assert "taken up" not in by_flight["scp_warm"]
    assert "taken up" in by_flight["scp_cold"]
    assert table_of(copy)["scp_warm"]["label"] == "SCP, warm start from the flight"
    own = table_of(copy)["as_flown"]
    assert (own["paper_row"], own["status"]) == ("OSIRIS-REx", "given, not optimised")
    text = (copy / "observation_table.md").read_text("utf-8")
    assert "flight.bsp" in text
    assert "kernel was not at hand" not in text
    # From the flight as from the arc P2's optimum is the same.
    assert read_solution(copy / "scp_warm").status == "converged"
    warm, cold = (float(table_of(copy)[f"scp_{s}"]["total_dv_m_s"]) for s in ("warm", "cold"))
    assert warm == pytest.approx(cold, rel=1e-4)
    by_arc = run()
    assert read_solution(copy / "scp_warm").init == "warm"
    assert "taken up" not in by_arc["scp_warm"]
    assert table_of(copy)["scp_warm"]["label"] == "SCP, warm start"
    assert "taken up" in run()["scp_warm"]


def test_a_kernel_that_does_not_cover_the_flight_exits_with_two(
    mission: Mission, kernel: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    later = mission.scenario.model_copy(
        update={"epoch": Epoch(tdb=mission.scenario.epoch.tdb + timedelta(days=1))}
    )
    with pytest.raises(InputError, match=r"flight.bsp: got .*must give -64 about 2101955"):
        read_states(replace(mission, scenario=later), kernel)
    for name in ("missing.bsp", "text.bsp"):
        (tmp_path / "text.bsp").write_text("no kernel", encoding="utf-8")
        out = tmp_path / "out"
        assert study(*QUICK, "--out", str(out), "--as-flown", str(tmp_path / name)) == 2
        errors = capsys.readouterr().err
        assert errors.startswith(f"error: --as-flown {tmp_path / name}: got ")
        assert errors.count("\n") == 1
        assert not out.exists()
