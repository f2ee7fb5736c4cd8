"""Initial guesses: straight line, ballistic arc, burns, and tables of states."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Plan
from tests import reference, reliability
from tests.scp_recon.support import burns_of, fly, integrate, mission_of

SHORT = ("t", "x", "y", "z", "vx", "vy", "vz")
WITH_UNITS = ("t_s", "x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")


def states_of(mission: Mission, iterate: Iterate) -> Array:
    return iterate.mean * mission.units.state


def defects_of(mission: Mission, iterate: Iterate) -> Array:
    """SI."""
    return mission.dynamics.linearise(mission.problem, iterate).defects * mission.units.state


@pytest.fixture(scope="module")
def ballistic(mission: Mission) -> Iterate:
    return initial_guess.ballistic(mission)


def test_cold_is_the_straight_line_with_next_to_no_burns(mission: Mission) -> None:
    cold = initial_guess.cold(mission)
    states, fraction = states_of(mission, cold), mission.times_s / mission.times_s[-1]
    expected = np.outer(1.0 - fraction, mission.initial_state)
    expected += np.outer(fraction, mission.final_state)
    np.testing.assert_allclose(states, expected, rtol=1e-12, atol=1e-12)
    # Echigo et al., section VI.
    np.testing.assert_allclose(burns_of(mission, cold.burns), np.full((4, 3), 1e-10), rtol=1e-12)


def test_ballistic_arc_flies_between_the_boundary_states_with_two_impulses(
    mission: Mission, ballistic: Iterate
) -> None:
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


def test_ballistic_arc_is_the_cheaper_way_round(mission: Mission, ballistic: Iterate) -> None:
    ways = [initial_guess._two_impulses(mission, way) for way in (1.0, -1.0)]
    found = [way.total_dv for way in ways if way is not None]
    assert len(found) == 2
    assert ballistic.total_dv == pytest.approx(min(found))
    assert max(found) > 1.1 * min(found)


@pytest.mark.parametrize(
    "final", ["[-70.2, 1096.3, -406.4]", "[70.2, -1096.3, 406.4]"], ids=["opposite", "the same"]
)
def test_ballistic_arc_exists_where_the_plane_is_not_given(final: str) -> None:
    mission = mission_of(f"boundary.final_position_m={final}")
    iterate = initial_guess.ballistic(mission)
    assert np.abs(defects_of(mission, iterate)[:, :3]).max() < 1e-2


def test_given_burns_are_rolled_out(mission: Mission, default_plan: Plan) -> None:
    planned = default_plan.final.result.lin.iterate
    burns = 1.1 * burns_of(mission, planned.burns)
    iterate = initial_guess.from_burns(mission, burns)
    np.testing.assert_allclose(burns_of(mission, iterate.burns), burns, rtol=1e-14)
    flown = fly(mission, burns, mission.times_s)
    error = states_of(mission, iterate) - flown
    assert np.linalg.norm(error[:, :3], axis=1).max() < 5e-3
    assert np.abs(defects_of(mission, iterate)[:-1]).max() < 1e-9


@pytest.mark.parametrize("shape", [(3, 3), (5, 3), (0, 3), (4, 2)])
def test_other_numbers_of_burns_are_refused(mission: Mission, shape: tuple[int, int]) -> None:
    with pytest.raises(InputError) as caught:
        initial_guess.from_burns(mission, np.zeros(shape))
    assert caught.value.entry == "init"
    assert "4" in caught.value.allowed


def write(path: Path, times: Array, states: Array, header: tuple[str, ...] = WITH_UNITS) -> Path:
    rows = [",".join(repr(float(x)) for x in (t, *s)) for t, s in zip(times, states, strict=True)]
    path.write_text("\n".join(["# a comment", ",".join(header), *rows]) + "\n", "utf-8")
    return path


@pytest.mark.parametrize(
    ("rows", "header"), [(None, SHORT), (None, WITH_UNITS), (2, SHORT), (3, SHORT), (300, SHORT)]
)
def test_a_table_gives_the_trajectory_back(
    tmp_path: Path, mission: Mission, ballistic: Iterate, rows: int | None, header: tuple[str, ...]
) -> None:
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


def test_burns_of_a_table_are_what_the_arcs_miss(
    tmp_path: Path, mission: Mission, default_plan: Plan
) -> None:
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


def test_the_reconstructed_arc_is_read(mission: Mission, tmp_path: Path) -> None:
    """From every other row; the rows between lie on it too."""
    file = reference.write_arc(tmp_path / "arc.csv", reference.ARC[::2])
    read = initial_guess.from_table(mission, file)
    table = np.array(reference.ARC)[:, :7]
    states = states_of(mission, read)
    np.testing.assert_allclose(states[0], table[0, 1:], rtol=0.0, atol=1e-9)
    nearest = np.abs(mission.times_s[:, None] - table[:-1, 0]).argmin(axis=0)
    gap = (mission.times_s[nearest] - table[:-1, 0])[:, None]
    expected = table[:-1, 1:4] + gap * table[:-1, 4:7]
    error = np.linalg.norm(expected - states[nearest, :3], axis=1)
    # Gravity bends a straight line by half of 7e-6 m/s^2; a cubic over 6000 s is off by 0.3 m.
    assert np.all(error < 3.5e-6 * gap[:, 0] ** 2 + 0.5)
    assert np.all(np.linalg.norm(burns_of(mission, read.burns), axis=1) < 0.2)


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
def test_a_bad_table_is_refused(
    mission: Mission, tmp_path: Path, content: str | None, named: str
) -> None:
    file = tmp_path / "bad.csv"
    if content is not None:
        file.write_bytes(content.encode("latin-1"))
    assert named in str(refused(mission, file))


def test_a_table_in_other_units_or_axes_is_refused(
    mission: Mission, ballistic: Iterate, tmp_path: Path
) -> None:
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
