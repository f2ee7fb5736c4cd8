"""The default plan, ready to be written."""

from dataclasses import replace

import pytest

from scp_recon.interop.export import SPACECRAFT_ID, Export, Ids
from scp_recon.interop.path import fly_path
from scp_recon.mission.mission import Mission
from scp_recon.results.facts import Verification
from scp_recon.results.solution import Solution

BENNU = 2101955


@pytest.fixture(scope="session")
def export(mission: Mission, solution: Solution, verification: Verification) -> Export:
    verified = replace(solution, verification=verification)
    return Export(verified, mission, fly_path(mission, verified), Ids(SPACECRAFT_ID, BENNU))
