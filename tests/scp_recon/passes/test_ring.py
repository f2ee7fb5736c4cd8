"""A home orbit from a file that the test writes: a table, an OEM, a kernel, held against the circle."""

from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formulations.arrays import Array
from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.errors import InputError
from scp_recon.mission.firing import TURN
from scp_recon.mission.mission import Mission
from scp_recon.passes.space import Pass, settled, spaces_of
from scp_recon.scenario.load import load_scenario, scenario_text
from scp_recon.scenario.schema import Scenario
from tests.scp_recon.passes.support import home_scenario

pytestmark = pytest.mark.slow

CRAFT = -64


def revolution(turns: float = 1.3, begin: float = 1.0, count: int = 400) -> tuple[Array, Array]:
    """Times in s and states of the circle, from some phase on, left-handed."""
    scenario = home_scenario()
    space, *_ = spaces_of(scenario)
    period = TURN * np.sqrt(1e9 / scenario.body.gm_m3_s2)
    share = np.linspace(0.0, turns, count)
    return share * period, np.array([space.ring(begin - TURN * s) for s in share])


def write_csv(path: Path, times: Array, states: Array) -> Path:
    rows = [",".join(map(repr, row)) for row in np.column_stack([times, states]).tolist()]
    path.write_text("\n".join(["t_s,x_m,y_m,z_m,vx_m_s,vy_m_s,vz_m_s", *rows]) + "\n")
    return path


def write_oem(path: Path, times: Array, states: Array, center: str = "BENNU") -> Path:
    epoch = home_scenario().epoch.tdb
    whens = [(epoch + timedelta(seconds=round(t, 6))).isoformat() for t in times.tolist()]
    head = f"""CCSDS_OEM_VERS = 2.0
CREATION_DATE = {whens[0]}
ORIGINATOR = TEST
META_START
OBJECT_NAME = CRAFT
OBJECT_ID = 1
CENTER_NAME = {center}
REF_FRAME = EME2000
TIME_SYSTEM = TDB
START_TIME = {whens[0]}
STOP_TIME = {whens[-1]}
META_STOP"""
    rows = (
        " ".join([when, *map(repr, (1e-3 * state).tolist())])
        for when, state in zip(whens, states, strict=True)
    )
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def write_spk(path: Path, times: Array, states: Array) -> Path:
    spice = pytest.importorskip("spiceypy")
    scenario = home_scenario()
    et = (scenario.epoch.tdb - J2000_TDB).total_seconds() + times
    handle = spice.spkopn(str(path), "home orbit", 0)
    spice.spkw13(
        handle, CRAFT, scenario.body.naif_id, "J2000", et[0], et[-1], "HOME",
        3, len(et), np.ascontiguousarray(states / 1e3), et,
    )  # fmt: skip
    spice.spkcls(handle)
    return path


def from_file(path: Path, **home: Any) -> Scenario:
    return home_scenario(ephemeris_file=str(path), **home)


@pytest.mark.parametrize("kind", ["csv", "oem", "bsp"])
def test_ring_of_a_file_is_its_revolution(kind, tmp_path):
    times, states = revolution()
    path, more = tmp_path / f"home.{kind}", {}
    if kind == "csv":
        write_csv(path, times, states)
    elif kind == "oem":
        pytest.importorskip("oem")
        write_oem(path, times, states)
    else:
        write_spk(path, times, states)
        more = {"spacecraft_id": CRAFT}
    scenario = from_file(path, **more)
    space, *_ = spaces_of(scenario)
    circle, *_ = spaces_of(home_scenario())
    for phase in np.linspace(-3.0, 3.0, 25):
        apart = space.ring(phase) - circle.ring(phase)
        assert np.abs(apart[:3]).max() < 1e-3
        assert np.abs(apart[3:]).max() < 1e-6
    fixed = settled(scenario, space, Pass((2.5, -0.3), space.times_s))
    np.testing.assert_allclose(
        Mission.from_scenario(fixed).initial_state, space.ring(2.5), atol=1e-8
    )


def test_designs_alone_take_the_file_beside_their_scenario(tmp_path):
    write_csv(tmp_path / "home.csv", *revolution())
    text = scenario_text(home_scenario()).replace(
        "[boundary.home]", '[boundary.home]\nephemeris_file = "home.csv"'
    )
    assert "ephemeris_file" in text
    (tmp_path / "scenario.toml").write_text(text)
    scenario = load_scenario(tmp_path / "scenario.toml")
    assert scenario.boundary.home.ephemeris_file == str(tmp_path / "home.csv")
    with pytest.raises(InputError, match=r"boundary\.home.*scp_recon design"):
        Mission.from_scenario(scenario)


FILE = r"boundary\.home\.ephemeris_file"


@pytest.mark.parametrize(
    ("track", "home", "told"),
    [
        ((0.8, 1.0, 400), {}, f"{FILE}.*288 deg.*go round once"),
        ((1.3, 1.0, 20), {}, f"{FILE}.*15 deg between states"),
        ((1.3, 1.0, 400), {"sense": "right_handed"}, f"{FILE}.*boundary.home.sense"),
        ((1.3, 1.0, 400), {"radius_m": 2500.0}, f"{FILE}.*1000 m from.*radius_m, 2500 m$"),
        ((1.3, 1.0, 400), {"radius_m": 1e6}, f"{FILE}.*metres, not kilometres"),
        ((1.3, 1.0, 400), {"spacecraft_id": -64}, r"boundary\.home\.spacecraft_id.*no kernel"),
    ],
)
def test_file_without_a_home_orbit_is_refused(track, home, told, tmp_path):
    path = write_csv(tmp_path / "home.csv", *revolution(*track))
    with pytest.raises(InputError, match=told):
        spaces_of(from_file(path, **home))


def test_bad_files_are_told_by_the_entry(tmp_path):
    times, states = revolution()
    burn = np.insert(times, 100, times[100]), np.insert(states, 100, states[100], axis=0)
    with pytest.raises(InputError, match=f"{FILE}.*without a burn"):
        spaces_of(from_file(write_csv(tmp_path / "home.csv", *burn)))
    with pytest.raises(InputError, match=f"^{FILE}"):
        spaces_of(from_file(tmp_path / "none.csv"))
    pytest.importorskip("oem")
    other = write_oem(tmp_path / "home.oem", times, states, center="RYUGU")
    with pytest.raises(InputError, match=f"^{FILE}.*RYUGU"):
        spaces_of(from_file(other))
    with pytest.raises(InputError, match=r"boundary\.home\.spacecraft_id: got nothing"):
        spaces_of(from_file(tmp_path / "home.bsp"))
    with pytest.raises(InputError, match=r"boundary\.home.*flown"):
        from_file(tmp_path / "home.csv", flown=True)
    with pytest.raises(InputError, match=r"boundary\.home.*spacecraft_id"):
        home_scenario(spacecraft_id=-64)


def test_ring_in_metres_for_kilometres_is_asked_about(tmp_path):
    times, states = revolution()
    path = write_oem(tmp_path / "home.oem", times, 1e3 * states)
    with pytest.raises(InputError, match=f"{FILE}.* km from the centre.*kilometres, not metres"):
        spaces_of(from_file(path))
