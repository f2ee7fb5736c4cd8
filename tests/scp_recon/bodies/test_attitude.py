"""Tables of attitudes: one that turns evenly, one that tumbles freely, and what is no table."""

import re
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation as SciPyRotation

from formulations.arrays import Array
from scp_recon.bodies.catalogue import J2000_TDB, OBLIQUITY, packaged_body
from scp_recon.bodies.files import read_attitude
from scp_recon.campaigns.axes import noons_of
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.mission.scene import Scene
from scp_recon.planning.initial_guess import ballistic
from scp_recon.planning.ipopt import casadi_arcs
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario, packaged_scenario, scenario_text
from tests.scenarios import COARSE
from tests.scp_recon.support import mission_of

HEADER = "tdb_s,qw,qx,qy,qz"
FILE = "body.attitude_file"


def written(path: Path, times: Array, quaternions: Array, header: str = HEADER) -> str:
    rows = (",".join(map(repr, row)) for row in np.column_stack([times, quaternions]).tolist())
    path.write_text("\n".join(["# attitudes", header, *rows]), "utf-8")
    return str(path)


@pytest.fixture(scope="module")
def uniform(mission, tmp_path_factory) -> str:
    """A table of Bennu's uniform rotation, from before the default flight to after it."""
    times = np.arange(-600.0, 36_001.0, 300.0)
    turned = SciPyRotation.from_matrix(mission.rotation.body_to_j2000(times))
    epoch = (mission.scenario.epoch.tdb - J2000_TDB).total_seconds()
    path = tmp_path_factory.mktemp("attitude") / "bennu.csv"
    return written(path, epoch + times, turned.as_quat(scalar_first=True))


@pytest.fixture(scope="module")
def tabulated(uniform) -> Mission:
    return mission_of(f'{FILE}="{uniform}"')


def test_a_table_of_a_uniform_rotation_changes_nothing(tabulated, mission, default_plan):
    """Neither window nor plan, J2 included, which a body that tumbles carries with it."""
    assert tabulated.schedule.window_s == pytest.approx(mission.schedule.window_s, abs=1e-3)
    planned = plan(tabulated, ballistic(tabulated))
    assert planned.burns_m_s == pytest.approx(default_plan.burns_m_s, abs=1e-6)
    body = tabulated.scenario.body
    assert body.pole_ra_deg == pytest.approx(mission.scenario.body.pole_ra_deg, abs=1e-6)
    assert tabulated.scene.gravity_in_words() == "point mass and J2 that tumble with the body"


def test_arcs_over_symbols_tumble_too(uniform):
    flow = mission_of(COARSE, f'{FILE}="{uniform}"').flow
    starts = np.tile([0.9, 0.1, -0.2, 0.1, 0.8, 0.1], (flow.arcs, 1))
    arcs = casadi_arcs(flow)
    ends = np.array(arcs.flow.map(flow.arcs)(starts.T, ca.DM(arcs.durations).T)).T
    assert ends == pytest.approx(flow.differentiate(starts).state, rel=1e-12, abs=1e-13)


def test_attitudes_stay_with_the_scenario_at_another_epoch(tabulated):
    """Pole and meridian are those of the epoch."""
    scenario = tabulated.scenario
    later = scenario.replace({"epoch.tdb": "2020-01-21T20:35:17.184"})
    assert later.body.attitude == scenario.body.attitude
    assert later.body.pole_ra_deg == pytest.approx(scenario.body.pole_ra_deg, abs=1e-6)
    matrices = Scene.of(later).rotation.body_to_j2000(0.0), tabulated.rotation.body_to_j2000(120.0)
    assert matrices[0] == pytest.approx(matrices[1], abs=1e-9)


def test_attitudes_are_written_with_the_scenario_and_read(tmp_path):
    scenario, file = packaged_scenario("apophis"), tmp_path / "scenario.toml"
    file.write_text(scenario_text(scenario), "utf-8")
    assert load_scenario(file) == scenario


def test_a_body_that_tumbles_has_no_noons():
    with pytest.raises(InputError, match="no noons"):
        noons_of(packaged_scenario("apophis"))


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (("body.pole_ra_deg=80", "body.pole_dec_deg=0"), "the pole in attitude"),
        (("epoch.tdb=2020-01-21T21:33:17", "sun={}"), f"{FILE}: .*must span"),
    ],
)
def test_pole_or_flight_off_the_table_is_refused(uniform, overrides, words):
    with pytest.raises(InputError, match=words):
        mission_of(f'{FILE}="{uniform}"', *overrides)


def test_apophis_turns_freely_as_published():
    """Angular momentum in J2000 stays at ecliptic (275, -85) deg for moments 0.64 : 0.97 : 1."""
    table = read_attitude(Path(packaged_body("Apophis").entries["attitude_file"]))
    moments = np.array([0.64, 0.97, 1.0])
    times = np.linspace(table.tdb_s[20], table.tdb_s[-20], 200)
    spins = np.array([table.spin(t) for t in times])
    momenta = np.einsum("nij,nj->ni", table.matrix(times), moments * spins)
    size = np.linalg.norm(momenta, axis=1)
    assert np.ptp(size) < 1e-4 * size.mean()
    longitude, latitude = np.deg2rad([275.0, -85.0])
    x, y = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude)
    z, (c, s) = np.sin(latitude), (np.cos(OBLIQUITY), np.sin(OBLIQUITY))
    expected = np.array([x, c * y - s * z, s * y + c * z])
    assert np.abs(momenta / size[:, None] - expected).max() < 1e-4
    energy = (moments * spins**2).sum(axis=1) / size**2
    assert energy == pytest.approx(1.024, abs=0.013)  # Pravec et al. 2014
    # The long axis goes round the angular momentum in 27.385 h on average.
    across = np.cross(expected, [0.0, 0.0, 1.0])
    long_axis = table.matrix(table.tdb_s)[:, :, 0]
    azimuth = np.unwrap(np.arctan2(long_axis @ np.cross(expected, across), long_axis @ across))
    turns = (azimuth[-1] - azimuth[0]) / (2.0 * np.pi)
    assert 240.0 / turns == pytest.approx(27.385, rel=0.01)


ONE = [1.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("times", "quaternions", "header", "words"),
    [
        ([0.0, 1.0], [ONE, ONE], "t,w,x,y,z", "line 2: 't,w,x,y,z'; must be tdb_s,qw,qx,qy,qz"),
        ([0.0, 1.0, 1.0], [ONE, ONE, ONE], HEADER, "ascending order, as row 3"),
        ([0.0, 1.0], [ONE, [0.0, 1.0, 0.0, 0.0]], HEADER, "at most 30 deg, as row 2"),
        ([0.0, 1.0], [[0.9, 0.0, 0.0, 0.0], ONE], HEADER, "length one, to 0.001, as row 1"),
        ([0.0, 1.0], [ONE, ONE], f"{HEADER}\n0,1,0,0", "line 3: '0,1,0,0'; must be 5"),
        ([0.0, 1.0], [ONE, ONE], f"{HEADER}\n0,1,0,x,0", "line 3: '0,1,0,x,0'"),
        ([0.0, 1.0], [ONE, [np.nan, 0.0, 0.0, 0.0]], HEADER, "line 4: '"),
        ([0.0, 1.0], [ONE, [2.0, 0.0, 0.0, 0.0]], HEADER, "length one, to 0.001, as row 2"),
    ],
)
def test_what_is_no_table_of_attitudes_is_refused(times, quaternions, header, words, tmp_path):
    path = written(tmp_path / "wrong.csv", np.array(times), np.array(quaternions), header)
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        load_scenario(None, [f'{FILE}="{path}"'])
    assert caught.value.entry == FILE
    assert str(path) in caught.value.given
