"""The default plan, ready to be written."""

from dataclasses import replace

import pytest

from scp_recon.interop.export import SPACECRAFT_ID, Export, Ids
from scp_recon.interop.path import fly_path

BENNU = 2101955


@pytest.fixture(scope="session")
def export(mission, solution, verification) -> Export:
    verified = replace(solution, verification=verification)
    return Export(verified, mission, fly_path(mission, verified), Ids(SPACECRAFT_ID, BENNU))
