"""Another tool: a row is of the burns that it reports."""

import pytest

from experiments.other_tools import Halo

pytestmark = pytest.mark.slow


def test_another_integrator_flies_the_burns():
    halo = Halo()
    row = halo.row("scvx")
    assert row["status"] == "converged"
    assert float(row["cost"]) == pytest.approx(0.1945583, abs=2e-7)
    assert row["missed"] < 1e-7
    plan = halo.problem.solve(halo.guess)
    assert halo.missed(plan.burns) == pytest.approx(row["missed"])
    assert halo.missed(plan.burns * 1.01) > 1e-5
