"""The default plan by other weights and radii: every factor that is varied reaches the loop."""

import pytest

from experiments.solvers.optima import FACTORS, by_value, plan_varied

CHEAP = "replan"


@pytest.mark.slow
def test_every_factor_reaches_the_loop():
    usual = plan_varied((CHEAP, "scvx", "penalty weight", 1.0))
    for name in FACTORS:
        row = plan_varied((CHEAP, "scvx", name, 0.01))
        assert row["iterations_p3"] > usual["iterations_p3"]
        assert row["total_dv_m_s"] == pytest.approx(usual["total_dv_m_s"], rel=1e-4)
    (line,) = by_value([usual | {"status": "max_iterations"}])
    assert str(line[CHEAP]).startswith("max iterations (5 + 3)")
