"""Other tools: what is told without them, and that a row is of the burns that it reports."""

import pytest

from experiments.other_tools import peers

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def halo() -> peers.Halo:
    return peers.Halo()


def test_another_integrator_flies_the_burns(halo):
    row = halo.row(("condensed", "scvx"), 0)
    assert (row["status"], row["seed"]) == ("converged", 0)
    assert row["cost"] == pytest.approx(0.1945583, abs=2e-7)
    assert row["missed"] < peers.MISSED
    plan = halo.problem.solve(halo.guess(0))
    assert halo.missed(plan.burns) == pytest.approx(row["missed"])
    assert halo.missed(plan.burns * 1.01) > peers.MISSED


def test_solved_meets_end_and_least_cost():
    def row(status: str, cost: float, missed: float, method: str = "a") -> peers.Record:
        told = {"status": status, "cost": cost, "missed": missed, "method": method}
        return told | {"iterations": 3, "solve_s": 0.5}

    rows = [
        row("converged", 1.0, 1e-9),
        row("converged", 1.00005, 1e-9),
        row("converged", 1.01, 1e-9),  # another optimum
        row("converged", 0.9, 1e-3),  # misses the final state
        row("max iterations", 1.0, 1e-9),
        row("converged", 2.0, 1e-9, "b"),
    ]
    a, b = ([*line.values()][:4] for line in peers.guesses(rows))
    assert (a, b) == (["a", 5, 4, 2], ["b", 1, 1, 0])
