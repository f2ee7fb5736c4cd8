"""Targets are starts of each other, so that a higher one is never likelier at a lower price."""

from dataclasses import dataclass
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scp_recon.certification import largest
from scp_recon.certification.largest import SAVING, Targets
from scp_recon.scp.status import Status

FRONTIER = (0.6, 0.9, 0.99)


@dataclass
class Fake:
    """A trial in a basin: of a price, with plans up to a target."""

    price: float
    most: float
    target: float

    @property
    def status(self) -> Status:
        return Status.CONVERGED if self.target <= self.most else Status.INFEASIBLE

    @property
    def cost(self) -> float:
        return self.price + self.target


BASINS = st.lists(
    st.tuples(st.floats(0.1, 3.0), st.floats(0.55, 1.0), st.sampled_from(FRONTIER)),
    min_size=1,
    max_size=4,
)


@given(basins=BASINS, order=st.permutations(FRONTIER))
def test_no_higher_target_costs_less(basins, order):
    """From the first start each target leads to a basin of its own; others stay in that of theirs."""

    def make(start: Fake | None, target: float) -> Fake:
        if start is None:
            price, most, _ = min(basins, key=lambda one: abs(one[2] - target))
            return Fake(price, most, target)
        return Fake(start.price, start.most, target)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(largest, "cost_of", lambda trial: trial.cost)
        work = Targets(make)
        for target in order:
            work.plan(None, target)
        found = [work.plan(None, target) for target in FRONTIER]
    for lower, higher in pairwise(found):
        if higher.status is Status.CONVERGED:
            assert lower.status is Status.CONVERGED
            assert lower.cost <= higher.cost / (1.0 - SAVING)


@pytest.mark.parametrize(("first", "then"), [(0.6, 0.9), (0.99, 0.9)])
def test_other_target_leads_where_its_own_ends(monkeypatch, first, then):
    """From the first start only one target has a plan; the other is found from that one."""
    monkeypatch.setattr(largest, "cost_of", lambda trial: trial.cost)

    def make(start: Fake | None, target: float) -> Fake:
        lost = start.most < 1.0 if start else target == then
        return Fake(1.0, 0.5 if lost else 1.0, target)

    work = Targets(make)
    assert work.plan(None, first).status is Status.CONVERGED
    found = work.plan(None, then)
    assert (found.status, found.target) == (Status.CONVERGED, then)
