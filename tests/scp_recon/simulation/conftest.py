"""The vehicle, and a short plan for it."""

import pytest

from scp_recon.mission.mission import Mission
from scp_recon.results.solution import Solution
from scp_recon.simulation.vehicle import Vehicle, load_vehicle
from tests.scp_recon.support import mission_of

from .short_plan import SHORT, short_plan


@pytest.fixture(scope="session")
def vehicle() -> Vehicle:
    return load_vehicle()


@pytest.fixture(scope="session")
def short_mission() -> Mission:
    return mission_of(*SHORT)


@pytest.fixture(scope="session")
def short_solution(short_mission) -> Solution:
    return short_plan(short_mission)
