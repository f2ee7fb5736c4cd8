"""Kernels of a plan, loaded by their own list and read by SPICE."""

import itertools
import re
from collections.abc import Iterator
from contextlib import chdir
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from formulations.arrays import Array
from scp_recon.bodies.catalogue import packaged_body
from scp_recon.interop import kernels
from scp_recon.interop.export import UNNAMED_BODY_ID
from scp_recon.interop.files import write_export
from scp_recon.interop.kernels import command_times, commanded
from scp_recon.scenario.time_scales import iso_utc
from scp_recon.simulation.guidance import FlightPlan
from scp_recon.simulation.vehicle import Vehicle, load_vehicle
from tests.scp_recon.support import integrate, raising

BENNU = 2101955
SPACECRAFT, BODY, AXES = "-999", "BENNU", "SC999_AXES"


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    return load_vehicle()


@pytest.fixture(scope="module")
def folder(export, vehicle, tmp_path_factory) -> Path:
    pytest.importorskip("spiceypy")
    # A path longer than a string in a kernel may be.
    folder = tmp_path_factory.mktemp("kernels") / ("it's a deep folder " * 5).strip()
    folder.mkdir()
    for form in ("spk", "ck"):
        write_export(export, form, folder, vehicle)
    return folder.rename(folder.with_name("moved"))


@pytest.fixture(scope="module")
def spice(folder) -> Iterator[ModuleType]:
    """With nothing loaded but the list, from a folder to which the kernels were moved."""
    spiceypy: ModuleType = pytest.importorskip("spiceypy")
    (listed,) = folder.glob("*.tm")
    spiceypy.kclear()
    with chdir(folder):
        spiceypy.furnsh(listed.name)
    yield spiceypy
    spiceypy.kclear()


def state_at(spice: ModuleType, et: float) -> Array:
    """Of the spacecraft about the body, J2000, SI."""
    return spice.spkezr(SPACECRAFT, et, "J2000", "NONE", BODY)[0] * 1e3


def test_spk_positions_are_within_a_millimetre(spice, export):
    for coast in export.coasts:
        read = np.array([state_at(spice, et) for et in export.et(coast.times_s[:-1])])
        assert np.abs(read[:, :3] - coast.states[:-1, :3]).max() < 1e-3
        np.testing.assert_allclose(read, coast.states[:-1], rtol=1e-10)
        for k in range(0, len(coast.times_s) - 1, 20):
            middle = coast.times_s[k : k + 2].mean()
            exact = integrate(export.mission.forces, coast.states[k], [coast.times_s[k], middle])
            between = state_at(spice, export.et(np.array([middle]))[0])
            assert np.linalg.norm((between - exact[-1])[:3]) < 1e-6


def test_a_burn_has_its_state_before_and_after(spice, export):
    for burn, (before, after) in zip(
        export.solution.burns, itertools.pairwise(export.coasts), strict=True
    ):
        et = export.et(np.array([burn.t_s]))[0]
        early, late = state_at(spice, et - 1e-4)[3:], state_at(spice, et)[3:]
        np.testing.assert_allclose(early, before.states[-1, 3:], atol=1e-8)
        np.testing.assert_allclose(late, after.states[0, 3:], atol=1e-12)


def test_attitudes_and_rates_are_those_commanded(spice, export, vehicle):
    flight = FlightPlan.of(export.solution, export.mission, vehicle)
    for leg in flight.legs:
        times = command_times(flight, leg)
        at = times[:-1]  # with the first instant of a mode
        for et, matrix in zip(export.et(at), commanded(flight, leg, at).as_matrix(), strict=True):
            off = spice.pxform(AXES, "J2000", et) @ matrix.T
            assert np.linalg.norm(spice.raxisa(off)[1]) < 1e-9
        middles = 0.5 * (times[:-1] + times[1:])[:: max(len(times) // 20, 1)]
        expected = commanded(flight, leg, middles)
        rates = (commanded(flight, leg, middles + 1e-2) * expected.inv()).as_rotvec() / 1e-2
        for et, matrix, rate in zip(export.et(middles), expected.as_matrix(), rates, strict=True):
            turn, found = spice.xf2rav(spice.sxform("J2000", AXES, et))
            assert np.linalg.norm(turn.T - matrix) < 1e-5
            np.testing.assert_allclose(found, rate, atol=2e-6)


def test_exported_body_turns_and_moves_as_planned(spice, export):
    mission = export.mission
    for time in np.linspace(0.0, mission.scenario.duration_s, 11):
        et = export.et(np.array([time]))[0]
        assert spice.utc2et(iso_utc(export.instant(time))) == pytest.approx(et, abs=1e-6)
        np.testing.assert_allclose(
            spice.pxform("B2101955_FIXED", "J2000", et),
            mission.rotation.body_to_j2000(time),
            atol=1e-8,
        )
        sun = -spice.spkpos(BODY, et, "J2000", "NONE", "SUN")[0]
        np.testing.assert_allclose(spice.vhat(sun), mission.sun_direction(time), atol=1e-12)
    known = packaged_body("Bennu")
    assert spice.bodvrd(BODY, "RADII", 3)[1] * 1e3 == pytest.approx(known.entries["radii_m"])


@pytest.mark.parametrize("body", [BENNU, UNNAMED_BODY_ID, 20_600_001, 433])
def test_frame_numbers_are_those_that_are_free(export, body):
    scenario = export.solution.scenario
    known = scenario.body.model_copy(update={"naif_id": body})
    of = replace(export.solution, scenario=scenario.model_copy(update={"body": known}))
    given = replace(export, solution=of)
    found = re.search(rf"FRAME_B{body}_FIXED = (\d+)\n", kernels.frames(given))
    assert 1_400_000 <= int(found[1]) <= 2_000_000


def test_failed_kernel_leaves_nothing_behind(export, vehicle, tmp_path, monkeypatch):
    pytest.importorskip("spiceypy")

    monkeypatch.setattr(kernels, "_rates", raising(MemoryError()))
    with pytest.raises(MemoryError):
        write_export(export, "ck", tmp_path, vehicle)
    assert list(tmp_path.iterdir()) == []
