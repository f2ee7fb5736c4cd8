"""Faults of conic solvers: what fails, lies or panics never makes a wrong plan.

Usual runs take a few faults of each kind, ten in all; `nightly` takes every one.
"""

from collections.abc import Callable, Iterator
from functools import cache
from types import SimpleNamespace
from typing import Any

import clarabel
import numpy as np
import pytest

from formulations.program import solvers
from formulations.program.certificate import ConeProgram
from formulations.program.solvers import SOLVERS, Answer, Clarabel
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Plan, plan
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status
from tests import reliability
from tests.helpers import usually
from tests.scenarios import COARSE
from tests.scp_recon.support import raising

pytestmark = pytest.mark.slow


class PanicError(BaseException):
    """As a panic in Rust arrives in Python: no Exception."""


Fault = Callable[[ConeProgram, Answer], Answer]


def inaccurate(_: ConeProgram, answer: Answer) -> Answer:
    """Far from its tolerances, and it says so."""
    noise = np.random.default_rng(0).normal(scale=1e-3, size=answer.x.shape)
    return Answer(answer.x + noise, "AlmostSolved", False, answer.solver_s)


def not_finite(_: ConeProgram, answer: Answer) -> Answer:
    return answer._replace(x=np.full_like(answer.x, np.nan))


def huge(_: ConeProgram, answer: Answer) -> Answer:
    return answer._replace(x=np.full_like(answer.x, 1e300))


def nonsense(_: ConeProgram, answer: Answer) -> Answer:
    """Numbers of the right size that solve nothing, called solved."""
    return answer._replace(x=np.random.default_rng(1).permutation(answer.x))


FAULTS: dict[str, Fault] = {
    "panic": raising(PanicError("called `Option::unwrap()` on a `None` value")),
    "inaccurate": inaccurate,
    "nonsense": nonsense,
    "not finite": not_finite,
    "huge": huge,
    "error": raising(ValueError("the factorisation failed")),
    "foreign error": raising(RuntimeError("an assertion in the solver")),
    "arithmetic": raising(ZeroDivisionError("division by zero")),
}


class Faulty:
    """Clarabel, some of whose answers are spoilt."""

    def __init__(self, fault: Fault, spoilt: Callable[[], bool]) -> None:
        self._solver, self._fault, self._spoilt = Clarabel({}), fault, spoilt

    def solve(self, program: ConeProgram) -> Answer:
        answer = self._solver.solve(program)
        return self._fault(program, answer) if self._spoilt() else answer


@cache
def coarse() -> tuple[Mission, Plan]:
    mission = Mission.from_scenario(load_scenario(None, [COARSE]))
    return mission, plan(mission, initial_guess.cold(mission))


def assert_honest(found: Plan) -> None:
    """Nothing is called converged that is not the optimum, and nothing infeasible at all."""
    status, best = found.final.result.status, coarse()[1].final.result.lin.iterate.total_dv
    assert status is not Status.INFEASIBLE
    if status is Status.CONVERGED:
        assert found.final.result.lin.iterate.total_dv == pytest.approx(best, rel=2e-3)
        misses = found.final.merit.violations(found.final.result.lin).values()
        assert max(float(miss.max(initial=0.0)) for miss in misses) <= 1e-6
    assert np.isfinite(found.final.result.lin.iterate.mean).all()
    reliability.count(reliability.FAULTS)


GIVEN_UP = (Status.SOLVER_FAILED, Status.STALLED, Status.MAX_ITERATIONS)

ANOTHER = ["error", "panic", "not finite", "foreign error", "arithmetic"]


@pytest.mark.parametrize(
    ("name", "how"),
    [
        *usually([(name, "now and then") for name in FAULTS], 3),
        *usually([(name, "another is there") for name in ANOTHER], 1),
        *usually([(name, "always") for name in FAULTS], 1),
    ],
)
def test_failing_solver_is_retried_then_replaced_then_reported(name, how, monkeypatch):
    mission, _ = coarse()
    calls: Iterator[int] = iter(range(10_000))
    spoilt = (lambda: next(calls) % 3 == 1) if how == "now and then" else lambda: True
    monkeypatch.setitem(SOLVERS, "CLARABEL", lambda _: Faulty(FAULTS[name], spoilt))
    if how == "another is there":
        pytest.importorskip("qoco", reason="there is no other solver")
    else:
        monkeypatch.delitem(SOLVERS, "QOCO")
    found = plan(mission, initial_guess.cold(mission))
    expected = GIVEN_UP if how == "always" else (Status.CONVERGED,)
    assert found.final.result.status in expected
    assert_honest(found)


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
        n = 3 * coarse()[0].problem.n_burns
        middle = 0.5 * (b[:n] - b[n : 2 * n])  # of the trust region's rows, radius +- burns
        assert np.ptp(b[:n] + b[n : 2 * n]) < 1e-9
        return np.concatenate([1e-7 + middle, 1e-7 - middle, b[2 * n :]])


class Mislabelled(Liar):
    def told(self, found: Any) -> Any:
        return SimpleNamespace(x=found.x, z=found.z, status="PrimalInfeasible", solve_time=0.0)


@pytest.mark.parametrize("liar", [Stale, Timid, Mislabelled])
def test_wrong_solver_status_is_found_out(liar, monkeypatch):
    """A verdict needs a closed duality gap, whatever the solver calls its answer."""
    mission, _ = coarse()
    names = {name: getattr(clarabel, name) for name in dir(clarabel)}
    lying = SimpleNamespace(**{**names, "DefaultSolver": liar})
    monkeypatch.setattr(solvers, "clarabel", lying)
    monkeypatch.delitem(SOLVERS, "QOCO")
    found = plan(mission, initial_guess.cold(mission))
    # Asked again from nothing, one that repeats itself tells the truth.
    assert (found.final.result.status is Status.CONVERGED) == (liar is Stale)
    assert_honest(found)
