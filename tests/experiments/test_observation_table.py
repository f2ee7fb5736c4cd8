"""The paper's table: rows, statements, variants, and the flight's kernel."""

from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import spiceypy

from experiments import observation_table
from experiments.__main__ import main
from experiments.evidence import Evidence, path_of
from experiments.observation_rows import (
    BENNU_ID,
    OSIRIS_REX_ID,
    as_flown_burns,
    flown_guess,
    flown_states,
    rows,
    still_sun_window_s,
)
from experiments.observation_table import numbers, statements
from formulations.arrays import Array
from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.physics import geometry
from scp_recon.physics.flow import propagate
from scp_recon.planning import initial_guess
from scp_recon.results.solution import Solution
from scp_recon.scenario.schema import Epoch

pytestmark = pytest.mark.slow


def test_statements_and_numbers_follow_from_the_rows():
    """Those of the page, from its rows; fixed text apart, each is computed."""
    tables = Evidence.read(path_of("observation_table")).tables
    rows = [
        {column: "" if cell is None else cell for column, cell in row.items()}
        for row in tables["observation_table"]
    ]
    assert statements(rows) == tables["statements"]
    assert numbers(rows) == tables["numbers"]
    without = [row for row in rows if "ipopt" not in row["row"]]
    fewer = {each["statement"] for each in statements(without)}
    assert "an off-the-shelf solver of nonlinear programs solves P2" not in fewer
    worse = [row | {"mean_s": 0.0} if row["row"] == "scp_warm" else row for row in rows]
    assert numbers(worse) != tables["numbers"]


def test_still_sun_window_follows_from_rotation_alone(mission):
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


def test_failed_rows_leave_the_others(tmp_path, monkeypatch, capsys):
    def failing(_: Mission) -> Solution:
        raise RuntimeError("the solver\nlost its way")

    first, second, *_ = rows()
    broken = [first._replace(key="broken", design=failing), second]
    monkeypatch.setattr(observation_table, "rows", lambda **_: broken)
    monkeypatch.setattr(observation_table, "variants", lambda _: [])
    monkeypatch.setattr(observation_table, "SAMPLES", 500)
    assert main(["observation_table", "--out", str(tmp_path)]) == 4
    assert "failed: RuntimeError: the solver lost its way" in capsys.readouterr().out
    table = pd.read_csv(tmp_path / "observation_table.csv").set_index("row")
    assert np.isnan(table.mean_s["broken"])
    assert table.mean_s["p3"] > 0.0


def write_kernel(path: Path, mission: Mission, states: Array) -> Path:
    """Node states in m and m/s as an SPK of the flight, cubic between the nodes."""
    et = (mission.scenario.epoch.tdb - J2000_TDB).total_seconds() + mission.times_s
    handle = spiceypy.spkopn(str(path), "test", 0)
    spiceypy.spkw13(
        handle, OSIRIS_REX_ID, BENNU_ID, "J2000", et[0], et[-1], "flight", 3, len(et), states / 1e3, et
    )  # fmt: skip
    spiceypy.spkcls(handle)
    return path


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
    np.testing.assert_allclose(flown_states(kernel, mission), flight, rtol=1e-12, atol=1e-9)
    assert spiceypy.ktotal("ALL") == 0  # and the kernel is put back


def test_fitted_impulses_follow_other_burns(mission, kernel, flight):
    burns, distance_m = as_flown_burns(kernel, mission)
    flown = initial_guess.from_burns(mission, burns).mean * mission.units.state
    window = mission.window_nodes
    off = np.linalg.norm(flown[window, :3] - flight[window, :3], axis=1).max()
    assert off == pytest.approx(distance_m, rel=1e-6)
    assert off < 10.0
    np.testing.assert_allclose(flown[-1, 3:], mission.final_state[3:], atol=1e-9)
    # Read off at the firing times alone the second half is lost.
    table = flown_guess(kernel, mission)
    lost = initial_guess.from_burns(mission, table.burns * mission.units.speed_m_s).mean
    assert np.linalg.norm(lost[window, :3] - flown[window, :3] / mission.units.length_m) > 0.1


def test_kernels_must_cover_the_flight(mission, kernel, tmp_path, capsys):
    later = mission.scenario.model_copy(
        update={"epoch": Epoch(tdb=mission.scenario.epoch.tdb + timedelta(days=1))}
    )
    with pytest.raises(InputError, match=r"spacecraft -64 about body 2101955"):
        flown_states(kernel, replace(mission, scenario=later))
    for name in ("missing.bsp", "text.bsp"):
        (tmp_path / "text.bsp").write_text("no kernel", encoding="utf-8")
        out = tmp_path / "out"
        words = ["observation_table", "--out", str(out)]
        assert main([*words, "--as-flown", str(tmp_path / name)]) == 2
        errors = capsys.readouterr().err
        assert errors.startswith(f"error: --as-flown: got {tmp_path / name}")
        assert errors.count("\n") == 1
        assert not out.exists()
