"""A page with sliders, served once."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Thread

import pytest

from scp_recon.api.exploring import Explorer, Server
from scp_recon.scenario.load import load_scenario
from tests.scenarios import COARSE
from tests.scp_recon.support import fly_few


@pytest.fixture(scope="package")
def server() -> Iterator[Server]:
    with pytest.MonkeyPatch.context() as patch:
        fly_few(patch)
        patch.setattr("scp_recon.reports.write.SLIDER_FLIGHTS", 50)
        with Server(Explorer(load_scenario("recon_b", [COARSE])), 0) as found:
            thread = Thread(target=found.serve_forever, args=(0.01,))
            thread.start()
            yield found
            found.shutdown()
            thread.join()
