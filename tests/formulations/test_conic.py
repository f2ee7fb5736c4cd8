"""What is asked of the solvers behind CVXPY, and what is made of their answers."""

from __future__ import annotations

import warnings
from types import SimpleNamespace
from typing import Any, cast

import cvxpy as cp
import numpy as np
import pytest

from formulations import conic


def test_installed_solvers_are_conic_ones_clarabel_first(monkeypatch: pytest.MonkeyPatch) -> None:
    # GLPK has no second-order cones, OSQP no cones, and ECOS_BB is for integers.
    monkeypatch.setitem(conic.SOLVER_MAP_CONIC, "ALLCONES", conic.SOLVER_MAP_CONIC["ECOS"])
    names = ["SCS", "GLPK", "ECOS_BB", "OSQP", "ECOS", "ALLCONES", "CLARABEL", "QOCO"]
    monkeypatch.setattr(cp, "installed_solvers", lambda: names)
    assert conic.installed() == ("CLARABEL", "ALLCONES", "ECOS", "QOCO", "SCS")
    monkeypatch.setattr(cp, "installed_solvers", lambda: ["SCS", "QOCO"])
    assert conic.installed() == ("QOCO", "SCS")


class Program:
    """Something that is solved, and what it was asked."""

    def __init__(
        self, does: Any = 7, status: str = cp.OPTIMAL, seconds: float | None = 1.0
    ) -> None:
        self.asked: dict[str, Any] = {}
        self.status, self.solver_stats = status, SimpleNamespace(solve_time=seconds)
        self._does = does

    def solve(self, **asked: Any) -> Any:
        self.asked = asked
        return self._does() if callable(self._does) else self._does


def solve(
    program: Program, solver: str = "CLARABEL", settings: dict[str, Any] | None = None
) -> conic.Answer:
    return conic.solve(cast("cp.Problem", program), solver, settings or {})


@pytest.mark.parametrize("solver", [*conic.SETTINGS, "another"])
def test_solvers_get_their_settings_and_what_is_asked_besides(solver: str) -> None:
    program = Program()
    solve(program, solver, {"extra": 3})
    settings = conic.SETTINGS.get(solver, {})
    assert program.asked == {"solver": solver, "canon_backend": "COO", **settings, "extra": 3}
    if settings:
        key = next(iter(settings))
        solve(program, solver, {key: 5})
        assert program.asked[key] == 5


def test_an_answer_is_the_value_with_the_seconds_inside_and_around_the_solver(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for seconds, inside in ((1.0, 1.0), (None, 0.0)):
        clock = iter([10.0, 14.0])
        monkeypatch.setattr(conic, "perf_counter", lambda clock=clock: next(clock))
        assert solve(Program(7, seconds=seconds)) == conic.Answer(7.0, True, inside, 4.0 - inside)


def test_an_inaccurate_answer_is_one_and_says_so() -> None:
    assert solve(Program(status=cp.OPTIMAL_INACCURATE)).accurate is False


@pytest.mark.parametrize("status", [cp.INFEASIBLE, cp.UNBOUNDED, cp.SOLVER_ERROR, "none"])
def test_any_other_status_is_a_failure(status: str) -> None:
    with pytest.raises(cp.SolverError, match=rf"^SCS ended with status {status}$"):
        solve(Program(np.inf, status), "SCS")


def raising(error: BaseException) -> Program:
    def fail() -> None:
        raise error

    return Program(fail)


@pytest.mark.parametrize("error", [ValueError("it broke"), cp.SolverError("it broke")])
def test_whatever_is_raised_is_a_failure_with_its_words(error: Exception) -> None:
    with pytest.raises(cp.SolverError, match=r"^ECOS: it broke$") as caught:
        solve(raising(error), "ECOS")
    assert caught.value.__cause__ is error


@pytest.mark.parametrize("error", [MemoryError(), KeyboardInterrupt()])
def test_what_is_no_fault_of_the_solver_goes_through(error: BaseException) -> None:
    with pytest.raises(type(error)):
        solve(raising(error))


@pytest.mark.parametrize(
    ("words", "heard"),
    [
        ("Solution may be inaccurate. Try another solver.", False),
        ("Reading from a sparse CVXPY expression via `.value` is discouraged.", False),
        ("Something else", True),
    ],
)
def test_only_warnings_that_say_nothing_new_are_kept_quiet(words: str, heard: bool) -> None:
    def warn() -> int:
        warnings.warn(words, stacklevel=1)
        return 7

    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        assert solve(Program(warn)).value == 7.0
        assert len(record) == heard
        # And only meanwhile.
        warnings.warn(words, stacklevel=1)
        assert len(record) == heard + 1
