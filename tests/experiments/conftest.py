"""The default mission, and burns of it that are given."""

import pytest

from experiments import harness
from scp_recon.mission.mission import Mission
from scp_recon.results.solution import Solution, ballistic_arc


@pytest.fixture(scope="session")
def mission() -> Mission:
    return harness.default_mission()


@pytest.fixture(scope="session")
def solution(mission) -> Solution:
    """Burns that are given, not planned: the studies do not mind."""
    return ballistic_arc(mission)
