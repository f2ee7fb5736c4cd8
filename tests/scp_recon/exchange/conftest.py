"""The default plan, ready to be written."""

from __future__ import annotations

import pytest

from scp_recon.exchange.heading import SPACECRAFT_ID, Export, Ids
from scp_recon.exchange.path import fly_path
from scp_recon.mission.mission import Mission
from scp_recon.solution.file import Solution
from scp_recon.solution.verdict import Verification

BENNU = 2101955


@pytest.fixture(scope="session")
def export(mission: Mission, solution: Solution, verification: Verification) -> Export:
    verified = solution.model_copy(update={"verification": verification})
    return Export(verified, mission, fly_path(mission, verified), Ids(SPACECRAFT_ID, BENNU))
