"""The paper's table: rows, statements, variants, the flight's kernel, and what is taken up again."""

import csv
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
import spiceypy

from experiments.__main__ import main
from experiments.harness import Record
from experiments.observation_table import study as observation_table
from experiments.observation_table.rows import Row, as_flown_burns, read_states, rows, variants
from experiments.observation_table.runs import middle_beyond_facet_m, run_row, still_sun_window_s
from experiments.observation_table.statements import standing_for, statements
from experiments.observation_table.study import measure, report
from formulations.arrays import Array
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.physics import geometry
from scp_recon.physics.flow import propagate
from scp_recon.planning import initial_guess
from scp_recon.results.read import read_solution
from scp_recon.results.solution import Solution
from scp_recon.scenario.schema import Epoch

from .support import QUICK, SAMPLES, table_of, write_kernel


def study(*words: str) -> int:
    return main(["observation_table", *words])


PROJECT = Path(__file__).parents[2]
KEYS = ("ballistic", "p3", "scp_warm", "scp_cold")
"""Of the rows with figures."""


@pytest.fixture(scope="module")
def measured(mission, finished) -> list[Record]:
    return measure(mission, rows(ipopt=False), finished[0], samples=SAMPLES)


@pytest.fixture(scope="module")
def p3() -> Row:
    return next(row for row in rows(ipopt=False) if row.key == "p3")


def test_every_statement_has_its_outcome(measured, finished):
    """The plan's flights break distance more often, the surrogate's emission, as the paper says."""
    found = {each.parts[1]: each.same for each in statements(measured)}
    more = "emission is violated more often than distance"
    little = "a violation of emission seldom costs more than 1000 s"
    everything = "a violation of distance costs all of the observation"
    for whose, same in (
        ("the plan's flights", False),
        ("flights of the ballistic surrogate's burns", True),
    ):
        assert [found[f"{what}, in {whose}"] for what in (more, little, everything)] == [same] * 3
    assert found["the filter's prediction step carries the covariance to the end"] is False
    assert found["the direction to the Sun is one vector"] is False
    opposite = {words for words, same in found.items() if same is False}
    assert opposite > {
        "but for both dynamics and the burns' battery cones, P2 is convex",
        "the two burns between are there to keep the constraints under uncertainty",
        "the cold start ends better than the warm one, SCP",
    }
    assert found["the spacecraft fires mainly at the beginning and at the end"]
    assert found["mean of every planned row above every OSIRIS-REx row"]
    with (finished[0] / "statements.csv").open(encoding="utf-8", newline="") as file:
        written = list(csv.DictReader(file))
    assert [row["statement"] for row in written] == [*found]
    page = (PROJECT / "docs" / "validation" / "paper.md").read_text("utf-8")
    assert all(f"| {row['statement']} | {row['criterion']} | " in page for row in written)


def test_under_a_still_sun_the_site_is_lit_for_as_long_as_its_turning_says(mission):
    """The incidence's cosine then is a sinusoid of the body's turning alone."""
    pole, sun = mission.rotation.pole, mission.sun_direction(0.0)
    normal = geometry.track(mission.site, mission.rotation, np.zeros(1)).normal[0]
    along, off = (np.array([v @ pole, np.sqrt(1.0 - (v @ pole) ** 2)]) for v in (normal, sun))
    limit = np.cos(np.deg2rad(mission.scenario.observation.incidence_max_deg))
    turned = 2.0 * np.arccos((limit - along[0] * off[0]) / (along[1] * off[1]))
    rate = np.deg2rad(mission.scenario.body.prime_meridian_rate_deg_day) / 86_400.0
    assert still_sun_window_s(mission) == pytest.approx(turned / rate, abs=0.1)
    given = mission.scenario.replace({"observation.window_s": [13_300.0, 16_000.0]})
    assert still_sun_window_s(Mission.from_scenario(given)) == ""


def test_the_middle_of_two_points_of_a_facet_lies_beyond_it(finished):
    """By the difference of one over the root of two and a half, of the facet's spread."""
    plan = read_solution(finished[0] / "scp_cold")
    facets = plan.facets
    covariance = np.array(plan.nodes.covariance)[facets.node, :3, :3]
    normal = np.array(facets.normal)
    deviation = np.sqrt(np.einsum("mi,mij,mj->m", normal, covariance, normal))
    spreads = (np.sqrt(0.5) - 0.5) * np.array(facets.quantile) * deviation
    assert np.abs(spreads - middle_beyond_facet_m(plan)).min() < 1e-3
    assert middle_beyond_facet_m(plan) > 1.0
    assert middle_beyond_facet_m(read_solution(finished[0] / "p3")) == ""


def test_a_variant_is_planned_and_flown_in_its_own_mission(mission, tmp_path):
    """It stands in no table of the paper's rows."""
    row = next(row for row in variants(mission.scenario) if row.key == "p3_j2000")
    found, _ = run_row(row, mission, tmp_path, samples=100, check=False)
    assert read_solution(tmp_path).scenario.boundary.frame == "j2000"
    assert found["mean_s"] < 2000.0
    assert run_row(row, mission, tmp_path, samples=100, check=False) == (found, True)
    _, *tables = (part for part in report([found]) if not isinstance(part, str))
    assert [len(table.rows) for table in tables[-1:]] == [1]
    assert standing_for(row.printed, [found]) == []


def test_a_rerun_takes_up_what_is_complete(copy, capsys):
    before = {path: path.stat().st_mtime_ns for path in copy.glob("*/*.json")}
    table = (copy / "observation_table.csv").read_text("utf-8")
    assert study(*QUICK, "--out", str(copy)) == 0
    assert capsys.readouterr().out.count("taken up") == len(KEYS)
    assert {path: path.stat().st_mtime_ns for path in copy.glob("*/*.json")} == before
    assert (copy / "observation_table.csv").read_text("utf-8") == table


def failing(_: Mission) -> Solution:
    raise RuntimeError("the solver\nlost its way")


def test_a_failed_row_says_so_and_the_others_run(copy, monkeypatch, capsys):
    first, *others = rows(ipopt=False)
    broken = (replace(first, key="broken", design=failing), *others)
    monkeypatch.setattr(observation_table, "rows", lambda **_: broken)
    assert study(*QUICK, "--out", str(copy)) == 4
    assert "broken       failed: RuntimeError: the solver lost its way" in capsys.readouterr().out
    table = table_of(copy)
    assert table["broken"]["status"].startswith("failed")
    assert table["broken"]["mean_s"] == ""
    assert float(table["scp_cold"]["mean_s"]) > 0.0


@pytest.fixture(scope="module")
def flight(mission) -> Array:
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
def kernel(mission, flight, tmp_path_factory) -> Path:
    return write_kernel(tmp_path_factory.mktemp("kernel") / "flight.bsp", mission, flight)


def test_states_come_back_from_the_kernel(mission, kernel, flight):
    np.testing.assert_allclose(read_states(mission, kernel), flight, rtol=1e-12, atol=1e-9)
    assert spiceypy.ktotal("ALL") == 0  # and the kernel is put back


def test_fitted_impulses_follow_a_burn_that_was_fired_away_from_the_firing_times(
    mission, kernel, flight, tmp_path
):
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


def test_a_kernel_that_does_not_cover_the_flight_exits_with_two(mission, kernel, tmp_path, capsys):
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
