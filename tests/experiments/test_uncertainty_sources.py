"""The uncertainty study: its samples, its statistics, its verdicts, and going on after a stop."""

from __future__ import annotations

import csv
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from experiments import uncertainty_flights
from experiments.observation_rows import rows
from experiments.uncertainty_flights import (
    ATTITUDE,
    CHEMICAL,
    INITIAL,
    NO_ERRORS,
    SETS,
    STATE,
    TRANSLATION,
    Flown,
    Logbook,
    fly_all,
    fly_paths,
)
from experiments.uncertainty_report import (
    BOTH,
    SPACECRAFT,
    Measured,
    measure_flights,
    measure_paths,
    verdicts,
)
from experiments.uncertainty_sources import main
from experiments.uncertainty_statistics import dispersion, normality
from scp_recon.mission import Mission
from scp_recon.scenario import load_scenario
from scp_recon.solution import Solution
from scp_recon.spacecraft.vehicle import Vehicle, load_vehicle


@pytest.fixture(scope="module")
def solution() -> Solution:
    """Burns that are given, not planned: the study does not mind."""
    design = next(row.design for row in rows(ipopt=False) if row.key == "ballistic")
    return design(Mission.from_scenario(load_scenario()))


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    return load_vehicle()


def simulated(solution: Solution, _: Vehicle, job: tuple[str, int]) -> Flown:
    """A flight that ends 0.1 m off the plan for each source that errs, 100 m for those of the path."""
    errs, seed = job
    scale = sum(100.0 if source in TRANSLATION else 0.1 for source in SETS[errs])
    off = scale * np.random.default_rng([seed, len(errs)]).standard_normal(6)
    state = np.array(solution.nodes.state[-1]) + off * np.repeat([1.0, 1e-4], 3)
    return Flown(errs, seed, tuple(state.tolist()), 1e-4)


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
    simulation = pytest.importorskip("scp_recon.spacecraft.simulation")
    assert {source.value for source in simulation.Source} == set(SETS["all"])


@pytest.mark.parametrize("workers", ["1", "2"])
def test_without_basilisk_the_extra_is_named(
    solution: Solution, tmp_path: Path, workers: str
) -> None:
    solution.write(tmp_path)
    code = (
        "import sys; sys.modules['Basilisk'] = None\n"
        "from experiments.uncertainty_sources import main; sys.exit(main(sys.argv[1:]))"
    )
    options = ["--solution", str(tmp_path), "--out", str(tmp_path), "--workers", workers]
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


# --- statistics -----------------------------------------------------------------------------------


@pytest.mark.parametrize("flights", [3, 8])
@pytest.mark.parametrize("sigmas", [(1.0, 1.0, 1.0), (5.0, 1.0, 0.2)])
def test_intervals_of_the_dispersion_cover_as_often_as_they_say(
    sigmas: tuple[float, float, float], flights: int
) -> None:
    rng = np.random.default_rng(5)
    covariance = np.diag(np.square(sigmas))
    true = np.sqrt(np.trace(covariance))
    draws = multivariate_normal(cov=covariance).rvs((600, flights), random_state=rng)
    found = [dispersion(sample) for sample in draws]
    covered = np.mean([e.low <= true <= e.high for e in found])
    # Never too narrow, and somewhat too wide in three axes.
    assert 0.92 < covered < 0.999
    assert np.mean([e.value**2 for e in found]) == pytest.approx(true**2, rel=0.1)


def test_the_dispersion_of_one_axis_has_the_textbook_interval() -> None:
    sample = np.random.default_rng(0).standard_normal((20, 3)) * [1.0, 0.0, 0.0]
    e = dispersion(sample)
    s = np.sqrt(np.mean(sample[:, 0] ** 2))
    # Quantiles of chi-squared with 20 degrees of freedom: 9.591 and 34.170.
    expected = (s, s * np.sqrt(20 / 34.170), s * np.sqrt(20 / 9.591))
    assert e == pytest.approx(expected, rel=1e-4)


def test_normality_knows_a_normal_sample_from_another() -> None:
    rng = np.random.default_rng(1)
    normal, skew = normality(rng.standard_normal(3000)), normality(rng.exponential(size=3000))
    assert normal.p_value > 0.01
    assert skew.p_value < 1e-20
    assert normal.correlation > 0.999 > skew.correlation
    assert len(normal.expected) == len(normal.observed) <= 199
    assert np.all(np.diff(normal.expected) > 0.0)
    assert normal.observed[0] < -2.5
    assert normal.observed[-1] > 2.5


# --- going on where it stopped --------------------------------------------------------------------


def test_flights_in_the_logbook_are_not_flown_again(
    solution: Solution, vehicle: Vehicle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown: list[tuple[str, int]] = []

    def spy(solution: Solution, vehicle: Vehicle, job: tuple[str, int]) -> Flown:
        if job == ("imu", 1) and not flown.count(("all", 0)):
            raise KeyboardInterrupt
        flown.append(job)
        return simulated(solution, vehicle, job)

    monkeypatch.setattr(uncertainty_flights, "fly_spacecraft", spy)
    jobs = [("none", 0), ("imu", 0), ("imu", 1), ("all", 0)]
    with pytest.raises(KeyboardInterrupt):
        fly_all(Logbook(tmp_path, solution, vehicle), solution, vehicle, jobs)
    assert flown == jobs[:2]
    flown.append(("all", 0))  # from now on nothing stops it
    told: list[None] = []
    again = fly_all(
        Logbook(tmp_path, solution, vehicle),
        solution,
        vehicle,
        jobs,
        tell=lambda: told.append(None),
    )
    assert flown == [*jobs[:2], ("all", 0), *jobs[2:]]
    assert again == [simulated(solution, vehicle, job) for job in jobs]
    assert len(told) == len(jobs)
    # Another vehicle's flights are none of this one's.
    errors = vehicle.errors.model_copy(update={"imu_rad_s": 1e-3})
    other = vehicle.model_copy(update={"errors": errors})
    assert not Logbook(tmp_path, solution, other).flown
    begun = Logbook(tmp_path, solution, other)
    begun.add(simulated(solution, other, ("imu", 9)))
    assert set(Logbook(tmp_path, solution, other).flown) == {("imu", 9)}


def test_two_processes_fly_what_one_does(
    solution: Solution, vehicle: Vehicle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("Basilisk")
    monkeypatch.setattr(uncertainty_flights, "fly_spacecraft", simulated)
    jobs = [("imu", seed) for seed in range(5)]
    logbook = Logbook(tmp_path, solution, vehicle)
    found = fly_all(logbook, solution, vehicle, jobs, workers=2)
    assert found == [simulated(solution, vehicle, job) for job in jobs]
    assert set(Logbook(tmp_path, solution, vehicle).flown) == set(jobs)


def stopped(_: Solution, __: Vehicle, job: tuple[str, int]) -> Flown:
    """A first flight that is stopped, while all others last a minute."""
    if job[1] == 0:
        raise KeyboardInterrupt
    time.sleep(60.0)
    raise AssertionError


def test_a_stop_waits_for_no_flight(
    solution: Solution, vehicle: Vehicle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("Basilisk")
    monkeypatch.setattr(uncertainty_flights, "fly_spacecraft", stopped)
    jobs, start = [("imu", seed) for seed in range(4)], time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        fly_all(Logbook(tmp_path, solution, vehicle), solution, vehicle, jobs, workers=2)
    assert time.monotonic() - start < 30.0


def test_a_damaged_logbook_is_begun_anew(
    solution: Solution, vehicle: Vehicle, tmp_path: Path
) -> None:
    job = ("imu", 4)
    Logbook(tmp_path, solution, vehicle).add(simulated(solution, vehicle, job))
    assert set(Logbook(tmp_path, solution, vehicle).flown) == {job}
    (tmp_path / "uncertainty_flights.csv").write_text("errs,seed\nimu,x\n", encoding="utf-8")
    assert not Logbook(tmp_path, solution, vehicle).flown


# --- verdicts -------------------------------------------------------------------------------------


def entries(solution: Solution, vehicle: Vehicle, attitude_m: float) -> list[Measured]:
    found = measure_paths(solution, vehicle, 300, 0)
    flights = [Flown(NO_ERRORS, 0, (0.0,) * 6, 0.0)]
    flights += [
        Flown("attitude", seed, tuple(attitude_m * np.random.default_rng(seed).normal(size=6)), 0.0)
        for seed in range(20)
    ]
    return [*found.values(), *measure_flights(flights, solution).values()]


@pytest.mark.parametrize(("attitude_m", "words"), [(0.5, "the path may be"), (100.0, "may NOT be")])
def test_the_attitude_may_be_left_out_only_while_it_is_small(
    solution: Solution, vehicle: Vehicle, attitude_m: float, words: str
) -> None:
    said = verdicts(entries(solution, vehicle, attitude_m), solution)
    assert sum(words in line for line in said) == 1


def test_the_flight_without_errors_has_no_dispersion(solution: Solution) -> None:
    one = measure_flights([Flown("none", 0, tuple(solution.nodes.state[-1]), 0.0)], solution)
    entry = one["none"]
    assert entry.flown_by == SPACECRAFT
    assert entry.rms.value == 0.0
    assert entry.rms.high == 0.0
    assert entry.offset_m == 0.0
    assert entry.normality == {}


# --- the command ----------------------------------------------------------------------------------


def test_the_command_measures_every_set(
    solution: Solution,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(uncertainty_flights, "fly_spacecraft", simulated)
    solution.write(tmp_path)
    out = tmp_path / "out"
    arguments = ["--solution", str(tmp_path), "--out", str(out), "--paths", "500"]
    assert main([*arguments, "--flights", "10"]) == 0
    said = capsys.readouterr().out
    assert "Alone, from the largest:" in said
    assert "the path may be planned without the attitude" in said
    with (out / "uncertainty_sources.csv").open(encoding="utf-8") as file:
        table = {row["source"]: row for row in csv.DictReader(file)}
    assert set(table) == {"none", *ATTITUDE, "attitude", *TRANSLATION, BOTH, "all"}
    for errs, row in table.items():
        assert float(row["rms_m_low"]) <= float(row["rms_m"])
        assert int(row["flights"]) == (
            1 if errs == "none" else 500 if errs in (*TRANSLATION, BOTH) else 10
        )
    assert float(table["imu"]["attitude_error_deg"]) == pytest.approx(np.rad2deg(1e-4))
    with (out / "uncertainty_flights.csv").open(encoding="utf-8") as file:
        flights = list(csv.DictReader(file))
    assert len(flights) == 61
    assert set(STATE) <= set(flights[0])
    text = (out / "uncertainty_sources.md").read_text("utf-8")
    assert "| star tracker | 15 arcsec | whole spacecraft | 10 |" in text
    assert "| chemical thruster | 10 % of the thrust | planner's dynamics | 500 |" in text


def test_a_source_that_does_not_err_is_not_called_normal(
    solution: Solution, vehicle: Vehicle
) -> None:
    errors = vehicle.errors.model_copy(update={"chemical_thruster": 0.0})
    found = measure_paths(solution, vehicle.model_copy(update={"errors": errors}), 30, 0)
    assert found[CHEMICAL].normality == {}
    said = verdicts(list(found.values()), solution)
    assert not any("chemical thruster: quantiles" in line for line in said)


def test_an_output_below_a_file_is_named(
    solution: Solution, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    solution.write(tmp_path)
    out = tmp_path / "solution.json" / "x"
    arguments = ["--solution", str(tmp_path), "--out", str(out), "--flights", "0"]
    assert main(arguments) == 2
    assert "solution.json" in capsys.readouterr().err


def test_without_flights_the_path_is_measured_alone(solution: Solution, tmp_path: Path) -> None:
    solution.write(tmp_path)
    arguments = ["--solution", str(tmp_path), "--out", str(tmp_path), "--paths", "100"]
    assert main([*arguments, "--flights", "0"]) == 0
    with (tmp_path / "uncertainty_sources.csv").open(encoding="utf-8") as file:
        assert [row["source"] for row in csv.DictReader(file)] == [*TRANSLATION, BOTH]


def test_a_missing_plan_exits_with_two(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--solution", str(tmp_path / "none"), "--out", str(tmp_path)]) == 2
    assert "none" in capsys.readouterr().err
