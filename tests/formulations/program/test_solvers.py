"""Conic solvers say what they found, a verdict needs a proof, and failures have others behind."""

import sys
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

import clarabel
import cvxpy as cp
import numpy as np
import pytest
import scipy.sparse as sp
from cvxpy.reductions.solvers import defines

from formulations.program import solvers
from formulations.program.model import CompiledProgram, Model
from formulations.program.solvers import (
    HUGE,
    SOLVERS,
    Answer,
    ByCvxpy,
    Clarabel,
    ConeProgram,
    FallbackSolver,
    Qoco,
    is_optimal,
    outside,
)

from .support import alone, disk, need, tent

FREE = ConeProgram(np.zeros(2), sp.csc_array((0, 2)), np.zeros(0), 0, 0, ())


def test_clarabel_updates_numbers_on_one_core(monkeypatch):
    """Presolving would make its data final; its threads are ours to give."""
    seen: list[Any] = []
    real = clarabel.DefaultSolver

    def watch(*arguments: Any) -> Any:
        seen.append(arguments)
        return real(*arguments)

    monkeypatch.setattr(clarabel, "DefaultSolver", watch)
    solver = Clarabel()
    for _ in range(2):
        solver.solve(disk(np.random.default_rng(1), 1))
    ((*_, settings),) = seen  # built once
    assert (settings.presolve_enable, settings.max_threads) == (False, 1)
    tolerances = settings.tol_gap_abs, settings.tol_gap_rel, settings.tol_feas
    assert tolerances == (solvers.TOLERANCE,) * 3


def test_almost_solved_answer_is_not_proved(monkeypatch):
    found = SimpleNamespace(x=[1.0, 2.0, 3.0], z=[4.0], status="AlmostSolved")
    fake = SimpleNamespace(solve=lambda: found)
    monkeypatch.setattr(clarabel, "DefaultSolver", lambda *_: fake)
    answer = Clarabel().solve(disk(np.random.default_rng(1), 0))
    assert (answer.status, answer.accurate) == ("AlmostSolved", False)
    assert list(answer.x) == [1.0, 2.0, 3.0]
    assert answer.multipliers is not None
    assert list(answer.multipliers) == [4.0]


def test_qoco_is_proved_only_within_tolerance():
    need("QOCO")
    given: list[Any] = []
    found = SimpleNamespace(x=[1.0], y=[2.0], z=[3.0, 4.0], status="QOCO_SOLVED_INACCURATE")

    def setup(*_: object, **settings: object) -> None:
        given.append(settings)

    solver = Qoco()
    solver._qoco = SimpleNamespace(QOCO=lambda: SimpleNamespace(setup=setup, solve=lambda: found))
    answer = solver.solve(disk(np.random.default_rng(2), 1))
    assert (answer.status, answer.accurate) == ("QOCO_SOLVED_INACCURATE", False)
    assert list(answer.multipliers) == [2.0, 3.0, 4.0]
    assert given == [{"abstol": solvers.TOLERANCE, "reltol": solvers.TOLERANCE}]


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_program_without_a_solution_has_no_answer(solver):
    need(solver)
    matrix = sp.csc_array(np.array([[1.0], [-1.0]]))
    program = ConeProgram(np.ones(1), matrix, np.array([-1.0, -1.0]), 0, 2, ())
    with pytest.raises(ValueError, match=f"{solver} ended with status"):
        SOLVERS[solver]().solve(program)


@pytest.mark.parametrize("equations", [0, 1])
@pytest.mark.parametrize("solver", SOLVERS)
def test_updated_solver_proves_like_a_new_one(solver, equations, capfd):
    """And is silent."""
    need(solver)
    rng = np.random.default_rng(7)
    kept = SOLVERS[solver]()
    for _ in range(4):
        program = disk(rng, equations)
        answer, new = kept.solve(program), SOLVERS[solver]().solve(program)
        assert answer.x == pytest.approx(new.x, abs=1e-5)
        assert answer.multipliers is not None
        assert is_optimal(program, answer.x, answer.multipliers)
        assert program.cost @ answer.x == pytest.approx(
            -program.bound @ answer.multipliers, abs=1e-8
        )
        assert outside(program, answer.multipliers) < 1e-8
        assert answer.accurate == (answer.status in ("Solved", "QOCO_SOLVED"))
        assert answer.accurate or solver == "QOCO"  # which is stricter with itself
        assert 0.0 < answer.solver_s < 1.0
    assert capfd.readouterr() == ("", "")


Word = Answer | BaseException


class Scripted:
    """A solver that answers or raises, one after the other."""

    def __init__(self, words: list[Word]) -> None:
        self._words = words

    def solve(self, _: ConeProgram) -> Answer:
        word = self._words.pop(0)
        if isinstance(word, BaseException):
            raise word
        return word


def script(monkeypatch, first: list[Word], second: list[Word]) -> dict[str, int]:
    """Two solvers with what they say from now on; counts how often each was built."""
    built = {"CLARABEL": 0, "QOCO": 0}

    def maker(name: str, words: list[Word]) -> Callable[[], Scripted]:
        def make() -> Scripted:
            built[name] += 1
            return Scripted(words)

        return make

    for name, words in (("CLARABEL", first), ("QOCO", second)):
        monkeypatch.setitem(SOLVERS, name, maker(name, words))
    return built


def said(status: str, *, accurate: bool) -> Answer:
    return Answer(np.ones(2), status, accurate, 1.0)


GOOD, POOR = said("good", accurate=True), said("poor", accurate=False)


class Panic(BaseException):
    """A panic in Rust, as Python sees it."""


OTHER = said("other", accurate=False)
FAILURE = ValueError("no")


@pytest.mark.parametrize(
    ("first", "second", "expected", "seconds", "built"),
    [
        ([GOOD], [], GOOD, 1.0, (1, 0)),  # nobody else is asked
        ([POOR, GOOD], [], GOOD, 2.0, (2, 0)),  # built again, with a scaling of the new numbers
        ([FAILURE, GOOD], [], GOOD, 1.0, (2, 0)),
        ([ZeroDivisionError("x"), GOOD], [], GOOD, 1.0, (2, 0)),
        ([Panic("x"), GOOD], [], GOOD, 1.0, (2, 0)),
        ([POOR, POOR], [GOOD], GOOD, 3.0, (2, 1)),
        ([FAILURE, POOR], [GOOD], GOOD, 2.0, (2, 1)),
        # Of inaccurate answers the first one counts.
        ([POOR, OTHER], [OTHER], POOR, 3.0, (2, 1)),
        ([POOR, FAILURE], [FAILURE], POOR, 1.0, (2, 1)),
        ([FAILURE, FAILURE], [OTHER], OTHER, 1.0, (2, 1)),
    ],
)
def test_first_accurate_answer_counts_all_seconds(
    first, second, expected, seconds, built, monkeypatch
):
    seen = script(monkeypatch, list(first), list(second))
    assert FallbackSolver("CLARABEL").solve(FREE) == expected._replace(solver_s=seconds)
    assert tuple(seen.values()) == built


@pytest.mark.parametrize(
    ("name", "first", "second", "built"),
    [
        ("CLARABEL", [GOOD, GOOD], [], (1, 0)),  # kept from program to program
        ("CLARABEL", [GOOD, POOR, GOOD], [], (2, 0)),
        ("QOCO", [], [POOR, GOOD, GOOD], (0, 2)),  # the one named is asked, and kept as built again
        ("CLARABEL", [POOR, POOR, GOOD], [GOOD], (2, 1)),  # another that helped out is not kept
    ],
)
def test_the_one_named_is_kept(name, first, second, built, monkeypatch):
    seen, solver = script(monkeypatch, list(first), list(second)), FallbackSolver(name)
    for _ in range(2):
        assert solver.solve(FREE).status == "good"
    assert tuple(seen.values()) == built


def test_another_that_is_not_installed_is_passed_over(monkeypatch):
    script(monkeypatch, [POOR, POOR, ValueError("a"), ValueError("b")], [])

    def absent() -> Scripted:
        raise ModuleNotFoundError("no module named so")

    later = {"QOCO": absent, "third": lambda: Scripted([GOOD])}
    for name, make in later.items():
        monkeypatch.setitem(SOLVERS, name, make)
    assert FallbackSolver("CLARABEL").solve(FREE).status == "good"
    monkeypatch.delitem(SOLVERS, "third")
    with pytest.raises(ValueError, match=r"^b$"):
        FallbackSolver("CLARABEL").solve(FREE)


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_other_exceptions_pass_through(error, monkeypatch):
    script(monkeypatch, [error(), GOOD], [GOOD])
    with pytest.raises(error):
        FallbackSolver("CLARABEL").solve(FREE)


@pytest.mark.parametrize(("value", "taken"), [(0.9 * HUGE, True), (-HUGE, False), (np.nan, False)])
def test_numbers_have_to_be_finite(value, taken, monkeypatch):
    odd = GOOD._replace(x=np.array([0.0, value]))
    script(monkeypatch, [odd, POOR], [POOR])
    assert FallbackSolver("CLARABEL").solve(FREE).accurate is taken
    script(monkeypatch, [odd, odd], [odd])
    if not taken:
        reason = "the conic solver gave no finite burns"
        with pytest.raises(ValueError, match=f"^{reason}; {reason}$"):
            FallbackSolver("CLARABEL").solve(FREE)


def test_only_accurate_answers_need_fitting_multipliers(monkeypatch):
    program, x, z = tent()
    right = Answer(x, "right", True, 1.0, z)
    off = right._replace(x=x + 0.1)
    for first, second, expected in (
        ([right], [], x),
        ([off, right], [], x),
        ([off._replace(multipliers=None)], [], off.x),
        ([off._replace(accurate=False)] * 2, [ValueError("no")], off.x),
    ):
        script(monkeypatch, first, second)
        assert FallbackSolver("CLARABEL").solve(program).x is expected
    script(monkeypatch, [off] * 2, [off])
    doubt = "{} ended with status right, but does not prove it optimal"
    both = "; ".join(doubt.format(name) for name in ("CLARABEL", "QOCO"))
    with pytest.raises(ValueError, match=f"^{both}$"):
        FallbackSolver("CLARABEL").solve(program)


def test_missing_solver_is_refused_at_once(monkeypatch):
    monkeypatch.setitem(sys.modules, "qoco", None)
    with pytest.raises(ModuleNotFoundError, match="qoco"):
        FallbackSolver("QOCO")


@cache
def compiled_tents() -> CompiledProgram:
    variables, price, size = cp.Variable(6), cp.Parameter(2), cp.Parameter(2)
    t, x, y = variables[:2], variables[2:4], variables[4:]
    constraints = [x == y, x <= 10.0 * size, cp.SOC(t, cp.vstack([x - size, x + size]), axis=0)]
    parameters = {"price": price, "size": size}
    program = cp.Problem(cp.Minimize(price @ t), constraints)
    return CompiledProgram(Model(program, variables, parameters))


def two_tents(first: float = 0.5, second: float = 2.0) -> ConeProgram:
    """Two programs of `tent` in one, of these sizes and prices 1 and 3, by CVXPY; x = (t, x, y)."""
    values = {"price": np.array([1.0, 3.0]), "size": np.array([first, second])}
    return compiled_tents().evaluate(values)


@pytest.mark.parametrize("solver", [*SOLVERS, *ByCvxpy.SETTINGS])
def test_every_solver_proves_each_programs_solution(solver, monkeypatch):
    """Those of the call, whatever is left in CVXPY's parameters by another; the same multipliers."""
    need(solver)
    alone(monkeypatch, solver)
    kept = FallbackSolver(solver)
    for size in (2.0, 0.5, 2.0):
        program = two_tents(size, 1.0)
        two_tents(7.0, 7.0)
        answer = kept.solve(program)
        assert answer.accurate
        assert answer.x == pytest.approx(np.sqrt(2.0) * np.array([size, 1, 0, 0, 0, 0]), abs=1e-3)
        assert program.cost @ answer.x == pytest.approx(np.sqrt(2.0) * (size + 3.0), rel=1e-6)
        z = answer.multipliers
        assert is_optimal(program, answer.x, z)
        # Which they would not in another order, or with another sign.
        assert not is_optimal(program, answer.x, -z)
        assert not is_optimal(program, answer.x, z[::-1])


class FakeInterface:
    """CVXPY's interface to a solver, and what it was asked."""

    def __init__(self, status: str = cp.OPTIMAL, error: BaseException | None = None) -> None:
        self.asked: dict[str, Any] = {}
        self.values: list[Any] = []
        self._status, self._error = status, error

    def import_solver(self) -> None:
        pass

    def apply(self, form: Any) -> tuple[Any, Any]:
        self.values = list(form.apply_parameters())
        return {"form": form}, {}

    def solve_via_data(self, data: Any, warm: bool, verbose: bool, options: Any, _: Any) -> Any:
        self.asked = {"warm": warm, "verbose": verbose, **options}
        if self._error:
            raise self._error
        return data

    def invert(self, raw: Any, _: Any) -> SimpleNamespace:
        form = raw["form"]
        duals = {constraint.id: [float(k)] for k, constraint in enumerate(form.constraints)}
        primal = {form.x.id: np.arange(float(form.x.size))[:, None]}
        return SimpleNamespace(status=self._status, primal_vars=primal, dual_vars=duals)


def fake(monkeypatch, interface: FakeInterface, name: str = "FAKE") -> None:
    monkeypatch.setitem(defines.SOLVER_MAP_CONIC, name, interface)


@pytest.mark.parametrize("solver", [*ByCvxpy.SETTINGS, "ANOTHER"])
def test_solvers_get_their_settings(solver, monkeypatch):
    interface, program = FakeInterface(), two_tents()
    fake(monkeypatch, interface, solver)
    settings = ByCvxpy.SETTINGS.get(solver, {})
    ByCvxpy(solver).solve(program)
    assert interface.asked == {"warm": True, "verbose": False, **settings}
    cost, offset, matrix, bound = interface.values
    assert (cost.tolist(), offset, bound.tolist()) == (
        program.cost.tolist(),
        0.0,
        program.bound.tolist(),
    )
    assert np.array_equal(matrix.toarray(), -program.matrix.toarray())


@pytest.mark.parametrize(
    ("status", "error"),
    [
        *((status, None) for status in (cp.INFEASIBLE, cp.UNBOUNDED, cp.SOLVER_ERROR, "none")),
        *((cp.OPTIMAL, error) for error in (ValueError, cp.SolverError, RuntimeError)),
    ],
)
def test_other_status_or_exception_is_quoted_failure(status, error, monkeypatch):
    fake(monkeypatch, FakeInterface(status, error and error("it broke")))
    words = "it broke" if error else f"FAKE ended with status {status}"
    with pytest.raises(ValueError, match=rf"^{words}$"):
        FallbackSolver("FAKE").solve(two_tents())


@pytest.mark.parametrize("status", [cp.OPTIMAL_INACCURATE, cp.INFEASIBLE])
def test_a_solver_asked_to_be_compared_stands_alone(status, monkeypatch):
    """It is not built again either, and no other answers in its place."""
    built = script(monkeypatch, [GOOD], [GOOD])
    interface, program = FakeInterface(status), two_tents()
    fake(monkeypatch, interface)
    solver, made = FallbackSolver("FAKE"), []
    monkeypatch.setattr(solvers, "ByCvxpy", lambda *given: made.append(given))
    if status == cp.INFEASIBLE:
        with pytest.raises(ValueError, match="FAKE ended"):
            solver.solve(program)
    else:
        assert not solver.solve(program).accurate
    assert (built, made) == ({"CLARABEL": 0, "QOCO": 0}, [])


def test_early_stop_is_told_without_warning(capfd, monkeypatch):
    """Warnings are errors here, and CVXPY's own word for an inaccurate answer is one."""
    need("SCS")
    monkeypatch.setitem(ByCvxpy.SETTINGS, "SCS", {"max_iters": 5})
    answer = ByCvxpy("SCS").solve(two_tents())
    assert (answer.status, answer.accurate) == (cp.OPTIMAL_INACCURATE, False)
    assert capfd.readouterr() == ("", "")


def test_installed_solvers_are_conic_ones_clarabel_first(monkeypatch):
    # GLPK has no second-order cones, OSQP no cones, and ECOS_BB is for integers.
    monkeypatch.setitem(defines.SOLVER_MAP_CONIC, "ALLCONES", defines.SOLVER_MAP_CONIC["ECOS"])
    names = ["SCS", "GLPK", "ECOS_BB", "OSQP", "ECOS", "ALLCONES", "CLARABEL", "QOCO"]
    monkeypatch.setattr(cp, "installed_solvers", lambda: names)
    assert solvers.installed() == ("CLARABEL", "ALLCONES", "ECOS", "QOCO", "SCS")
    monkeypatch.setattr(cp, "installed_solvers", lambda: ["SCS", "QOCO"])
    assert solvers.installed() == ("QOCO", "SCS")
