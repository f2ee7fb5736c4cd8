"""The fidelity study: its flights against independent ones, its rule, and the command."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.__main__ import main
from experiments.model_fidelity import study as model_fidelity
from experiments.model_fidelity.models import (
    BURNS,
    GRAVITY,
    SRP,
    Choices,
    Firing,
    Flight,
    Model,
    Plates,
    fly,
    passing,
    relapses,
)
from experiments.model_fidelity.study import Compared, claims, compare
from scp_recon.mission.mission import Mission
from scp_recon.mission.schedule import Mode
from scp_recon.physics.flow import propagate
from scp_recon.physics.harmonics import HarmonicField
from scp_recon.results.solution import ballistic_arc
from scp_recon.scenario.load import load_scenario
from scp_recon.simulation.vehicle import load_vehicle

from .support import session_in

THRUST_M_S2 = 1.0 / 178.0


@pytest.fixture(scope="module")
def mission() -> Mission:
    return Mission.from_scenario(load_scenario())


@pytest.fixture(scope="module")
def flight(mission: Mission) -> Flight:
    return Flight.of("ballistic arc", ballistic_arc(mission), mission, load_vehicle())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fidelity")


def compared_in(folder: Path, flight: Flight) -> list[Compared]:
    with session_in(folder) as session:
        return compare(flight, session, session.store())


@pytest.fixture(scope="module")
def compared(flight: Flight, folder: Path) -> list[Compared]:
    return compared_in(folder, flight)


def no_light(_: float) -> np.ndarray:
    return np.zeros(3)


class Nothing:
    def acceleration(
        self, x: np.ndarray, y: np.ndarray, z: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return 0.0 * x, 0.0 * y, 0.0 * z


# --- the flights ----------------------------------------------------------------------------------


def test_the_planners_model_is_flown_to_a_millimetre(mission: Mission, flight: Flight) -> None:
    """Against the planner's own equations, integrated by Runge and Kutta in steps of 20 s."""
    choices = Choices.of(flight)
    model = choices.model({SRP: "cannonball", GRAVITY: "J2", BURNS: "impulsive"})
    end = mission.times_s[-1:]
    found = fly(
        mission, flight.burns_m_s, model, end, thrust_acceleration_m_s2=THRUST_M_S2
    )  # fmt: skip
    state = mission.initial_state + np.r_[np.zeros(3), flight.burns_m_s[0]]
    expected = propagate(state, float(end[0]), mission.forces, 1742)
    np.testing.assert_allclose(found[0, :3], expected[:3], atol=1e-3)
    np.testing.assert_allclose(found[0, 3:], expected[3:], atol=1e-7)


@pytest.mark.parametrize(
    ("firing", "lead_s"), [(Firing(False), 0.0), (Firing(False, 0.5), 0.5), (Firing(True), 0.5)]
)
def test_in_empty_space_a_burn_acts_from_its_middle(
    mission: Mission, firing: Firing, lead_s: float
) -> None:
    """An impulse at the start is ahead of a finite burn by half of its length times the velocity."""
    times = np.array([0.0, 3000.0, 20_000.0])
    burns = np.array([[0.1, 0.0, 0.0], [0.0, 0.05, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    found = fly(
        mission,
        burns,
        Model(Nothing(), no_light, firing),
        times,
        thrust_acceleration_m_s2=THRUST_M_S2,
    )
    lengths = np.array([0.1, 0.05]) / THRUST_M_S2
    start = mission.initial_state
    np.testing.assert_allclose(found[0], start)
    for state, time in zip(found[1:], times[1:], strict=True):
        acting = np.maximum(time - np.array([0.0, 8000.0]) - lead_s * lengths, 0.0)
        expected = start[:3] + time * start[3:] + np.r_[0.1 * acting[0], 0.05 * acting[1], 0.0]
        np.testing.assert_allclose(state[:3], expected, atol=1e-6)


def test_looks_do_not_change_the_flight(mission: Mission, flight: Flight) -> None:
    model = Choices.of(flight).model({SRP: "cannonball", GRAVITY: "degree 2", BURNS: "finite"})

    def end(times: np.ndarray) -> np.ndarray:
        found = fly(
            mission, flight.burns_m_s, model, times, thrust_acceleration_m_s2=THRUST_M_S2
        )  # fmt: skip
        assert len(found) == len(times)
        return found[-1]

    np.testing.assert_allclose(
        end(np.array([0.0, 5.0, 8000.0])), end(np.array([8000.0])), atol=1e-6
    )


def test_light_on_the_plates_follows_the_commanded_attitude(flight: Flight) -> None:
    """With the panels on the Sun it is along the Sun line but for the oblique light on two sides."""
    light = Choices.of(flight).srp["N-plate"]
    mission, vehicle = flight.plan.mission, flight.plan.vehicle
    assert {leg.mode for leg in flight.plan.legs} >= {Mode.SUN_POINTING, Mode.OBSERVATION}
    for time in (2000.0, 8000.0, 15_000.0, 30_000.0):
        attitude: Rotation = flight.plan.attitudes(np.array([time]))
        sun = mission.sun_direction(time)
        force = Plates.of(vehicle).force_per_pressure(attitude.inv().apply(sun)[0])
        expected = attitude.apply(force)[0]
        found = light(time)
        np.testing.assert_allclose(
            found / np.linalg.norm(found), expected / np.linalg.norm(expected), atol=1e-4
        )
        assert found @ sun < 0.0
    # 4.05e-6 N on the panels' normal, a per cent less at their best direction.
    assert np.linalg.norm(light(2000.0)) * vehicle.mass.mass_kg == pytest.approx(4.0e-6, rel=0.03)


def test_the_field_is_basilisks(mission: Mission) -> None:
    module = pytest.importorskip("Basilisk.simulation.sphericalHarmonicsGravityModel")
    field = HarmonicField.bennu(mission.scenario.body.gm_m3_s2, 8)
    c, s = field.normalised()
    model = module.SphericalHarmonicsGravityModel()
    model.radEquator, model.muBody, model.maxDeg = field.radius, field.gm, 8
    rows_of = [slice(0, n + 1) for n in range(9)]
    model.cBar = [c[n, row].tolist() for n, row in enumerate(rows_of)]
    model.sBar = [s[n, row].tolist() for n, row in enumerate(rows_of)]
    model.initializeParameters()
    for position in ([700.0, -300.0, 250.0], [-400.0, 500.0, -600.0], [10.0, 20.0, 900.0]):
        expected = np.ravel(model.computeField(position, 8, True))
        found = np.ravel(field.acceleration(*np.array(position)[:, None]))
        np.testing.assert_allclose(found, expected, rtol=1e-10)


# --- the rule -------------------------------------------------------------------------------------


def test_the_lowest_fidelity_within_the_limit_is_named() -> None:
    names = ["crude", "better", "good", "truth"]
    distance = {"crude": 30.0, "better": 9.9, "good": 12.0}
    assert passing(names, distance, 10.0) == "better"
    assert relapses(names, distance, 10.0) == ["good"]
    assert passing(names, dict.fromkeys(distance, 11.0), 10.0) == "truth"
    assert passing(names, dict.fromkeys(distance, 10.0), 10.0) == "truth"


def test_where_nothing_passes_the_truth_is_needed() -> None:
    far = np.array([0.0, 20.0])
    entries = [
        Compared("arc", "gravity", model, np.array([0.0, 1.0]), far, (0.0, 1.0))
        for model in ("degree 0", "J2")
    ]
    assert claims(entries) == [
        ("arc, gravity: lowest fidelity is the truth", "within 10 m", "no model", False)
    ]


def test_distances_on_the_arc(compared: list[Compared], flight: Flight) -> None:
    """Orders of magnitude that follow from the forces alone; no light pressure shifts by 10 m."""
    assert len(compared) == 2 + len(list(Choices.of(flight).single()))
    end = {entry.model: entry.terminal_m for entry in compared}
    assert end["none"] == pytest.approx(10.0, abs=1.0)
    assert end["cannonball"] < 0.2 * end["none"]
    # Half of the firing's length times the burn, 0.45 m, carried on.
    assert 0.3 < end["impulsive"] < 3.0
    assert end["impulsive, mid-firing"] < 1e-3
    degrees = [end[f"degree {n}"] for n in (0, 2, 3, 4, 6)]
    assert degrees == sorted(degrees, reverse=True)
    assert end["degree 0"] == end["degree 1"]
    # The planner's whole model is no further off than its parts together.
    planner = compared[-1]
    assert planner.model == "cannonball, J2, impulsive"
    assert planner.passes
    assert planner.terminal_m <= sum(end[m] for m in planner.model.split(", ")) + 0.1


def test_what_was_flown_is_kept(
    flight: Flight, folder: Path, compared: list[Compared], monkeypatch: pytest.MonkeyPatch
) -> None:
    flown = []

    def path(*_: object, **__: object) -> np.ndarray:
        flown.append(1)
        return np.zeros((len(flight.plan.mission.times_s), 6))

    monkeypatch.setattr(model_fidelity, "fly", path)
    again = compared_in(folder, flight)
    assert flown == [1]  # the truth
    assert all(
        np.array_equal(a.distance_m, b.distance_m) for a, b in zip(again, compared, strict=True)
    )


# --- the command ----------------------------------------------------------------------------------


def test_the_command_writes_tables_and_verdicts(
    tmp_path: Path,
    flight: Flight,
    compared: list[Compared],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(model_fidelity, "flights", lambda *_: [flight])
    monkeypatch.setattr(model_fidelity, "compare", lambda *_: compared)
    assert main(["model_fidelity", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "ballistic arc, solar radiation pressure: lowest fidelity is cannonball" in said
    with (tmp_path / "model_fidelity.csv").open(encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    named = [row for row in table if row["lowest_that_passes"] == "true"]
    assert len(named) == 3
    assert all(row["passes"] == "true" for row in named)
    with (tmp_path / "model_fidelity_history.csv").open(encoding="utf-8") as file:
        last = {row["model"]: float(row["distance_m"]) for row in csv.DictReader(file)}
    assert all(last[row["model"]] == float(row["terminal_m"]) for row in table)
    assert "## Claims" in (tmp_path / "model_fidelity.md").read_text("utf-8")
