"""The default plan, ready to be written."""

import pytest

from scp_recon.interop.export import Export


@pytest.fixture(scope="session")
def export(verified) -> Export:
    return Export.of(verified)
