"""Initial guesses, the first stage that each leads to, and several starts."""

import itertools
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import scp_recon as sr
from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from formulations.rows.uniform import DeterministicRows
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.planning.records import Optimum, Starts
from scp_recon.planning.solver import path_ignores_burns
from scp_recon.planning.starts import on_grid, plan_from_several, random_flight
from scp_recon.results.solution import make_solution
from scp_recon.scp.algorithms import ALGORITHMS
from scp_recon.scp.loop import Record
from scp_recon.scp.status import Status
from tests import reference, reliability
from tests.helpers import nightly, usually
from tests.scenarios import COARSE
from tests.scp_recon.support import burns_of, flight_beyond, fly, integrate, mission_of

SHORT = ("t", "x", "y", "z", "vx", "vy", "vz")
WITH_UNITS = ("t_s", "x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")


def states_of(mission: Mission, iterate: Iterate) -> Array:
    return iterate.mean * mission.units.state


def defects_of(mission: Mission, iterate: Iterate) -> Array:
    """SI."""
    return mission.dynamics.linearise(mission.problem, iterate).defects * mission.units.state


@pytest.fixture(scope="module")
def ballistic(mission) -> Iterate:
    return initial_guess.ballistic(mission)


def test_the_cold_start_is_a_straight_line(mission):
    cold = initial_guess.cold(mission)
    states, fraction = states_of(mission, cold), mission.times_s / mission.times_s[-1]
    expected = np.outer(1.0 - fraction, mission.initial_state)
    expected += np.outer(fraction, mission.final_state)
    np.testing.assert_allclose(states, expected, rtol=1e-12, atol=1e-12)
    # Echigo et al., section VI.
    np.testing.assert_allclose(burns_of(mission, cold.burns), np.full((4, 3), 1e-10), rtol=1e-12)


def test_the_ballistic_arc_connects_the_boundary_states(mission, ballistic):
    states, burns = states_of(mission, ballistic), burns_of(mission, ballistic.burns)
    defects = np.abs(defects_of(mission, ballistic))
    assert defects[:, :3].max() < 1e-3
    assert defects[:, 3:].max() < 1e-6
    np.testing.assert_allclose(states[0, :3], mission.initial_state[:3], atol=1e-3)
    np.testing.assert_allclose(states[0, 3:] - burns[0], mission.initial_state[3:], atol=1e-12)
    np.testing.assert_allclose(states[-1], mission.final_state, atol=1e-3)
    flown = integrate(mission.forces, states[0], mission.times_s)
    assert np.linalg.norm(flown[:, :3] - states[:, :3], axis=1).max() < 0.1
    sizes = np.linalg.norm(burns, axis=1)
    assert np.all(sizes[1:-1] < 1e-9)
    # An independent prototype's, with a gravity field of degree 10.
    assert sizes[0] == pytest.approx(reference.DEPARTURE_M_S, rel=0.02)
    assert 0.10 < sizes.sum() < 0.30
    ways = [initial_guess._two_impulses(mission, way) for way in (1.0, -1.0)]
    near, far = sorted(way.total_dv for way in ways if way is not None)
    assert ballistic.total_dv == pytest.approx(near)  # the cheaper way round
    assert far > 1.1 * near


@pytest.mark.parametrize(
    "final", ["[-70.2, 1096.3, -406.4]", "[70.2, -1096.3, 406.4]"], ids=["opposite", "the same"]
)
def test_a_ballistic_arc_exists_without_a_plane(final):
    mission = mission_of(f"boundary.final_position_m={final}")
    iterate = initial_guess.ballistic(mission)
    assert np.abs(defects_of(mission, iterate)[:, :3]).max() < 1e-2


def test_given_burns_are_rolled_out(mission, default_plan):
    planned = default_plan.final.result.lin.iterate
    burns = 1.1 * burns_of(mission, planned.burns)
    iterate = initial_guess.from_burns(mission, burns)
    np.testing.assert_allclose(burns_of(mission, iterate.burns), burns, rtol=1e-14)
    flown = fly(mission, burns, mission.times_s)
    error = states_of(mission, iterate) - flown
    assert np.linalg.norm(error[:, :3], axis=1).max() < 5e-3
    assert np.abs(defects_of(mission, iterate)[:-1]).max() < 1e-9


def write(path: Path, times: Array, states: Array, header: tuple[str, ...] = WITH_UNITS) -> Path:
    rows = [",".join(repr(float(x)) for x in (t, *s)) for t, s in zip(times, states, strict=True)]
    path.write_text("\n".join(["# a comment", ",".join(header), *rows]) + "\n", "utf-8")
    return path


@pytest.mark.parametrize(
    ("rows", "header"), [(None, SHORT), (None, WITH_UNITS), (2, SHORT), (3, SHORT), (300, SHORT)]
)
def test_a_table_gives_the_trajectory_back(tmp_path, mission, ballistic, rows, header):
    """At the nodes exactly, at other times interpolated; a sparse one is read."""
    times, states = mission.times_s, states_of(mission, ballistic)
    if rows is not None:
        times = np.linspace(0.0, times[-1] + 60.0, rows)
        states = integrate(mission.forces, states[0], times)
    read = initial_guess.from_table(mission, write(tmp_path / "t.csv", times, states, header))
    assert read.mean.shape == ballistic.mean.shape
    if rows is None or rows > 100:
        position_m, burn_m_s = (1e-6, 1e-6) if rows is None else (0.1, 1e-4)
        off = (read.mean - ballistic.mean)[:, :3] * mission.units.length_m
        assert np.abs(off).max() < position_m
        apart = burns_of(mission, read.burns) - burns_of(mission, ballistic.burns)
        assert np.abs(apart[[0, -1]]).max() < burn_m_s


def test_burns_of_a_table_close_its_arcs(tmp_path, mission, default_plan):
    # Between two rows on either side of a burn the table's velocity turns within a second.
    planned = default_plan.final.result.lin.iterate
    states, burns = states_of(mission, planned), burns_of(mission, planned.burns)
    times = mission.times_s.copy()
    before = states[mission.burn_nodes[1:]].copy()
    before[:, 3:] -= burns[1:]
    before[:, :3] -= 1e-3 * before[:, 3:]
    at = mission.burn_nodes[1:]
    file = write(
        tmp_path / "t.csv",
        np.insert(times, at, times[at] - 1e-3),
        np.insert(states, at, before, axis=0),
    )
    read = initial_guess.from_table(mission, file)
    np.testing.assert_allclose(burns_of(mission, read.burns), burns, rtol=0.0, atol=1e-6)


def refused(mission: Mission, path: Path) -> InputError:
    with pytest.raises(InputError) as caught:
        initial_guess.from_table(mission, path)
    assert str(path) in caught.value.entry
    reliability.count(reliability.BAD_INPUTS)
    return caught.value


HEADER = ",".join(WITH_UNITS)
ROWS = ["0,1,2,3,4,5,6", "40000,1,2,3,4,5,6"]


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (None, "no such file"),
        ("\x89PNG\r\n\x1a\n\x00\xff", "must be"),
        ("", "no known columns"),
        (HEADER, "columns"),
        ("\n".join(["a,b,c", "1,2,3"]), "no known columns"),
        ("\n".join([HEADER.replace("vz_m_s", "w"), *ROWS]), "vz_m_s"),
        ("\n".join([HEADER, "0,1,2,3,4,5,six", ROWS[1]]), "six"),
        ("\n".join([HEADER, "0,1,2,3,4,5", ROWS[1]]), "number"),
        ("\n".join([HEADER, "0,1,2,3,4,5,nan", ROWS[1]]), "finite"),
        ("\n".join([HEADER, "0,1,2,3,4,5,inf", ROWS[1]]), "finite"),
        ("\n".join([HEADER, ROWS[0]]), "1 rows"),
        ("\n".join([HEADER, ROWS[1], ROWS[0]]), "ascending"),
        ("\n".join([HEADER, ROWS[0], ROWS[0], ROWS[1]]), "ascending"),
        ("\n".join([HEADER, ROWS[0], "20000,1,2,3,4,5,6"]), "20000"),
        ("\n".join([HEADER, "10,1,2,3,4,5,6", ROWS[1]]), "cover the flight"),
        # Two columns for x and none for the time are seven, but not the seven.
        ("\n".join(["x,x_m,y,z,vx,vy,vz", *ROWS]), "t_s"),
        ("\n".join(["t,t_s,x,y,z,vx,vy", *ROWS]), "vz_m_s"),
    ],
)
def test_a_bad_table_is_refused(mission, tmp_path, content, named):
    file = tmp_path / "bad.csv"
    if content is not None:
        file.write_bytes(content.encode("latin-1"))
    assert named in str(refused(mission, file))


def test_tables_in_other_units_are_refused(mission, ballistic, tmp_path):
    states = states_of(mission, ballistic)
    turning = np.array([mission.rotation.body_to_j2000(t).T for t in mission.times_s])
    body_fixed = np.einsum("nij,nkj->nki", turning, states.reshape(-1, 2, 3)).reshape(-1, 6)
    velocity = "metres per second"
    for wrong, named in (
        (1e-3 * states, "in metres"),  # kilometres and kilometres a second
        (1e3 * states, "in metres"),
        (states * np.repeat([1.0, 1e-3], 3), velocity),
        (states * np.repeat([1.0, 1e3], 3), velocity),
        (states * np.repeat([1.0, 1.0 / 86_400.0], 3), velocity),  # metres a day
        (states * np.repeat([1.0, -1.0], 3), "how the positions move"),
        (body_fixed, "how the positions move"),
        (states[:, [0, 1, 2, 4, 5, 3]], "how the positions move"),
    ):
        error = refused(mission, write(tmp_path / "t.csv", mission.times_s, wrong))
        assert named in str(error)


LOST = (0, 8)
"""Random guesses from which P3 with all its rows ends at its second optimum."""


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_random_guesses_end_at_the_better_optimum(algorithm, mission):
    for seed in usually(LOST, 1):
        found = plan(mission, initial_guess.random(mission, seed), algorithm=algorithm)
        assert [stage.name for stage in found.stages] == ["P3.open", "P3", "P2"]
        assert found.status is Status.CONVERGED
        assert found.total_dv_m_s == pytest.approx(0.140135, rel=1e-4)


def test_only_random_guesses_ignore_their_burns(mission, default_plan):
    table = np.column_stack([default_plan.times_s, default_plan.states])
    coarse = np.vstack([table[::10], table[-1:]]) if (len(table) - 1) % 10 else table[::10]
    for guess in (
        initial_guess.cold(mission),
        initial_guess.ballistic(mission),
        initial_guess.circular(mission, -1.0),
        initial_guess.from_states(mission, coarse),
        flight_beyond(mission),
    ):
        assert not path_ignores_burns(mission.dynamics.linearise(mission.problem, guess))
    for seed in range(10):
        guess = initial_guess.random(mission, seed)
        assert path_ignores_burns(mission.dynamics.linearise(mission.problem, guess))


@pytest.mark.parametrize("off_m", [-1e-10, 0.0, 1e-10])
def test_turns_between_equal_directions_ignore_rounding(mission, off_m):
    first = np.r_[2400.0, 1600.0, 900.0, np.zeros(3)]
    alike = replace(mission, initial_state=first, final_state=first + off_m * np.eye(6)[1])
    stays, turns = (
        initial_guess.circular(alike, way).mean[:, :3] * mission.units.length_m
        for way in (1.0, -1.0)
    )
    np.testing.assert_allclose(stays, np.broadcast_to(first[:3], stays.shape), rtol=1e-9)
    distance = np.linalg.norm(turns, axis=1)
    np.testing.assert_allclose(distance, np.linalg.norm(first), rtol=1e-9)
    cosines = turns @ first[:3] / distance / np.linalg.norm(first)
    assert cosines.min() < -0.99 < 0.99 < cosines[-1]


def test_a_flight_stays_on_its_side(mission):
    """Whoever gives a flight beyond the cone means that side."""
    found = plan(mission, flight_beyond(mission), problem="P3")
    assert [stage.name for stage in found.stages] == ["P3", "P3.held"]  # without its third burn
    assert found.total_dv_m_s == pytest.approx(0.159273, rel=1e-4)


def test_an_interrupted_opening_is_judged_by_all_rows(mission):
    def stop(_: str, record: Record) -> None:
        if record.k == 2:
            raise KeyboardInterrupt

    found = plan(mission, initial_guess.random(mission, 0), observe=stop)
    assert found.status is Status.INTERRUPTED
    assert found.final.name == "P3.open"
    rows = found.final.merit.rows
    assert isinstance(rows, DeterministicRows)
    assert {"emission_min", "phase_min"} <= found.final.margins.keys()
    assert make_solution(found).problem == "P3"


P3 = partial(plan, problem="P3")


def three(mission: Mission, **how: Any) -> Plan:
    """Of three starts of P3; the third, by seed 0, flies beyond the cone of the least emission."""
    return plan_from_several(P3(mission, initial_guess.cold(mission)), P3, starts=3, **how)


@pytest.fixture(scope="module")
def found(mission) -> Plan:
    return three(mission)


@pytest.mark.slow
def test_several_starts_find_both_optima_of_p3(mission, found):
    assert "3 starts, 2 optima of P3" in str(found)
    listed = make_solution(found).starts
    assert (listed.number, listed.seed) == (3, 0)
    near, far = listed.optima
    assert near.total_dv_m_s == pytest.approx(0.107723, rel=1e-4)
    assert far.total_dv_m_s == pytest.approx(0.159273, rel=1e-4)
    assert (near.starts, far.starts) == ((0, 1), (2,))
    assert found.total_dv_m_s == min(near.total_dv_m_s, found.total_dv_m_s)
    sizes = np.linalg.norm(far.burns_m_s, axis=1)
    assert sizes.sum() == pytest.approx(far.total_dv_m_s)
    burns = np.array(far.burns_m_s)
    ends = initial_guess.from_burns(mission, burns).mean[-1]
    assert ends == pytest.approx(mission.problem.final_state, abs=1e-6)


@pytest.mark.slow
@nightly
def test_neither_plan_nor_optima_depend_on_the_processes(mission, found):
    split = three(mission, workers=2)
    assert split == found
    assert split.starts == found.starts


def test_random_flights_obey_dynamics_and_follow_their_seed(mission):
    places = ((3, 1), (3, 2), (3, 3), (4, 1))
    flights = [random_flight(mission, *place) for place in places]
    for place, flight in zip(places, flights, strict=True):
        lin = mission.dynamics.linearise(mission.problem, flight)
        assert lin.is_dynamically_feasible
        assert not path_ignores_burns(lin)
        flown = initial_guess.from_burns(mission, flight.burns * mission.units.speed_m_s)
        np.testing.assert_allclose(flown.mean, flight.mean, atol=1e-8)
        np.testing.assert_array_equal(random_flight(mission, *place).mean, flight.mean)
    for one, other in itertools.combinations(flights, 2):
        assert np.abs(one.mean - other.mean).max() > 0.01


@pytest.mark.slow
def test_p2_from_dearer_p3_is_left_out(default_plan):
    """Both optima of P3 are listed; P2 costs less than the dearer one, which bounds the P2 near it."""
    found = plan_from_several(default_plan, plan, starts=3)
    assert found.total_dv_m_s == pytest.approx(default_plan.total_dv_m_s, rel=1e-6)
    assert [(o.problem, o.status, o.starts) for o in found.starts.optima] == [
        ("P3", "converged", (0, 1)),
        ("P3", "converged", (2,)),
        ("P2", "converged", (0,)),
    ]
    assert found.without_uncertainty.optima == 2
    assert found.without_uncertainty.total_dv_m_s == pytest.approx(0.107723, rel=1e-4)


@pytest.mark.slow
def test_starts_end_by_the_rule():
    """One optimum takes seven starts, and two take twelve: w (w + 1) / (n (n - 1)) < 5 %."""

    def listed(*starts: int) -> Starts:
        first, optima = 0, []
        for number in starts:
            numbers = tuple(range(first, first + number))
            optima.append(Optimum("P3", "converged", 1.0, ((1.0, 0.0, 0.0),), numbers))
            first += number
        return Starts(sum(starts), 0, tuple(optima))

    assert listed(6).chance > 0.05 > listed(7).chance
    assert listed(5, 6).chance > 0.05 > listed(6, 6).chance
    assert listed(6, 6).chance == pytest.approx(6 / 132)
    least = Optimum("P3", "infeasible", 1.0, ((1.0, 0.0, 0.0),), tuple(range(15)))
    without = Starts(15, 0, (least,))
    assert (
        without.chance
        < 0.01
        < replace(without, optima=(replace(least, starts=(*range(14),)),)).chance
    )
    assert "0 optima of P3, 1 minimum" in str(without)
    made = sr.plan(problem="P3", starts="auto", overrides=[COARSE])
    assert made.starts.number == 12
    assert made.starts.chance < 0.05


@pytest.mark.slow
def test_an_interrupt_keeps_the_best_start_so_far(mission):
    def stop(stage: str, _: Record) -> None:
        if stage.startswith("1 "):
            raise KeyboardInterrupt

    found = three(mission, observe=stop)
    assert found.status is Status.INTERRUPTED
    assert found.total_dv_m_s == pytest.approx(0.107723, rel=1e-4)
    assert [o.starts for o in found.starts.optima] == [(0, 1)]


def test_optima_on_finer_grids_start_on_the_missions(mission):
    """A close random flight may want shorter steps than the plan beside it."""
    finer = mission.changed({"grid.step_max_s": 100.0})
    found = on_grid(mission, random_flight(finer, 0, 1))
    lin = mission.dynamics.linearise(mission.problem, found)
    assert np.abs(lin.defects[:-1]).max() < 1e-9
    assert found.burns == pytest.approx(random_flight(finer, 0, 1).burns)
    same = random_flight(mission, 0, 1)
    assert on_grid(mission, same) is same
