"""Figures of the studies: each drawn once, in silence, true to its tables; missing studies are run."""

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experiments.__main__ import main as experiments_main
from experiments.evidence import Evidence, path_of
from experiments.harness import records as as_table
from experiments.model_fidelity.study import TOGETHER, Compared, history
from experiments.model_fidelity.study import table as fidelity_table
from experiments.spacecraft.uncertainty_sources.flights import TRANSLATION
from experiments.spacecraft.uncertainty_sources.study import BOTH, SOURCES, Measured, quantiles
from experiments.spacecraft.uncertainty_sources.study import PATH as BY_PATH
from experiments.spacecraft.uncertainty_sources.study import SPACECRAFT as BY_SPACECRAFT
from experiments.spacecraft.uncertainty_sources.study import row as uncertainty_row
from paper_figs import __main__ as command_line
from paper_figs.__main__ import PICTURES, main, make_all
from paper_figs.inputs import PLAN, Row, Source, run_missing
from paper_figs.registry import EVERYTHING, STUDIES, Item
from paper_figs.studies import (
    accuracy,
    attitude_and_actuators,
    battery_cones,
    feedback,
    flight_record,
    flown_plan,
    frontier,
    map_sample,
    model_fidelity,
    policies,
    power_history,
    solver_comparison,
    timing_rules,
    uncertainty_sources,
)
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.results.solution import Solution, ballistic_arc
from scp_recon.scenario.load import load_scenario
from scp_recon.simulation.record import ADDED, Record, write_record
from scp_recon.simulation.vehicle import load_vehicle
from tests.scp_recon.simulation import made_up


def to_csv(rows: list[dict[str, Any]]) -> str:
    return as_table(rows).csv()


NO_PLAN = "1f" * 32
"""Hash of no plan."""
OF_FLIGHTS = ("attitude_and_actuators", "power_history", "flown_plan")


def compared(flight: str, effect: str, model: str, end_m: float) -> Compared:
    times = np.linspace(0.0, 34_842.0, 20)
    return Compared(flight, effect, model, times, end_m * times / times[-1], (13_140.0, 16_537.0))


def write_fidelity(folder: Path) -> None:
    """Made-up distances in the study's own form."""
    models = {
        "solar radiation pressure": {"none": 12.0, "cannonball": 1.0},
        "gravity": {"degree 0": 8.0, "J2": 0.9, "degree 7": 1e-3},
        "burns": {"impulsive": 0.7, "impulsive, mid-firing": 1e-4},
        TOGETHER: {"cannonball, degree 0, impulsive": 9.0},
    }
    entries = [
        compared(flight, effect, model, end)
        for flight in ("ballistic arc", "plan")
        for effect, ends in models.items()
        for model, end in ends.items()
    ]
    folder.mkdir()
    (folder / "model_fidelity.csv").write_text(to_csv(fidelity_table(entries)), encoding="utf-8")
    (folder / "model_fidelity_history.csv").write_text(to_csv(history(entries)), encoding="utf-8")


def write_uncertainty(folder: Path) -> None:
    """Made-up deviations in the study's own form: 200 m for each source of the path, else 1 m."""
    rng = np.random.default_rng(0)
    entries = []
    for error_sources in SOURCES:
        on_path = error_sources in (*TRANSLATION, BOTH)
        scale = 200.0 if on_path else {"none": 0.0, "all": 200.0}.get(error_sources, 1.0)
        deviation = scale * rng.standard_normal((500 if on_path else 8, 6)) / np.sqrt(3.0)
        by = BY_PATH if on_path else BY_SPACECRAFT
        entries.append(Measured(error_sources, by, deviation, 2.0, np.nan if on_path else 1e-3))
    errors = load_vehicle().errors
    table = to_csv([uncertainty_row(entry, errors) for entry in entries])
    folder.mkdir()
    (folder / "uncertainty_sources.csv").write_text(table, encoding="utf-8")
    points = to_csv(quantiles(entries))
    (folder / "uncertainty_quantiles.csv").write_text(points, encoding="utf-8")


def write_flight(folder: Path, seed: int = 4, plan_hash: str | None = NO_PLAN) -> None:
    """A made-up flight of two hours: a slew each half hour, a dump, a battery that runs low."""
    t = np.arange(0.0, 7200.0, 10.0)
    n, step = len(t), (t // 1800.0)
    angle = 1.5 * step
    zero = np.zeros(n)
    command = np.stack([np.cos(angle / 2), np.sin(angle / 2), zero, zero], axis=1)
    panel = np.array([11.4, 27.0, 27.0, 143.8, 143.8])
    arrays = made_up.arrays(samples=n, seconds=7200, nodes=50) | {
        "t_s": t,
        "attitude": -command,
        "command": command * np.sign(command[:, :1]),
        "mode": (step % 3).astype(np.int8),
        "actuators": (1 + step % 3).astype(np.int8),
        "panel_w": np.outer(0.5 + 0.5 * np.cos(t / 1000.0) ** 2, panel),
        "panel_peak_w": panel,
        "consumed_w": 46.0 + 20.0 * step,
        "state_of_charge": np.stack([1.0 - t / 9000.0, np.ones(n)], axis=1),
        "node_sigma_distance": np.linspace(0.0, seed, 50),
        "pointing_error_rad": np.exp(-np.arange(7200.0) % 1800.0 / 200.0) + 1e-3,
    }
    (burn,) = made_up.entries()["burns"]
    later = {"t_s": 3600.0, "pointing_deg": 0.5, "executed_pointing_deg": 0.6}
    summary = made_up.summary(
        seed=seed, plan_hash=plan_hash, burns=[burn, burn | later], least_charge=0.2
    )
    folder.mkdir()
    write_record(Record(arrays, summary), folder)


def write_flown(folder: Path) -> None:
    """Made-up flights that end one to four sigmas off, one of another plan among them."""
    folder.mkdir()
    seeds = range(1, 5)
    table = to_csv([{"seed": seed} for seed in seeds])
    (folder / "flown_plan.csv").write_text(table, encoding="utf-8")
    for seed in (*seeds, 30):
        write_flight(folder / f"seed_{seed}", seed)


def write_evidence(source: Source, folder: Path) -> None:
    """The study's tables as they were measured, some of them with rows without a plan."""
    folder.mkdir()
    tables = Evidence.read(path_of(source.folder)).tables
    for name in source.tables:
        rows = [
            {key: "nan" if value is None else value for key, value in row.items()}
            for row in tables[Path(name).stem]
        ]
        (folder / name).write_text(to_csv(rows), encoding="utf-8")


@pytest.fixture(scope="module")
def studies(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("studies")
    experiments_main(
        ["battery_cones", "--samples", "2000", "--out", str(out / battery_cones.SOURCE.folder)]
    )
    write_fidelity(out / model_fidelity.SOURCE.folder)
    write_uncertainty(out / uncertainty_sources.SOURCE.folder)
    write_flight(out / flight_record.SOURCE.folder)
    write_flown(out / flown_plan.SOURCE.folder)
    for study in (frontier, timing_rules, feedback, policies, map_sample, accuracy):
        write_evidence(study.SOURCE, out / study.SOURCE.folder)
    return out


def test_studies_are_drawn_where_they_are_found(studies, tmp_path, monkeypatch):
    monkeypatch.setattr(command_line, "FIGURES", {})
    monkeypatch.setitem(command_line.TABLES, "parameters", Item(lambda _: ""))
    study = replace(STUDIES["frontier"], dpi=40.0)
    monkeypatch.setattr(command_line, "STUDIES", STUDIES | {"frontier": study})
    runs: Any = SimpleNamespace(table=[])  # nothing else of them is asked for
    shutil.copytree(studies / study.source.folder, tmp_path / study.source.folder)
    names = {path.name for path in make_all(runs, tmp_path, tmp_path / "out", tmp_path)}
    expected = {f"frontier{ending}" for ending in PICTURES}
    assert names == expected | {"parameters.md", "captions.md"}
    assert "## frontier" in (tmp_path / "out" / "captions.md").read_text("utf-8")


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_alone_is_drawn_or_says_what_is_missing(
    studies, tmp_path, name, capsys, monkeypatch
):
    """With the flights' plan in its metadata."""
    study, file = STUDIES[name], tmp_path / "figure.png"
    monkeypatch.setitem(EVERYTHING, name, replace(study, dpi=40.0))
    assert main([name, "--studies", str(studies), "--out", str(file)]) == 0
    assert (NO_PLAN.encode() in file.read_bytes()) == (name in OF_FLIGHTS)
    assert main([name, "--runs", str(tmp_path), "--out", str(file)]) == 2
    assert f"{study.source.command} --out {tmp_path}" in capsys.readouterr().err
    damaged = Path(shutil.copytree(studies / study.source.folder, tmp_path / "copy"))
    for path in filter(Path.is_file, damaged.rglob("*")):
        path.write_text("x\n1\n", encoding="utf-8")
    with pytest.raises(InputError, match="unusable"):
        study.read(damaged)


@pytest.fixture(scope="module")
def solution() -> Solution:
    """Burns that are given, not planned."""
    return ballistic_arc(Mission.from_scenario(load_scenario()))


@pytest.mark.parametrize("plan_hash", [NO_PLAN, None])
def test_a_flight_of_another_plan_than_the_one_beside_it_is_refused(solution, tmp_path, plan_hash):
    single, many = tmp_path / "single", tmp_path / "many"
    write_flight(single, 4, plan_hash)
    many.mkdir()
    (many / "flown_plan.csv").write_text("seed\n4\n", encoding="utf-8")
    write_flight(many / "seed_4", 4, plan_hash)
    for study, folder in ((power_history, single), (flown_plan, many)):
        study.read(folder)  # by itself
        plan_file = solution.write(folder)
        with pytest.raises(InputError) as caught:
            study.read(folder)
        for words in ("simulation.npz", str(plan_file), f"{study.SOURCE.command} --out {folder}"):
            assert words in str(caught.value)
    same = tmp_path / "same"
    write_flight(same, 4, solution.plan_hash)
    solution.write(same)
    assert power_history.read(same).plan_hash == solution.plan_hash


def test_a_flight_of_before_torques_is_to_be_flown_again(tmp_path):
    write_flight(tmp_path / "flight")
    record = power_history.read(tmp_path / "flight")
    kept = {name: a for name, a in record.arrays.items() if name not in ADDED}
    write_record(Record(kept, record.summary), tmp_path / "flight")
    assert power_history.read(tmp_path / "flight").plan_hash == NO_PLAN
    with pytest.raises(InputError, match="python -m scp_recon simulate"):
        attitude_and_actuators.read(tmp_path / "flight")


def test_flights_of_different_plans_make_no_figure(tmp_path):
    (tmp_path / "flown_plan.csv").write_text("seed\n1\n2\n", encoding="utf-8")
    write_flight(tmp_path / "seed_1", 1)
    write_flight(tmp_path / "seed_2", 2, "2e" * 32)
    with pytest.raises(InputError, match="flights of different plans"):
        flown_plan.read(tmp_path)


WANTED = [item.source for item in STUDIES.values()]


def test_what_is_missing_is_run_once_and_what_is_there_is_left_alone(tmp_path):
    there = STUDIES["frontier"].source.folder
    (tmp_path / there).mkdir()
    ran: list[list[str]] = []
    said: list[str] = []

    def run(words: list[str]) -> int:
        ran.append(words)
        return 2 if "simulate" in words else 0

    runs = tmp_path / "paper"
    run_missing(runs, tmp_path, WANTED, said.append, run)
    assert ran[0] == [sys.executable, "-m", "experiments", "observation_table", "--out", str(runs)]
    places = [words[-1] for words in ran[1:]]
    folders = {source.folder for source in WANTED} - {there}
    assert sorted(places) == sorted(str(tmp_path / folder) for folder in folders)
    assert all("SOLUTION" not in words for words in ran)
    simulated = next(words for words in ran if "simulate" in words)
    assert simulated[4] == str(runs / PLAN)
    assert said.count("exit status 2: left out") == 1


def row(group: str, method: str, dv: float, status: str = "converged", **other: str) -> Row:
    parts = dict(zip(("formulation", "algorithm", "solver"), method.split("/"), strict=True))
    about = {"group": group, "scenario": "recon_b", "start": "cold", "problem": "P2"}
    found = {"status": status, "total_dv_m_s": str(dv), "cpu_s": "0.5", "first_status": ""}
    return {**about, "method": method, **parts, **found, **other}


OURS, THEIRS = "condensed/scvx/CLARABEL", "tuned/hard/IPOPT"
GUESSES = [
    *(row("guesses", OURS, 0.14) for _ in range(2)),
    row("guesses", OURS, 0.14, first_status="infeasible"),
    row("guesses", OURS, 0.26, "infeasible"),
    row("guesses", THEIRS, 0.15),
    row("guesses", THEIRS, float("nan"), "failed"),
]


def test_shares_of_solved_guesses_and_of_those_at_the_best():
    left, right = solver_comparison.draw_guesses(GUESSES).axes
    assert [label.get_text() for label in left.get_yticklabels()] == [THEIRS, OURS]
    shares = [line.get_xdata()[0] for line in left.lines if line.get_marker() == "o"]
    assert shares == pytest.approx([0.5, 0.5, 0.75, 0.5])  # each time over at the first try
    assert [text.get_text() for text in right.texts] == ["0 of 2 at the best", "3 of 4 at the best"]


def test_profiles_rise_to_the_share_that_is_solved():
    rows = [
        row("scenarios", OURS, 0.14, cpu_s="0.1"),
        row("scenarios", THEIRS, 0.14, cpu_s="1.0"),
        row("scenarios", OURS, 0.2, scenario="bold"),
        row("scenarios", THEIRS, 0.3, scenario="bold"),
    ]
    ours, theirs = solver_comparison.draw_profiles(rows).axes[0].lines
    assert list(ours.get_xdata()) == [1.0, 1.0]
    assert list(ours.get_ydata()) == [0.5, 1.0]
    assert list(theirs.get_xdata()) == pytest.approx([10.0])
    assert list(theirs.get_ydata()) == [0.5]
