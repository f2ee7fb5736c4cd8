"""Flights of the uncertainty study: its samples, and going on after a stop."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.harness import Record
from experiments.uncertainty_sources import flights
from experiments.uncertainty_sources.flights import (
    CHEMICAL,
    INITIAL,
    SETS,
    TRANSLATION,
    dispersion,
    fly_all,
    fly_paths,
)
from scp_recon.jobs.store import Store
from scp_recon.mission.mission import Mission
from scp_recon.results.solution import Solution
from scp_recon.simulation.vehicle import Vehicle

from .support import simulated

# --- flights --------------------------------------------------------------------------------------


def test_paths_without_errors_end_as_planned(solution: Solution, vehicle: Vehicle) -> None:
    ends = fly_paths(solution, vehicle, (), 3, 0)
    np.testing.assert_allclose(ends, np.tile(solution.nodes.state[-1], (3, 1)), atol=1e-6)


def test_paths_spread_as_the_linearised_flight_does(solution: Solution, vehicle: Vehicle) -> None:
    """Finite differences of the end by each error, times the errors' sigmas."""
    mission = Mission.from_scenario(solution.scenario)
    units, step = mission.units, 1e-4
    sigma = vehicle.errors.initial_state * np.abs(mission.initial_state)
    # The draws come in the order: initial state, then a factor for each burn.
    starts = np.vstack([np.diag(step * sigma), np.zeros((5, 6))]) + mission.initial_state
    factors = np.vstack([np.zeros((6, 4)), step * np.eye(4), np.zeros((1, 4))])
    burns = solution.burns_m_s * (1.0 + vehicle.errors.chemical_thruster * factors[:, :, None])
    ends = mission.dynamics.rollout(starts / units.state, burns / units.speed_m_s)[-1] * units.state
    sensitivity = (ends[:-1] - ends[-1]) / step
    expected = {
        (INITIAL,): sensitivity[:6],
        (CHEMICAL,): sensitivity[6:],
        TRANSLATION: sensitivity,
    }
    for sources, factor in expected.items():
        found = fly_paths(solution, vehicle, sources, 4000, 1)
        rms = np.sqrt(np.sum(factor[:, :3] ** 2))
        # Curvature and 4000 flights leave some per cent.
        assert dispersion(found[:, :3] - ends[-1, :3]).value == pytest.approx(rms, rel=0.08)


def test_a_flight_is_the_same_however_many_are_flown(solution: Solution, vehicle: Vehicle) -> None:
    many = fly_paths(solution, vehicle, TRANSLATION, 1200, 3)
    few = fly_paths(solution, vehicle, TRANSLATION, 7, 3)
    np.testing.assert_allclose(few, many[:7], rtol=1e-12)


def test_sets_are_the_vehicles_errors(vehicle: Vehicle) -> None:
    fields = type(vehicle.errors).model_fields  # a source's name, and its unit
    assert len(fields) == len(SETS["all"])
    assert all(sum(field.startswith(name) for field in fields) == 1 for name in SETS["all"])
    alone = [sources for sources in SETS.values() if len(sources) == 1]
    assert sorted(alone) == sorted((source,) for source in SETS["all"])


def test_sets_are_the_simulations_sources() -> None:
    simulation = pytest.importorskip("scp_recon.simulation.basilisk.simulation")
    assert {source.value for source in simulation.Source} == set(SETS["all"])


@pytest.mark.parametrize("workers", ["1", "2"])
def test_without_basilisk_the_extra_is_named(
    solution: Solution, tmp_path: Path, workers: str
) -> None:
    solution.write(tmp_path)
    code = (
        "import sys; sys.modules['Basilisk'] = None\n"
        "from experiments.__main__ import main; sys.exit(main(sys.argv[1:]))"
    )
    options = [
        "uncertainty_sources",
        "--solution",
        str(tmp_path),
        "--out",
        str(tmp_path),
        "--workers",
        workers,
    ]
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", code, *options],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert run.returncode == 2
    assert "needs the extra scp_recon[sim]" in run.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["solution.json"]


# --- going on where it stopped --------------------------------------------------------------------


def test_flights_in_the_store_are_not_flown_again(
    solution: Solution, vehicle: Vehicle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown: list[tuple[str, int]] = []

    def spy(solution: Solution, vehicle: Vehicle, job: tuple[str, int]) -> Record:
        if job == ("imu", 1) and not flown.count(("all", 0)):
            raise KeyboardInterrupt
        flown.append(job)
        return simulated(solution, vehicle, job)

    monkeypatch.setattr(flights, "fly_spacecraft", spy)
    jobs = [("none", 0), ("imu", 0), ("imu", 1), ("all", 0)]
    with (
        Store(tmp_path / "flights.jsonl", {}) as store,
        pytest.raises(KeyboardInterrupt),
    ):
        fly_all(store, solution, vehicle, jobs)
    assert flown == jobs[:2]
    flown.append(("all", 0))  # from now on nothing stops it
    told: list[None] = []
    with Store(tmp_path / "flights.jsonl", {}) as store:
        again = fly_all(store, solution, vehicle, jobs, tell=lambda: told.append(None))
    assert flown == [*jobs[:2], ("all", 0), *jobs[2:]]
    assert again == [simulated(solution, vehicle, job) for job in jobs]
    assert len(told) == len(jobs)


def test_two_processes_fly_what_one_does(
    solution: Solution, vehicle: Vehicle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("Basilisk")
    monkeypatch.setattr(flights, "fly_spacecraft", simulated)
    jobs = [("imu", seed) for seed in range(5)]
    with Store(tmp_path / "flights.jsonl", {}) as store:
        found = fly_all(store, solution, vehicle, jobs, workers=2)
        assert len(store) == len(jobs)
    assert found == [simulated(solution, vehicle, job) for job in jobs]
