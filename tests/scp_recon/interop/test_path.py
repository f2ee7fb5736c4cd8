"""Exported paths: states, tables, and CCSDS messages."""

import csv
import io
import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scp_recon.api.planning import plan_left
from scp_recon.errors import InputError
from scp_recon.interop import export as export_module
from scp_recon.interop.ccsds import oem_text, opm_text
from scp_recon.interop.export import MARGIN_S, WITHIN_M, Export, fly_coasts
from scp_recon.interop.files import columns, csv_text, parquet_bytes
from scp_recon.replanning.flown import FlownPlan, predict
from scp_recon.replanning.remainder import Delivery
from scp_recon.results.solution import make_solution
from tests.scp_recon.support import integrate


def test_coasts_meet_at_burns_that_jump_the_velocity(export):
    coasts, firing = export.coasts, export.mission.scenario.burns.times_s
    edges = [(c.times_s[0], c.times_s[-1]) for c in coasts]
    assert edges == list(itertools.pairwise((firing[0] - MARGIN_S, *firing, firing[-1] + MARGIN_S)))
    assert all((np.diff(coast.times_s) > 0.0).all() for coast in coasts)
    for burn, (before, after) in zip(
        export.solution.burns_m_s, itertools.pairwise(coasts), strict=True
    ):
        jump = after.states[0] - before.states[-1]
        np.testing.assert_allclose(jump[:3], 0.0, atol=1e-9)
        np.testing.assert_allclose(jump[3:], burn, atol=1e-12)
    np.testing.assert_allclose(coasts[0].states[-1], export.mission.initial_state, rtol=1e-14)
    off = coasts[-1].states[0] - export.mission.final_state
    assert np.linalg.norm(off[:3]) < 1e-3
    assert np.linalg.norm(off[3:]) < 1e-7


def test_a_missed_burn_leaves_the_free_drift(export):
    mission, solution = export.mission, export.solution
    drifting = Export.of(solution, miss=2)
    (drift,) = drifting.coasts[1:]
    ends = (0.0, mission.scenario.burns.times_s[1] + 86_400.0)
    assert (drift.times_s[0], drift.times_s[-1]) == ends
    flown = integrate(mission.forces, drift.states[0], ends)[-1]
    np.testing.assert_allclose(drift.states[-1, :3], flown[:3], atol=0.01)
    text = csv_text(drifting)
    assert "burn 2: missed" in text
    assert "# 1 burns, impulses" in text
    assert "MAN_EPOCH" in opm_text(drifting)
    assert opm_text(drifting).count("MAN_EPOCH") == 1


def test_covariances_are_the_plans_at_its_nodes(export):
    stored = np.array(export.solution.nodes.covariance)
    times, seen = np.array(export.solution.nodes.t_s), 0
    scale = np.outer(export.mission.units.state, export.mission.units.state)
    for coast in export.coasts[1:]:
        at = np.flatnonzero(np.isin(coast.times_s, times))
        at = at if coast is export.coasts[-1] else at[:-1]  # a burn adds its errors
        node, seen = np.searchsorted(times, coast.times_s[at]), seen + len(at)
        off = np.abs(coast.covariances[at] - stored[node]) / scale
        assert off.max() < 1e-6 * np.abs(stored / scale).max()
    assert seen == len(times)


@given(share=st.floats(0.0, 1.0 - 1e-9))
def test_straight_lines_between_neighbours_are_within_a_centimetre(export, share):
    for coast in export.coasts:
        span = coast.times_s[-1] - coast.times_s[0]
        time = coast.times_s[0] + share * span
        k = int(np.searchsorted(coast.times_s, time, side="right")) - 1
        a, b = coast.times_s[k : k + 2]
        exact = integrate(export.mission.forces, coast.states[k], [a, max(time, a + 1e-6)])[-1]
        weight = (time - a) / (b - a)
        line = (1.0 - weight) * coast.states[k, :3] + weight * coast.states[k + 1, :3]
        assert np.linalg.norm(line - exact[:3]) <= max(coast.linear_error_m, 1e-6) * 1.001
        assert coast.linear_error_m <= WITHIN_M


def test_a_path_that_bends_more_gets_more_states(solution, export, monkeypatch):
    monkeypatch.setattr(export_module, "WITHIN_M", 1e-4)
    denser = Export.of(solution)
    assert denser.linear_error_m <= 1e-4 < export.linear_error_m
    assert denser.size > 3 * export.size


def test_what_needs_too_many_states_is_refused(solution, monkeypatch):
    monkeypatch.setattr(export_module, "STATES_MAX", 100)
    with pytest.raises(InputError, match="more than 100 states"):
        fly_coasts(solution)


def test_nodes_off_the_burns_path_are_refused(solution):
    states = [list(state) for state in solution.nodes.state]
    states[40][1] += 0.02
    nodes = replace(solution.nodes, state=states)
    with pytest.raises(InputError, match="off the path"):
        fly_coasts(replace(solution, nodes=nodes))


def test_csv_is_the_path_to_the_last_digit(export):
    lines = [line for line in csv_text(export).splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    assert len(rows) == export.size
    states = np.concatenate([coast.states for coast in export.coasts])
    names = ("x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")
    read = np.array([[float(row[name]) for name in names] for row in rows])
    np.testing.assert_array_equal(read, states)
    sigma = np.sqrt([float(row["cov_vz_vz_m2_s2"]) for row in rows])
    matrices = np.concatenate([coast.covariances for coast in export.coasts])
    np.testing.assert_allclose(sigma, np.sqrt(matrices[:, 5, 5]), rtol=1e-12)
    times, coasts = (np.array(columns(export)[name]) for name in ("t_s", "coast"))
    for number, burn in enumerate(export.solution.burns):
        assert coasts[times == burn.t_s].tolist() == [number, number + 1]  # two rows at a burn


def test_parquet_holds_the_same(export):
    parquet = pytest.importorskip("pyarrow.parquet")
    table = parquet.read_table(io.BytesIO(parquet_bytes(export)))
    assert table.to_pydict() == columns(export)
    about = table.schema.metadata[b"scp_recon"].decode()
    assert export.solution.plan_hash in about
    assert "J2000" in about


LINE_MAX = 254
"""Of a message in the key-value notation."""


@pytest.fixture(scope="module")
def message(export, tmp_path_factory) -> Any:
    oem = pytest.importorskip("oem")
    path = tmp_path_factory.mktemp("oem") / "plan.oem"
    path.write_text(oem_text(export), encoding="ascii")
    return oem.OrbitEphemerisMessage.open(str(path))


@pytest.mark.slow
def test_another_reader_interpolates_segments_within_a_centimetre(message, export):
    from astropy.time import Time, TimeDelta

    epoch, rng = Time(export.mission.scenario.epoch.tdb, scale="tdb"), np.random.default_rng(5)
    about = {"REF_FRAME": "EME2000", "CENTER_NAME": "BENNU"}
    about |= {"TIME_SYSTEM": "TDB", "INTERPOLATION": "HERMITE"}
    for segment, coast in zip(message, export.coasts, strict=True):
        assert {key: segment.metadata[key] for key in about} == about
        read = [(state.epoch - epoch).sec for state in segment.states]
        np.testing.assert_allclose(read, coast.times_s, atol=1e-9)
        states = np.array([np.r_[s.position, s.velocity] for s in segment.states]) * 1e3
        np.testing.assert_allclose(states, coast.states, rtol=1e-14)
        matrices = np.array([c.matrix for c in segment.covariances]) * 1e6
        np.testing.assert_allclose(
            matrices, coast.covariances, rtol=1e-12, atol=1e-12 * coast.covariances.max()
        )
        for time in rng.uniform(coast.times_s[0], coast.times_s[-1], 5):
            found = segment(epoch + TimeDelta(time, format="sec")).position * 1e3
            k = int(np.searchsorted(coast.times_s, time)) - 1
            exact = integrate(export.mission.forces, coast.states[k], [coast.times_s[k], time])
            assert np.linalg.norm(found - exact[-1, :3]) < 1e-5


def test_plan_in_flight_keeps_the_flights_burn_numbers(default_plan):
    flown = FlownPlan.of(default_plan)
    delivery = Delivery(17_000.0, predict(flown, 17_000.0, {}).state)
    plan = plan_left(flown, delivery)
    left = Export.of(make_solution(plan))
    text = oem_text(left) + opm_text(left)
    for said in ("burn 3: t_s = 25000", "ends before burn 3", "begins after burn 4", "burn 4; the"):
        assert f"COMMENT {said}" in text
    assert "burn 1" not in text


def test_comments_tell_burns_plan_and_verdict_briefly(export):
    unchecked = replace(export.solution, verification=None, status="interrupted")
    for form in (oem_text, opm_text):
        text = form(export)
        assert text.isascii()
        assert max(map(len, text.splitlines())) <= LINE_MAX
        assert f"COMMENT plan {export.solution.plan_hash}" in text
        assert "\nCOMMENT verified\n" in text
        assert "2020-01-21T22:45:27.999494078 UTC" in text  # burn 2
        assert "COMMENT NOT VERIFIED: interrupted" in form(replace(export, solution=unchecked))


@pytest.mark.slow
def test_opm_has_initial_state_and_every_burn(export, tmp_path):
    io = pytest.importorskip("ccsds_ndm.ndm_io")  # under the GPL: it serves this test alone
    path = tmp_path / "plan.opm"
    path.write_text(opm_text(export), encoding="ascii")
    data = io.NdmIo().from_path(path).body.segment.data
    vector = data.state_vector
    read = [getattr(vector, axis).value for axis in ("x", "y", "z", "x_dot", "y_dot", "z_dot")]
    np.testing.assert_allclose(np.array(read) * 1e3, export.mission.initial_state, rtol=1e-14)
    gm, orbit = export.mission.forces.gm, data.keplerian_elements
    assert orbit.gm.value * 1e9 == pytest.approx(gm, rel=1e-14)
    spice = pytest.importorskip("spiceypy")
    known = spice.oscltx(export.mission.initial_state, 0.0, gm)
    for key, value in (
        ("inclination", known[2]),
        ("ra_of_asc_node", known[3]),
        ("arg_of_pericenter", known[4]),
        ("true_anomaly", known[8]),
    ):
        assert getattr(orbit, key).value == pytest.approx(np.rad2deg(value), rel=1e-9), key
    assert orbit.semi_major_axis.value * 1e3 == pytest.approx(known[9])
    assert orbit.eccentricity == pytest.approx(known[1])
    factor = export.mission.initial_factor
    assert data.covariance_matrix.cx_x.value * 1e6 == pytest.approx((factor @ factor.T)[0, 0])
    assert len(data.maneuver_parameters) == len(export.solution.burns)
    for burn, found in zip(export.solution.burns, data.maneuver_parameters, strict=True):
        dv = [found.man_dv_1.value, found.man_dv_2.value, found.man_dv_3.value]
        np.testing.assert_allclose(np.array(dv) * 1e3, burn.dv_m_s, rtol=1e-14)
        assert found.man_duration.value == 0.0
        assert found.man_ref_frame == "EME2000"
