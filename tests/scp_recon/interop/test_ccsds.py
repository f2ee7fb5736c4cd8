"""OEM and OPM, read back by libraries that did not write them."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scp_recon.api.replans import plan_left
from scp_recon.interop.ccsds import oem_text, opm_text
from scp_recon.interop.export import Export, Ids
from scp_recon.interop.path import fly_path
from scp_recon.planning.plan import Plan
from scp_recon.replanning.delivery import Delivery
from scp_recon.replanning.flown import FlownPlan, predict
from scp_recon.replanning.remainder import mission_left
from scp_recon.results.solution import make_solution
from tests.scp_recon.support import integrate

LINE_MAX = 254
"""Of a message in the key-value notation."""


@pytest.fixture(scope="module")
def message(export: Export, tmp_path_factory: pytest.TempPathFactory) -> Any:
    oem = pytest.importorskip("oem")
    path = tmp_path_factory.mktemp("oem") / "plan.oem"
    path.write_text(oem_text(export), encoding="ascii")
    return oem.OrbitEphemerisMessage.open(str(path))


def test_every_segment_is_a_coast_of_the_path(message: Any, export: Export) -> None:
    from astropy.time import Time

    epoch = Time(export.mission.scenario.epoch.tdb, scale="tdb")
    about = {
        "REF_FRAME": "EME2000",
        "CENTER_NAME": "BENNU",
        "TIME_SYSTEM": "TDB",
        "INTERPOLATION": "HERMITE",
    }
    for segment, coast in zip(message, export.path.coasts, strict=True):
        assert {key: segment.metadata[key] for key in about} == about
        read = [(state.epoch - epoch).sec for state in segment.states]
        np.testing.assert_allclose(read, coast.times_s, atol=1e-9)
        states = np.array([np.r_[s.position, s.velocity] for s in segment.states]) * 1e3
        np.testing.assert_allclose(states, coast.states, rtol=1e-14)
        matrices = np.array([c.matrix for c in segment.covariances]) * 1e6
        np.testing.assert_allclose(
            matrices, coast.covariances, rtol=1e-12, atol=1e-12 * coast.covariances.max()
        )


def test_the_readers_interpolation_is_within_a_centimetre(message: Any, export: Export) -> None:
    from astropy.time import Time, TimeDelta

    epoch = Time(export.mission.scenario.epoch.tdb, scale="tdb")
    rng = np.random.default_rng(5)
    for segment, coast in zip(message, export.path.coasts, strict=True):
        for time in rng.uniform(coast.times_s[0], coast.times_s[-1], 5):
            found = segment(epoch + TimeDelta(time, format="sec")).position * 1e3
            k = int(np.searchsorted(coast.times_s, time)) - 1
            exact = integrate(export.mission.forces, coast.states[k], [coast.times_s[k], time])
            assert np.linalg.norm(found - exact[-1, :3]) < 1e-5


def test_segments_meet_at_the_burns_which_are_their_jumps(message: Any, export: Export) -> None:
    for burn, (before, after) in zip(
        export.solution.burns, itertools.pairwise(message), strict=True
    ):
        last, first = list(before.states)[-1], next(iter(after.states))
        assert last.epoch == first.epoch
        np.testing.assert_allclose((first.velocity - last.velocity) * 1e3, burn.dv_m_s, atol=1e-12)


def test_a_plan_in_flight_numbers_its_burns_as_the_flight_does(default_plan: Plan) -> None:
    flown = FlownPlan.of(default_plan)
    delivery = Delivery(17_000.0, predict(flown, 17_000.0, {}).state)
    plan = plan_left(flown, mission_left(flown, delivery, ()))
    solution, ids = make_solution(plan), Ids(-999, 2101955)
    left = Export(solution, plan.mission, fly_path(plan.mission, solution), ids)
    text = oem_text(left) + opm_text(left)
    for said in ("burn 3: t_s = 25000", "ends before burn 3", "begins after burn 4", "burn 4; the"):
        assert f"COMMENT {said}" in text
    assert "burn 1" not in text


def test_comments_tell_burns_plan_and_verdict_in_lines_as_short_as_the_standard_asks(
    export: Export,
) -> None:
    unchecked = replace(export.solution, verification=None, status="interrupted")
    for form in (oem_text, opm_text):
        text = form(export)
        assert text.isascii()
        assert max(map(len, text.splitlines())) <= LINE_MAX
        assert f"COMMENT plan {export.solution.plan_hash}" in text
        assert "\nCOMMENT verified\n" in text
        assert "2020-01-21T22:45:27.999494078 UTC" in text  # burn 2
        assert "COMMENT NOT VERIFIED: interrupted" in form(replace(export, solution=unchecked))


def test_the_opm_has_the_state_before_the_burns_and_every_burn(
    export: Export, tmp_path: Path
) -> None:
    io = pytest.importorskip("ccsds_ndm.ndm_io")  # under the GPL: it serves this test alone
    path = tmp_path / "plan.opm"
    path.write_text(opm_text(export), encoding="ascii")
    data = io.NdmIo().from_path(path).body.segment.data
    vector = data.state_vector
    read = [getattr(vector, axis).value for axis in ("x", "y", "z", "x_dot", "y_dot", "z_dot")]
    np.testing.assert_allclose(np.array(read) * 1e3, export.mission.initial_state, rtol=1e-14)
    factor = export.mission.initial_factor
    assert data.covariance_matrix.cx_x.value * 1e6 == pytest.approx((factor @ factor.T)[0, 0])
    assert len(data.maneuver_parameters) == len(export.solution.burns)
    for burn, found in zip(export.solution.burns, data.maneuver_parameters, strict=True):
        dv = [found.man_dv_1.value, found.man_dv_2.value, found.man_dv_3.value]
        np.testing.assert_allclose(np.array(dv) * 1e3, burn.dv_m_s, rtol=1e-14)
        assert found.man_duration.value == 0.0
        assert found.man_ref_frame == "EME2000"
