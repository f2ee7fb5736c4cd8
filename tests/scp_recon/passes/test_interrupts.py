"""Ctrl-C ends a design: a plan that it cut short does not count as a pass without one."""

from __future__ import annotations

import numpy as np
import pytest

from scp_recon.passes.descent import Near
from scp_recon.passes.scan import scan
from scp_recon.passes.setting import spaces_of
from scp_recon.passes.space import Pass, Space
from scp_recon.scp.algorithms import SCvx
from scp_recon.scp.loop import Record
from tests.scp_recon.passes.support import home_scenario

TIMES = (0.0, 8000.0, 24_000.0, 34_842.0)


@pytest.fixture(scope="module")
def space() -> Space:
    return spaces_of(home_scenario({"grid.step_max_s": 900.0}))[0][0]


@pytest.fixture
def interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    """As soon as something is iterated."""

    def step(*_: object) -> Record:
        raise KeyboardInterrupt

    monkeypatch.setattr(SCvx, "step", step)


@pytest.mark.usefixtures("interrupted")
def test_while_the_map_is_made(space: Space) -> None:
    with pytest.raises(KeyboardInterrupt):
        scan(space, TIMES, lambda _: None)


@pytest.mark.usefixtures("interrupted")
@pytest.mark.parametrize("certain", [False, True])
def test_while_a_pass_is_planned(space: Space, *, certain: bool) -> None:
    with pytest.raises(KeyboardInterrupt):
        Near(space, Pass((2.7, 0.0), TIMES), np.zeros((4, 3)), certain=certain)
