"""The default plan, ready to be written."""

from dataclasses import replace

import pytest

from scp_recon.interop.export import Export


@pytest.fixture(scope="session")
def export(solution, verification) -> Export:
    return Export.of(replace(solution, verification=verification))
