"""Conic solvers that call their answers what they are not never make a wrong plan."""

from types import SimpleNamespace
from typing import Any

import clarabel
import numpy as np
import pytest

from formulations.program import solvers
from formulations.program.solvers import SOLVERS
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Plan, plan
from scp_recon.scp.status import Status
from tests import reliability
from tests.scenarios import reference

pytestmark = pytest.mark.slow


def assert_honest(found: Plan) -> None:
    """Nothing is called converged that is not the optimum, and nothing infeasible at all."""
    status, best = found.final.result.status, reference()[1].final.result.lin.iterate.total_dv
    assert status is not Status.INFEASIBLE
    if status is Status.CONVERGED:
        assert found.final.result.lin.iterate.total_dv == pytest.approx(best, rel=2e-3)
        misses = found.final.merit.violations(found.final.result.lin).values()
        assert max(float(miss.max(initial=0.0)) for miss in misses) <= 1e-6
    assert np.isfinite(found.final.result.lin.iterate.mean).all()
    reliability.count(reliability.FAULTS)


class Liar:
    """Clarabel, whose answers are not what it says they are."""

    def __init__(self, p: Any, q: Any, a: Any, b: Any, cones: Any, settings: Any) -> None:
        self._solver = clarabel.DefaultSolver(p, q, a, self.asked(b), cones, settings)

    def update(self, b: Any, **data: Any) -> None:
        self._solver.update(b=self.asked(b), **data)

    def asked(self, b: Any) -> Any:
        return b

    def solve(self) -> Any:
        return self.told(self._solver.solve())

    def told(self, found: Any) -> Any:
        return found


class Stale(Liar):
    """The first answer again and again."""

    first: Any = None

    def told(self, found: Any) -> Any:
        self.first = self.first or found
        return self.first


class Timid(Liar):
    """Feasible, and far from optimal: the best next to where it stands, called solved."""

    def asked(self, b: Any) -> Any:
        n = 3 * reference()[0].problem.n_burns
        middle = 0.5 * (b[:n] - b[n : 2 * n])  # of the trust region's rows, radius +- burns
        assert np.ptp(b[:n] + b[n : 2 * n]) < 1e-9
        return np.concatenate([1e-7 + middle, 1e-7 - middle, b[2 * n :]])


class Mislabelled(Liar):
    def told(self, found: Any) -> Any:
        return SimpleNamespace(x=found.x, z=found.z, status="PrimalInfeasible", solve_time=0.0)


@pytest.mark.parametrize("liar", [Stale, Timid, Mislabelled])
def test_wrong_solver_status_is_found_out(liar, monkeypatch):
    """A verdict needs a closed duality gap, whatever the solver calls its answer."""
    mission, _ = reference()
    names = {name: getattr(clarabel, name) for name in dir(clarabel)}
    lying = SimpleNamespace(**{**names, "DefaultSolver": liar})
    monkeypatch.setattr(solvers, "clarabel", lying)
    monkeypatch.delitem(SOLVERS, "QOCO")
    found = plan(mission, initial_guess.cold(mission))
    # Asked again from nothing, one that repeats itself tells the truth.
    assert (found.final.result.status is Status.CONVERGED) == (liar is Stale)
    assert_honest(found)
