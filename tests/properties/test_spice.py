"""Observation geometry at random times and places, against SPICE and the kernel of Bennu."""

from collections.abc import Iterator
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scp_recon.mission.mission import Mission
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit
from scp_recon.physics.geometry import Site
from scp_recon.scenario.load import load_scenario
from tests.helpers import generators, random_unit
from tests.reference import BENNU, EPOCH_ET, write_bennu_kernel

times = st.floats(-2e4, 4e4).map(lambda t: round(t, 6))
"""To the microsecond: SPICE divides by the time, and refuses denormal ones."""


@pytest.fixture(scope="module")
def spice(tmp_path_factory) -> Iterator[ModuleType]:
    spiceypy = pytest.importorskip("spiceypy")
    spiceypy.kclear()
    spiceypy.furnsh(str(write_bennu_kernel(tmp_path_factory.mktemp("kernel"))))
    yield spiceypy
    spiceypy.kclear()


@pytest.fixture(scope="module")
def mission() -> Mission:
    return Mission.from_scenario(load_scenario())


@given(times, generators, st.floats(300.0, 5000.0))
def test_phase_emission_and_incidence_are_those_of_spice(mission, spice, t, rng, distance):
    site = Site(250.0 * random_unit(rng), unit(random_unit(rng)))
    craft, sun = distance * random_unit(rng), random_unit(rng)
    turn = spice.tipbod("J2000", BENNU, EPOCH_ET + t)
    to_craft = spice.vsub(craft, spice.mtxv(turn, site.position_body))
    normal = spice.mtxv(turn, site.normal_body)
    track = geometry.track(site, mission.rotation, np.array([t]))
    position, towards_sun = craft[None], sun[None]
    accurate = {"rel": 0.0, "abs": 1e-8}
    assert geometry.distance(position, track)[0] == pytest.approx(spice.vnorm(to_craft), rel=1e-9)
    assert geometry.emission(position, track)[0] == pytest.approx(
        spice.vsep(to_craft, normal), **accurate
    )
    assert geometry.phase(position, track, towards_sun)[0] == pytest.approx(
        spice.vsep(to_craft, sun), **accurate
    )
    assert geometry.incidence(track, towards_sun)[0] == pytest.approx(
        spice.vsep(normal, sun), **accurate
    )
